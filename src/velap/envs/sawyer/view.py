"""A perspective camera that stands still, and what it cannot see."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """Where a camera stands and looks; the frame is square and right side up."""

    position: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """The point in the middle of the frame [m]."""
    fovy: float
    """Field of view [degrees]."""

    @cached_property
    def axes(self) -> Array:
        """Right, up and backward [3, 3], unit rows."""
        back = np.subtract(self.position, self.target)
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])

    @cached_property
    def sides(self) -> Array:
        """Unit normals [3, 4] of the four planes that bound what the camera sees, pointing inwards."""
        right, up, back = self.axes
        half = np.radians(self.fovy / 2)
        inwards = [sign * np.cos(half) * axis - np.sin(half) * back for axis in (right, up) for sign in (-1.0, 1.0)]
        return np.stack(inwards, axis=1)

    def depths(self, points: Array) -> Array:
        """points[*, 3] -> how far they are inside each of the four planes [*, 4] [m]; negative outside."""
        return (points - self.position) @ self.sides

    def beside(self, centres: Array, rotations: Array, half_sizes: Array) -> NDArray[np.bool_]:
        """Are boxes wholly beside the frame? bool[*] for centres[*, 3] [m], rotations[*, 3, 3], half_sizes[*, 3] [m]."""
        reach = np.einsum("...jp,...j->...p", np.abs(np.swapaxes(rotations, -1, -2) @ self.sides), half_sizes)
        return np.any(self.depths(centres) < -reach, axis=-1)

    def pixels(self, points: Array, size: int) -> Array:
        """points[*, 3] [m] -> column and row [*, 2] in a frame of `size` [px], from the upper left corner."""
        right, up, back = np.moveaxis((points - np.asarray(self.position)) @ self.axes.T, -1, 0)
        scale = size / 2 / np.tan(np.radians(self.fovy / 2)) / -back
        return np.stack([size / 2 + scale * right, size / 2 - scale * up], axis=-1)
