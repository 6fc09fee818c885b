"""Random shifts of frames (ours): a hundred scenes are few for an encoder.

M frame stacks of N frames.
"""

from __future__ import annotations

import torch
from torch import Tensor


def shifted(stacks: Tensor, group: int, offsets: Tensor) -> Tensor:
    """Frames moved by whole pixels, each `group` of subsequent rows alike; border pixels are repeated.

    stacks uint8 [M, N, H, W, 3]; offsets int64 [ceil(M / group), 2], downwards and to the right [px].
    """
    height, width = stacks.shape[2:4]
    moved = torch.empty_like(stacks)
    for source, target, (down, right) in zip(stacks.split(group), moved.split(group), offsets.tolist(), strict=True):
        # what stays in the picture, then the border rows and columns that it leaves behind
        top, left = max(down, 0), max(right, 0)
        bottom, end = height + min(down, 0), width + min(right, 0)
        target[:, :, top:bottom, left:end] = source[:, :, top - down : bottom - down, left - right : end - right]
        target[:, :, top:bottom, :left] = target[:, :, top:bottom, left : left + 1]
        target[:, :, top:bottom, end:] = target[:, :, top:bottom, end - 1 : end]
        target[:, :, :top] = target[:, :, top : top + 1]
        target[:, :, bottom:] = target[:, :, bottom - 1 : bottom]
    return moved
