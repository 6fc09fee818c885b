"""Bakes what the four manipulation tasks draw: `python -m studies.bake_meshes` writes envs/sawyer/assets/drawing.npz.

It leaves out what a 64×64 frame of the static camera cannot show: collision geoms, fine relief of the arm's meshes, back
faces of what never moves, and textures of all parts except the static boxes (a part keeps the mean colour of its texture).
Run it again after a change of Meta-World, of the view or of a task's scene; a test compares the file with its output. The
simplification stays as it is, since datasets and checkpoints depend on every pixel. Lengths are in metres.

A mesh is a soup: every triangle has its three corners to itself, so that a corner's normal may differ from its neighbour's.

Letters: F triangles, V vertices, C cells, W texture width.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.sawyer import tasks
from velap.envs.sawyer.physics import SawyerTask
from velap.envs.sawyer.scene import ASSETS, SHOWN_GROUPS, VIEW, Block, Drawing, Look, Part, save_drawings
from velap.envs.sawyer.view import View

Array = NDArray[np.float64]

TASKS: tuple[type[SawyerTask], ...] = (tasks.WindowClose, tasks.FaucetClose, tasks.ButtonWall, tasks.DrawerButton)

SHARP = np.cos(np.radians(40.0))
"""Cosine of the angle between triangles from which on the edge between them is drawn sharp. ours."""
CELL = 0.015
"""Side of the cubes within which vertices of a mesh are merged [m]. ours: one pixel in the middle of the view."""
SMALL_MESH = 1000
"""Meshes with more triangles are simplified. ours: objects have fewer; meshes of the arm have 2,400 and more."""
TEXTURE_SIZE = 128
"""Side of a texture, at most [texels]. ours: the table is 70 px wide in the frame."""
STATIC_BODIES = ("tablelink", "RetainingWall", "base")
"""Bodies below the world that never move: only their sides that face the camera are kept."""
SITES = ("rightEndEffector", "leftEndEffector")
"""Sites that are drawn: red balls on the finger tips. The other sites mark goals, which a camera does not see."""


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
    """The mesh with all vertices of each cube of side `cell` [m] merged into the point of least quadric error.

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


def facing(view: View, mesh: Mesh) -> Mesh:
    """The triangles (in the world's frame) that turn their front to the camera and are not wholly beside the frame."""
    towards = np.einsum("ij,ij->i", face_normals(mesh.corners), mesh.corners[:, 0] - view.position) < 0
    beside = np.any(np.all(view.depths(mesh.corners) < 0, axis=1), axis=1)
    return mesh.kept(towards & ~beside)


def collect_parts(model: Any, view: View) -> list[Part]:
    """All visible surfaces: one part for each body and look, and one for each large mesh."""
    data = _at_rest(model)
    found: dict[tuple[int, Look, int], list[Mesh]] = defaultdict(list)
    for number, (body, look, surface, position, rotation) in enumerate(_surfaces(model, data)):
        anchor = _anchor(model, body)
        placed = surface.moved(position, rotation)
        if anchor == 0:
            placed = facing(view, placed)
        large = len(placed) > SMALL_MESH
        if large:
            placed = simplified(placed, CELL)
        if len(placed):
            turn = data.xmat[anchor].reshape(3, 3).T
            # a large one stays alone: it may be beside the frame when the others are not
            found[anchor, look, number if large else -1].append(placed.moved(-turn @ data.xpos[anchor], turn))
    parts = []
    for (body, look, _), surfaces in found.items():
        surface = merged(surfaces)
        parts.append(Part(model.body(body).name if body else "", look, surface.corners.astype(np.float32),
                          surface.normals.astype(np.float32)))
    return parts


def collect_blocks(model: Any, view: View) -> list[Block]:
    """The visible textured boxes of the static world."""
    data, blocks = _at_rest(model), []
    for geom in filter(lambda geom: _shows(model, geom) and _is_block(model, geom), range(model.ngeom)):
        material, half_size = int(model.geom_matid[geom]), model.geom_size[geom]
        position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        if len(facing(view, box(half_size).moved(position, rotation))):
            look = _look(model, material, model.geom_rgba[geom])
            blocks.append(Block(position, rotation, half_size, look, shrunk_texture(model, material)))
    return blocks


def shrunk_texture(model: Any, material: int) -> NDArray[np.uint8]:
    """The first side [W, W, 3] of a material's cube texture, W at most TEXTURE_SIZE."""
    pixels = _pixels(model, _texture_of(model, material))
    width = pixels.shape[1]
    block = -(-width // TEXTURE_SIZE)
    side = width // block
    blocks = pixels[: side * block, : side * block].reshape(side, block, side, block, -1)
    return blocks.mean((1, 3)).round().astype(np.uint8)


def _at_rest(model: Any) -> Any:
    """The MjData of the model's initial state, with all poses."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data


def _surfaces(model: Any, data: Any) -> Iterator[tuple[int, Look, Mesh, Array, Array]]:
    """Body, look, surface, position[3] and rotation[3, 3] of each geom and site that is drawn as a part."""
    for geom in filter(lambda geom: _shows(model, geom) and not _is_block(model, geom), range(model.ngeom)):
        surface = _shape(model, model.geom_type[geom], model.geom_size[geom], model.geom_dataid[geom])
        look = _look(model, model.geom_matid[geom], model.geom_rgba[geom])
        yield int(model.geom_bodyid[geom]), look, surface, data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    for site in filter(lambda site: model.site(site).name in SITES, range(model.nsite)):
        surface = _shape(model, model.site_type[site], model.site_size[site], -1)
        look = _look(model, model.site_matid[site], model.site_rgba[site])
        yield int(model.site_bodyid[site]), look, surface, data.site_xpos[site], data.site_xmat[site].reshape(3, 3)


def _anchor(model: Any, body: int) -> int:
    """The body whose pose carries this one: the nearest ancestor that a joint moves, else the one right below the world.
    The world itself carries STATIC_BODIES."""
    anchor = int(model.body_weldid[body]) or int(model.body_rootid[body])
    return 0 if model.body(anchor).name in STATIC_BODIES else anchor


def _shows(model: Any, geom: int) -> bool:
    """Would MuJoCo draw the geom?"""
    return bool(model.geom_group[geom] < SHOWN_GROUPS and model.geom_rgba[geom][3] > 0)


def _is_block(model: Any, geom: int) -> bool:
    """Does the geom keep its texture? The boxes of the static world do: the table's wood is visible at 64×64."""
    boxed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
    return bool(boxed and _anchor(model, model.geom_bodyid[geom]) == 0 and _texture_of(model, model.geom_matid[geom]) >= 0)


def _shape(model: Any, kind: int, size: Array, mesh: int) -> Mesh:
    """The surface of a geom or site in its own frame."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH.value:
        return _stored_mesh(model, mesh)
    if kind == types.mjGEOM_PLANE.value:
        lid = box(np.array([size[0], size[1], 0.0]))
        return lid.kept(lid.normals[:, 0, 2] > 0)
    solids = {
        types.mjGEOM_BOX.value: lambda: box(size),
        types.mjGEOM_CYLINDER.value: lambda: cylinder(size[0], size[1]),
        types.mjGEOM_CAPSULE.value: lambda: capsule(size[0], size[1]),
        types.mjGEOM_SPHERE.value: lambda: sphere(size[0]),
    }
    return solids[kind]()


def _stored_mesh(model: Any, mesh: int) -> Mesh:
    """A mesh of a compiled model."""
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(np.float64)
    normals = model.mesh_normal[model.mesh_normaladr[mesh] :].astype(np.float64)
    return Mesh(vertices[model.mesh_face[faces]], normals[model.mesh_facenormal[faces]])


def _look(model: Any, material: int, rgba: Array) -> Look:
    """The look of a geom or site of this material in MuJoCo."""
    plain = tuple(float(value) for value in rgba)
    if material < 0:
        return Look(plain, specular=0.5, shininess=0.5, emission=0.0)
    if plain == (0.5, 0.5, 0.5, 1.0):  # MuJoCo's sign of a geom without a colour of its own
        plain = tuple(float(value) for value in model.mat_rgba[material])
    texture = _texture_of(model, material)
    tint = () if texture < 0 else tuple(int(value) for value in _pixels(model, texture).mean((0, 1)).round())
    specular, shininess = float(model.mat_specular[material]), float(model.mat_shininess[material])
    return Look(plain, specular, shininess, float(model.mat_emission[material]), tint)


def _texture_of(model: Any, material: int) -> int:
    """The number of a material's texture, -1 without."""
    return int(model.mat_texid[material].max()) if material >= 0 else -1


def _pixels(model: Any, texture: int) -> NDArray[np.uint8]:
    """A texture [H, W, channels]."""
    shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    start = int(model.tex_adr[texture])
    return model.tex_data[start : start + shape[0] * shape[1] * shape[2]].reshape(shape)


def bake() -> dict[str, Drawing]:
    """The drawing of every task, by the name of its `assets`."""
    models = {task.assets: task.scene().compile() for task in TASKS}
    return {name: Drawing(tuple(collect_parts(model, VIEW)), tuple(collect_blocks(model, VIEW)))
            for name, model in models.items()}


def main(path: Path = ASSETS) -> None:
    """Bake all tasks into one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_drawings(path, bake())
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
