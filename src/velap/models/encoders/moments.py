"""Colour moments: how much there is of each colour of a palette, where, and how it is spread (ours).

A thing of one colour that moves by a tenth of a pixel changes a picture by hardly anything, and its centre by a tenth of a
pixel. `*` is any batch prefix, M frames, N frames of a stack, K colours, C = 6 K.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from torch import Tensor, nn

from velap.config import ModelConfig
from velap.models.networks import MLP

BITS = 5
"""Of each channel that a pixel's colour is looked up by."""
PIXELS = 60_000
"""Of the sample that the palette is learnt from."""
AREA = 3.0
"""Pixels in the middle of the picture that every colour has besides its own: the centre of nothing is there [px]."""
LIMIT = 5.0
"""Standardised moments lie within plus and minus this."""
KEPT_SCALE = 0.8
"""Deviation of a slow feature or a moment in the latent, about that of a learnt dimension."""
KEPT_LIMIT = 4.0
"""Slow features lie within plus and minus this in the latent, and moments too."""


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
        rng = np.random.default_rng([seed, 11])
        pixels = frames.reshape(-1, 3)
        pixels = pixels[rng.choice(len(pixels), min(PIXELS, len(pixels)), replace=False)].astype(np.float32)
        count = min(self.colours, len(np.unique(pixels, axis=0)))
        found = KMeans(count, n_init=1, random_state=seed).fit(pixels)
        middles = (np.arange(2**BITS) + 0.5) * 2 ** (8 - BITS)
        grid = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
        self.palette.copy_(torch.from_numpy(found.predict(grid).astype(np.uint8)).view_as(self.palette))
        chunks = torch.from_numpy(frames).to(self.palette.device).split(500)
        moments = torch.cat([self.measure(chunk) for chunk in chunks])
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


class MomentEncoder(nn.Module):
    """φ by colour moments: those of the newest frame and what they differ by from each older one go through the dense
    layers of Table 2, and slow features of the newest frame's (`slow_features`) or all of those (`keep_moments`) stand
    behind them as they are; uint8 `[*, N, H, W, 3] → [*, D]` (ours, `moment_colours`)."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__()
        self.moments = ColourMoments(config.moment_colours, size)
        moments, learnt = 6 * config.moment_colours, config.learnt_dim
        self.dense = MLP(moments * config.frame_stack, config.encoder_dense, learnt, config.norm)
        self.slow_features, self.keep_moments = config.slow_features, config.keep_moments
        """S, dimensions of the latent behind those that are learnt, and whether the moments stand behind these."""
        if config.slow_features > 0:
            self.register_buffer("slow_mean", torch.zeros(moments))
            self.register_buffer("slow_directions", torch.zeros(moments, config.slow_features))
        self.slow_mean: Tensor
        """float32 [C], mean of the moments over the data."""
        self.slow_directions: Tensor
        """float32 [C, S], `KEPT_SCALE` deviations of a slow feature a column."""

    def forward(self, frames: Tensor) -> Tensor:
        prefix, shape = frames.shape[:-4], frames.shape[-4:]
        moments = self.moments(frames.reshape(-1, *shape[1:]))
        return self.from_moments(moments.view(-1, shape[0], moments.shape[-1])).reshape(*prefix, -1)

    def from_moments(self, moments: Tensor) -> Tensor:
        """Standardised moments of a stack [M, N, C] → [M, D]."""
        parts, newest = [self.learnt(moments)], moments[:, -1]
        if self.slow_features > 0:
            parts.append(((newest - self.slow_mean) @ self.slow_directions).clamp(-KEPT_LIMIT, KEPT_LIMIT))
        if self.keep_moments:
            parts.append(KEPT_SCALE * newest)
        return torch.cat(parts, -1)

    def learnt(self, moments: Tensor) -> Tensor:
        """What the dense layers make of standardised moments of a stack: [M, N, C] → [M, D less what is kept]."""
        newest = moments[:, -1:]
        return self.dense(torch.cat([newest, newest - moments[:, :-1]], 1).flatten(1))

    @torch.no_grad()
    def keep_slow(self, mean: Tensor, directions: Tensor) -> None:
        """Take the slow features of moments [M, C] to be (moments - mean) @ directions: [C], [C, S], variance one."""
        if self.slow_features > 0:
            self.slow_mean.copy_(mean)
            self.slow_directions.copy_(KEPT_SCALE * directions[:, : self.slow_features])
