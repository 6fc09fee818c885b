"""Triangle meshes for drawing: primitives, merging, simplification, culling. No physics here.

A mesh is a soup: every triangle has its three corners to itself, so that a corner's normal may differ from its neighbour's.
Lengths are in metres.

Letters: F triangles, V vertices, C cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHARP = np.cos(np.radians(40.0))
"""Cosine of the angle between triangles from which on the edge between them is drawn sharp. ours."""


@dataclass(frozen=True)
class Mesh:
    """corners[F, 3, 3] (triangle, corner, xyz) [m], counter-clockwise from outside, and their unit normals[F, 3, 3]."""

    corners: Array
    normals: Array

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.corners)

    def moved(self, position: Array, rotation: Array) -> Mesh:
        """Turned by rotation[3, 3], then shifted by position[3] [m]."""
        return Mesh(self.corners @ rotation.T + position, self.normals @ rotation.T)

    def kept(self, mask: NDArray[np.bool_]) -> Mesh:
        """The triangles of mask[F]."""
        return Mesh(self.corners[mask], self.normals[mask])


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes."""
    return Mesh(np.concatenate([m.corners for m in meshes]), np.concatenate([m.normals for m in meshes]))


def face_normals(corners: Array) -> Array:
    """corners[F, 3, 3] -> normals[F, 3] as long as twice the triangle's area [m²]."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def smoothed(corners: Array, vertices: NDArray[np.int64]) -> Mesh:
    """A mesh of corners[F, 3, 3] with the number of each corner's vertex, vertices[F, 3].

    Normals are averaged over the triangles that share a vertex, but not across sharp edges.
    """
    weighted = face_normals(corners)
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-30)
    vertex, face = vertices.ravel(), np.repeat(np.arange(len(corners)), 3)
    order = np.argsort(vertex, kind="stable")
    vertex, face = vertex[order], face[order]
    start, count = np.unique(vertex, return_index=True, return_counts=True)[1:]
    # every pair (corner, triangle at the same vertex)
    size = np.repeat(count, count)
    left = np.repeat(np.arange(len(vertex)), size)
    within = np.arange(len(left)) - np.repeat(np.cumsum(size) - size, size)
    right = np.repeat(np.repeat(start, count), size) + within
    near = np.einsum("ij,ij->i", unit[face[left]], unit[face[right]]) >= SHARP
    sums = np.zeros((len(vertex), 3))
    np.add.at(sums, left[near], weighted[face[right[near]]])
    normals = np.empty_like(sums)
    normals[order] = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    return Mesh(corners, normals.reshape(-1, 3, 3))


def simplified(mesh: Mesh, cell: float) -> Mesh:
    """The mesh with all vertices of each cube of side `cell` [m] drawn together, at the point of least quadric error.

    Vertex clustering (Rossignac & Borrel 1993) with the representatives of Lindstrom 2000: the point of the cell that is
    nearest to the planes of all triangles that touch it. Triangles that collapse go, and so do copies of others.
    """
    cells = np.floor((mesh.corners - mesh.corners.min((0, 1))) / cell).astype(np.int64)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(cells, -1, 0)), tuple(cells.max((0, 1)) + 1))
    vertices = np.unique(numbers, return_inverse=True)[1].reshape(-1, 3)
    representatives = _least_error_points(mesh.corners, vertices, cell)
    # the same triangle starts with its smallest vertex, whichever way it is turned
    turned = np.take_along_axis(vertices, (vertices.argmin(1)[:, None] + np.arange(3)) % 3, axis=1)
    first, second, third = turned.T
    turned = turned[(first != second) & (second != third) & (third != first)]
    packed = np.unique(np.ravel_multi_index(tuple(turned.T), (len(representatives),) * 3))
    faces = np.stack(np.unravel_index(packed, (len(representatives),) * 3), axis=1)
    return smoothed(representatives[faces], faces)


def _least_error_points(corners: Array, vertices: NDArray[np.int64], cell: float) -> Array:
    """[C, 3] the point of each cluster nearest to the planes of its triangles; vertices[F, 3] are clusters of corners."""
    count = int(vertices.max()) + 1
    total = np.zeros((count, 3))
    np.add.at(total, vertices.ravel(), corners.reshape(-1, 3))
    members = np.bincount(vertices.ravel(), minlength=count)
    means = total / members[:, None]
    normals = face_normals(corners)
    quadric, linear = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for corner in range(3):
        where = vertices[:, corner]
        # planes relative to the cluster's mean, which keeps the numbers small
        offsets = np.einsum("ij,ij->i", normals, corners[:, corner] - means[where])
        np.add.at(quadric, where, normals[:, :, None] * normals[:, None, :])
        np.add.at(linear, where, normals * offsets[:, None])
    # where the planes leave a direction open, the mean decides
    weight = 1e-3 * np.trace(quadric, axis1=1, axis2=2) + 1e-30
    shifts = np.linalg.solve(quadric + weight[:, None, None] * np.eye(3), linear[..., None])[..., 0]
    return means + np.clip(shifts, -cell / 2, cell / 2)


def _revolved(outline: Sequence[tuple[float, float]], sides: int) -> Mesh:
    """An outline of (radius, height) [m] from bottom to top, turned about z."""
    angles = 2 * np.pi * np.arange(sides) / sides
    rings = np.array([[(r * np.cos(a), r * np.sin(a), z) for a in angles] for r, z in outline])
    triangles, numbers = [], []
    for low in range(len(outline) - 1):
        for side in range(sides):
            after = (side + 1) % sides
            quad = [(low, side), (low, after), (low + 1, after), (low + 1, side)]
            for picked in ((0, 1, 2), (0, 2, 3)):
                triangles.append([rings[quad[k]] for k in picked])
                # the corners of a ring of radius zero are one vertex
                numbers.append([quad[k][0] * sides + (quad[k][1] if outline[quad[k][0]][0] > 0 else 0) for k in picked])
    corners, vertices = np.array(triangles), np.array(numbers)
    solid = np.linalg.norm(face_normals(corners), axis=1) > 0
    return smoothed(corners[solid], vertices[solid])


def cylinder(radius: float, half_height: float, sides: int = 12) -> Mesh:
    """A closed cylinder along z."""
    return _revolved([(0, -half_height), (radius, -half_height), (radius, half_height), (0, half_height)], sides)


def capsule(radius: float, half_height: float, sides: int = 8) -> Mesh:
    """A cylinder along z with half spheres on its ends."""
    arc = [(radius * np.cos(a), radius * np.sin(a)) for a in np.radians((0.0, 45.0))]
    top = [(r, half_height + z) for r, z in arc] + [(0.0, half_height + radius)]
    return _revolved([(r, -z) for r, z in reversed(top)] + top, sides)


def sphere(radius: float, sides: int = 8) -> Mesh:
    """A ball."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    outline = [(radius * np.cos(a), radius * np.sin(a)) for a in angles]
    return _revolved([(0.0, -radius), *outline[1:-1], (0.0, radius)], sides)


def box(half_size: Array) -> Mesh:
    """A box of half_size[3] [m]."""
    faces = []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for sign in (-1.0, 1.0):
            around = [(-1, -1), (1, -1), (1, 1), (-1, 1)][:: int(sign)]
            a, b, c, d = (half_size * (sign * np.eye(3)[axis] + x * u + y * v) for x, y in around)
            faces += [[a, b, c], [a, c, d]]
    return smoothed(np.array(faces), np.arange(36).reshape(12, 3))
