"""What a cheap stationary camera adds to a rendered frame: drifting exposure and sensor noise. Both follow from a seed.

ours: the paper names the camera and no property of it; the numbers are a common webcam's indoors.
"""

from __future__ import annotations

import numpy as np

from velap.envs.pixels import Frame

EXPOSURE_SPREAD = 0.04
"""Standard deviation of the exposure over time and episodes, relative to 1."""
EXPOSURE_MEMORY = 0.98
"""Correlation of the exposure from one control step to the next."""
NOISE = 2.5
"""Standard deviation of the sensor's noise [grey levels of 255], independent for each pixel, colour and frame."""


class Webcam:
    """The camera of one episode: what it does to frame t depends on the seed and t alone, however often it is asked."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._rng = np.random.default_rng([seed, 0])
        self._exposure = EXPOSURE_SPREAD * self._rng.standard_normal()
        self._time = 0

    def tick(self) -> None:
        """Go on to the next control step."""
        fresh = EXPOSURE_SPREAD * np.sqrt(1.0 - EXPOSURE_MEMORY**2)
        self._exposure = EXPOSURE_MEMORY * self._exposure + fresh * self._rng.standard_normal()
        self._time += 1

    def expose(self, frame: Frame) -> Frame:
        """What the camera makes of a rendered frame, both uint8 [H, W, 3]."""
        noise = np.random.default_rng([self._seed, 1, self._time]).standard_normal(frame.shape, np.float32)
        values = (1.0 + np.float32(self._exposure)) * frame + np.float32(NOISE) * noise
        return np.rint(np.clip(values, 0.0, 255.0, out=values), out=values).astype(np.uint8)
