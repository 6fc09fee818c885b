"""The paper's encoder (Table 2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from velap.config import ModelConfig
from velap.models.encoders.base import Encoder
from velap.models.networks import LEAK, MLP
from velap.registry import register_encoder

FILTERS, KERNELS, STRIDES = (32, 32, 64, 64), (4, 4, 4, 4), (2, 2, 2, 2)
"""Convolutions of Table 2; kernels and strides in [px]."""
DENSE = (256, 128)
"""Hidden dense layers of Table 2."""


def native_precision(device: str) -> torch.dtype:
    """Arithmetic of the convolutions on a kind of device (ours): bfloat16 where it has units for that, else float32.

    On a CPU with such units bfloat16 gives 2.4 times the frames/s of float32; on one without, 1/13 of them.
    """
    units = device == "cuda" or torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.bfloat16 if units else torch.float32


@register_encoder("conv")
class ConvEncoder(Encoder):
    """φ, Table 2: convolutions and dense layers.

    Layer normalisation acts on the dense layers only: over convolution maps it costs as much as the convolutions (ours).
    """

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__()
        channels = 3 * config.frame_stack
        height, width = size
        layers: list[nn.Module] = []
        for filters, kernel, stride in zip(FILTERS, KERNELS, STRIDES, strict=True):
            layers.append(nn.Conv2d(channels, filters, kernel, stride))
            if config.norm == "batch":
                layers.append(nn.BatchNorm2d(filters))
            layers.append(nn.LeakyReLU(LEAK, inplace=True))
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
            channels = filters
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.dense = MLP(channels * height * width, DENSE, config.latent_dim, config.norm)
        self.dtype: torch.dtype | None = None
        """Arithmetic of the convolutions; None takes the device's `native_precision`."""

    def encode(self, stacks: Tensor) -> Tensor:
        """uint8 [M, N, H, W, 3] → [M, D]."""
        m, n, h, w, c = stacks.shape
        kind = stacks.device.type
        dtype = native_precision(kind) if self.dtype is None else self.dtype
        x = stacks.permute(0, 2, 3, 1, 4).reshape(m, h, w, n * c)
        x = x.to(dtype).mul_(2 / 255).sub_(1).permute(0, 3, 1, 2)
        with torch.autocast(kind, dtype=dtype, enabled=dtype != torch.float32):
            x = self.convolutions(x).flatten(1)
        return self.dense(x.float())
