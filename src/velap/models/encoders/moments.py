"""Colour moments: how much there is of each colour of a palette, where, and how it is spread (ours).

A thing of one colour that moves by a tenth of a pixel changes a picture by hardly anything, and its centre by a tenth of a
pixel. What a scene is (where a drawer stands, how far it is open) changes slowly or not at all in an episode, and is a small
share of the moments' variance: an arm covers more. Slow feature analysis (Wiskott and Sejnowski 2002) finds the directions
of the moments that change least in a few steps, each with variance one, so that a drawer counts as much as an arm.

`*` is any batch prefix, F frames of the data, M frames, N frames of a stack, K colours, C = 6 K moments, S slow features.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh
from torch import Tensor, nn

from velap.config import ModelConfig
from velap.models.encoders.base import Encoder, Target, in_parts
from velap.models.encoders.conv import DENSE
from velap.models.networks import MLP
from velap.registry import register_encoder

COLOURS = 24
"""K, colours of the palette."""

BITS = 5
"""Bits of each channel that look up a pixel's colour."""
FRAMES, PIXELS = 2_000, 60_000
"""Sample of the data that the palette is learnt from."""
AREA = 3.0
"""Pseudo-count: shrinks the centroid of a rare colour to the image centre [px]."""
LIMIT = 5.0
"""Standardised moments lie within plus and minus this."""
KEPT_SCALE = 0.8
"""Deviation of a slow feature or a moment in the latent, about that of a learnt dimension."""
KEPT_LIMIT = 4.0
"""Slow features lie within plus and minus this in the latent, and moments too."""
SLOW = 32
"""S, slow features."""
LAG = 10
"""Steps in which slow features change least [steps]."""
RIDGE = 1e-3
"""Ridge on every direction's variance before directions are compared."""
DEVIATION_WEIGHT = 0.5
"""Weight of a slow feature's deviation from its episode mean; the mean and the moments have weight 1."""


class ColourMoments(nn.Module):
    """Area (its root), centre, variances and covariance of each colour, standardised over the data; see `fit`."""

    def __init__(self, colours: int, size: tuple[int, int]) -> None:
        super().__init__()
        self.colours = colours
        levels = 2**BITS
        self.register_buffer("palette", torch.zeros(levels, levels, levels, dtype=torch.uint8))
        self.register_buffer("mean", torch.zeros(6 * colours))
        self.register_buffer("deviation", torch.ones(6 * colours))
        across, down = (torch.linspace(-1, 1, side) for side in reversed(size))
        self.register_buffer("across", across, persistent=False)
        self.register_buffer("down", torch.stack([torch.ones_like(down), down, down**2]), persistent=False)
        self.palette: Tensor
        """uint8 [32, 32, 32]: number of the colour of each pixel."""
        self.mean: Tensor
        self.deviation: Tensor
        self.across: Tensor
        """float32 [W], places in a row from -1 to 1."""
        self.down: Tensor
        """float32 [3, H], powers of the places in a column."""

    @torch.no_grad()
    def fit(self, frames: NDArray[np.uint8], seed: int) -> None:
        """Palette (k-means) and mean and deviation of the moments from a sample of frames [M, H, W, 3]."""
        from sklearn.cluster import KMeans  # slow to import, and needed here alone

        rng = np.random.default_rng([seed, 11])
        pixels = frames.reshape(-1, 3)
        pixels = pixels[rng.choice(len(pixels), min(PIXELS, len(pixels)), replace=False)].astype(np.float32)
        count = min(self.colours, len(np.unique(pixels, axis=0)))
        found = KMeans(count, n_init=1, random_state=seed).fit(pixels)
        middles = (np.arange(2**BITS) + 0.5) * 2 ** (8 - BITS)
        grid = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
        self.palette.copy_(torch.from_numpy(found.predict(grid).astype(np.uint8)).view_as(self.palette))
        moments = in_parts(self.measure, torch.from_numpy(frames).to(self.palette.device), 500)
        self.mean.copy_(moments.mean(0))
        self.deviation.copy_(moments.std(0).clamp(min=1e-3))

    def measure(self, frames: Tensor) -> Tensor:
        """Moments as they are: uint8 [M, H, W, 3] → float32 [M, C]; places are in -1 to 1."""
        count, height, width = frames.shape[:3]
        red, green, blue = (frames.long() >> (8 - BITS)).unbind(-1)
        colour = self.palette[red, green, blue].long()  # [M, H, W]
        powers = []
        for weight in (torch.ones_like(self.across), self.across, self.across**2):
            rows = torch.zeros(count, height, self.colours, device=frames.device)
            powers.append(rows.scatter_add_(2, colour, weight.expand(count, height, width)))
        area, x, xx = (self.down[0] @ rows for rows in powers)
        y, xy = self.down[1] @ powers[0], self.down[1] @ powers[1]
        yy = self.down[2] @ powers[0]
        x, y, xx, yy, xy = (sums / (area + AREA) for sums in (x, y, xx, yy, xy))
        return torch.cat([area.sqrt(), x, y, xx - x * x, yy - y * y, xy - x * y], -1)

    def forward(self, frames: Tensor) -> Tensor:
        return ((self.measure(frames) - self.mean) / self.deviation).clamp(-LIMIT, LIMIT)


def slow_features(moments: Tensor, last: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The `count` linear features of moments [F, C] that change least: mean [C] and directions [C, count], so that
    (moments - mean) @ directions has zero mean and variance one.

    last: int64 [F], last row of each row's episode. Where no episode is longer than `LAG`, each row is compared with that.
    """
    rows = torch.arange(len(moments), device=moments.device)
    ahead = torch.minimum(rows + LAG, last)
    if bool((rows + LAG <= last).any()):
        kept = rows + LAG <= last
        rows, ahead = rows[kept], ahead[kept]
    mean = moments.mean(0)
    centred = moments - mean
    change = moments[ahead] - moments[rows]
    ridge = RIDGE * np.eye(moments.shape[1])
    spread, fast = (part.T @ part / len(part) for part in (centred, change))
    _, found = eigh(fast.double().cpu().numpy() + ridge, spread.double().cpu().numpy() + ridge)
    directions = torch.from_numpy(found[:, :count]).to(moments)
    return mean, directions / (centred @ directions).std(0).clamp(min=1e-6)


@register_encoder("moments")
class MomentEncoder(Encoder):
    """φ by colour moments: those of the newest frame and their differences from each older one go through the dense layers
    of Table 2, and all moments of the newest frame stand behind, as they are (ours: a task of many objects asks for all they
    tell)."""

    chunk = 4096

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__()
        self.moments = ColourMoments(COLOURS, size)
        self.dense = MLP(6 * COLOURS * config.frame_stack, DENSE, config.latent_dim, config.norm)

    @classmethod
    def width(cls, config: ModelConfig) -> int:
        """D: learnt units and moments."""
        return config.latent_dim + 6 * COLOURS

    @classmethod
    def learnt_width(cls, config: ModelConfig) -> int:
        """Units of the dense layers."""
        return config.latent_dim

    @torch.no_grad()
    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Palette and scale of the moments from frames all over the data."""
        rows = np.linspace(0, len(frames) - 1, min(FRAMES, len(frames))).astype(np.int64)
        self.moments.fit(frames[torch.from_numpy(rows).to(frames.device)].cpu().numpy(), seed)
        return self.measure(frames)

    def features(self, frames: Tensor) -> Tensor:
        """Standardised colour moments [F, C]."""
        return self.moments(frames)

    def measure(self, frames: Tensor) -> Tensor:
        """The same of all frames of the data, in pieces that fit a cache."""
        return in_parts(self.features, frames, 500)

    def encode(self, stacks: Tensor) -> Tensor:
        """Moments of a stack [M, N, C] → [M, D]."""
        return torch.cat([self.learnt(stacks), self.kept(stacks[:, -1])], -1)

    def learnt(self, stacks: Tensor) -> Tensor:
        """What the dense layers make of moments of a stack: [M, N, C] → [M, d_Z]."""
        newest = stacks[:, -1:]
        return self.dense(torch.cat([newest, newest - stacks[:, :-1]], 1).flatten(1))

    def kept(self, newest: Tensor) -> Tensor:
        """What stands behind of the newest frame's moments [M, C]."""
        return KEPT_SCALE * newest

    @torch.no_grad()
    def targets(self, features: Tensor, first: Tensor, last: Tensor) -> tuple[Target, ...]:
        """The moments of the newest frame, and its slow features: their means over the episode, which hold no accident of
        the moment, and the deviations from these."""
        count = min(SLOW, features.shape[1])
        middle, directions = slow_features(features, last, count)
        slow = (features - middle) @ directions
        numbers = torch.unique(first, return_inverse=True)[1]
        sums = torch.zeros(int(numbers.max()) + 1, count, device=features.device).index_add_(0, numbers, slow)
        mean = (sums / torch.bincount(numbers).unsqueeze(1))[numbers]
        parts = tuple(part / part.std(0).clamp(min=1e-6) for part in (mean, slow - mean))
        return Target("moments", (features,), (1.0,), (256,)), Target("slow", parts, (1.0, DEVIATION_WEIGHT), ())


@register_encoder("slow-moments")
class SlowMomentEncoder(MomentEncoder):
    """As `moments`, with slow features of the newest frame's moments behind the learnt part (ours: dense layers lose a third
    of what moments tell of where a window is)."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__(config, size)
        self.register_buffer("slow_mean", torch.zeros(6 * COLOURS))
        self.register_buffer("slow_directions", torch.zeros(6 * COLOURS, SLOW))
        self.slow_mean: Tensor
        """float32 [C], mean of the moments over the data."""
        self.slow_directions: Tensor
        """float32 [C, S], `KEPT_SCALE` deviations of a slow feature a column."""

    @classmethod
    def width(cls, config: ModelConfig) -> int:
        """D: learnt units and slow features."""
        return config.latent_dim + SLOW

    @torch.no_grad()
    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Palette, scale and slow features."""
        features = super().fit(frames, last, seed)
        mean, directions = slow_features(features, last, SLOW)
        self.slow_mean.copy_(mean)
        self.slow_directions.copy_(KEPT_SCALE * directions)
        return features

    def kept(self, newest: Tensor) -> Tensor:
        """Slow features [M, S]."""
        return ((newest - self.slow_mean) @ self.slow_directions).clamp(-KEPT_LIMIT, KEPT_LIMIT)
