"""Baking: meshes are closed and outward, simplified without losing their shape; the shipped file is what is baked."""

from __future__ import annotations

import numpy as np
import pytest

from studies import bake_meshes as meshes
from studies.bake_meshes import Mesh, face_normals, facing, merged, simplified
from velap.envs.sawyer.scene import load_drawing
from velap.envs.sawyer.view import View


def volume(mesh: Mesh) -> float:
    """Of a closed surface [m³]; negative inside out."""
    first, second, third = np.moveaxis(mesh.corners, 1, 0)
    return float((first * np.cross(second, third)).sum() / 6)


def fine_ball(radius: float) -> Mesh:
    return meshes.sphere(radius, sides=80)


@pytest.mark.parametrize(("mesh", "exact", "triangles"), [
    (meshes.box(np.array([1.0, 2.0, 3.0])), 48.0, 12),
    (meshes.cylinder(1.0, 2.0), 4 * np.pi, 48),
    (meshes.capsule(1.0, 2.0), 4 * np.pi + 4 / 3 * np.pi, 64),
    (meshes.sphere(1.0), 4 / 3 * np.pi, 48),
    (fine_ball(1.0), 4 / 3 * np.pi, 80 * 78),
])
def test_primitives_are_closed_and_outward(mesh: Mesh, exact: float, triangles: int) -> None:
    assert len(mesh) == triangles
    assert 0.75 * exact < volume(mesh) <= exact + 1e-9
    outward = face_normals(mesh.corners)
    assert (np.einsum("ij,ij->i", outward, mesh.corners.mean(1)) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0)
    # closed: every directed edge has its opposite
    points = np.unique(mesh.corners.reshape(-1, 3).round(9), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = {(a, b) for face in points for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert {(b, a) for a, b in edges} == edges


def test_edges_of_a_box_are_sharp_and_a_ball_is_smooth() -> None:
    box = meshes.box(np.ones(3))
    np.testing.assert_allclose(np.abs(box.normals).max(-1), 1.0)
    ball = fine_ball(2.0)
    np.testing.assert_allclose(ball.normals, ball.corners / 2.0, atol=0.06)


def test_simplifying_keeps_the_shape_with_fewer_triangles() -> None:
    ball = fine_ball(0.05)
    coarse = simplified(ball, 0.02)
    assert len(coarse) < len(ball) / 30
    assert volume(coarse) == pytest.approx(volume(ball), rel=0.05)
    radii = np.linalg.norm(coarse.corners, axis=-1)
    assert abs(radii - 0.05).max() < 0.005
    assert (np.einsum("ij,ij->i", face_normals(coarse.corners), coarse.corners.mean(1)) > 0).all()


def test_simplifying_puts_the_corners_of_a_box_back_where_they_were() -> None:
    """Quadrics know corners: means of the vertices in a cell would round them off."""
    half = np.array([0.101, 0.052, 0.033])
    steps = np.linspace(-1, 1, 41)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1)
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.insert(grid, axis, sign, axis=-1) * half
            a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
            faces = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
            sides.append(faces if sign * (-1) ** axis > 0 else faces[:, ::-1])
    corners = np.concatenate(sides)
    fine = Mesh(corners, np.zeros_like(corners))
    assert volume(fine) == pytest.approx(8 * half.prod())
    coarse = simplified(fine, 0.03)
    assert len(coarse) < len(fine) / 20
    assert volume(coarse) == pytest.approx(8 * half.prod(), rel=0.01)
    for corner in np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3) * half:
        assert np.linalg.norm(coarse.corners - corner, axis=-1).min() < 1e-3


def test_moving_and_merging() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = meshes.box(np.array([1.0, 2.0, 3.0])).moved(np.array([10.0, 0.0, 0.0]), turn)
    np.testing.assert_allclose(moved.corners.max((0, 1)), [12.0, 1.0, 3.0])
    np.testing.assert_allclose(moved.normals, face_normals(moved.corners)[:, None].repeat(3, 1)
                               / np.linalg.norm(face_normals(moved.corners), axis=-1)[:, None, None])
    assert len(merged([moved, moved])) == 24


def test_a_view_projects_to_pixels_and_knows_what_is_beside_it() -> None:
    view = View(position=(2.0, 0.0, 0.0), target=(0.0, 0.0, 0.0), fovy=90.0)
    np.testing.assert_allclose(view.pixels(np.zeros(3), 64), [32, 32])
    # it looks along -x: +y is to the right, +z is up
    np.testing.assert_allclose(view.pixels(np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0], [1.0, 0.5, 0.5]]), 64),
                               [[64, 32], [32, 0], [48, 16]], atol=1e-9)
    centres = np.array([[0.0, 2.1, 0.0], [0.0, 2.1, 0.0], [0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    halves, still = np.full((4, 3), 0.01), np.broadcast_to(np.eye(3), (4, 3, 3))
    halves[1, 0] = 0.2  # towards the frame
    assert view.beside(centres, still, halves).tolist() == [True, False, False, True]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    halves[1] = 0.01, 0.2, 0.01
    assert view.beside(centres, quarter @ still, halves).tolist() == [True, False, False, True]
    assert view.beside(centres, still, np.array([[0.01, 0.01, 9.0]] * 4)).tolist() == [True, True, False, True]
    cube = meshes.box(np.full(3, 0.1))
    seen = facing(view, merged([cube, cube.moved(np.array([0.0, 9.0, 0.0]), np.eye(3))]))
    assert len(seen) == 2
    np.testing.assert_allclose(seen.corners[..., 0], 0.1)


def test_the_shipped_drawings_are_what_the_script_bakes() -> None:
    for name, made in meshes.bake().items():
        shipped = load_drawing(name)
        assert [(part.body, len(part.corners)) for part in shipped.parts] == [(p.body, len(p.corners)) for p in made.parts]
        for part, expected in zip(shipped.parts, made.parts, strict=True):
            assert part.look == expected.look
            np.testing.assert_allclose(part.corners, expected.corners, atol=1e-6)
            np.testing.assert_allclose(part.normals, expected.normals, atol=1e-4)
        for block, box in zip(shipped.blocks, made.blocks, strict=True):
            assert block.look == box.look
            np.testing.assert_array_equal(block.texture, box.texture)
            np.testing.assert_allclose([*block.position, *block.half_size], [*box.position, *box.half_size], atol=1e-12)
