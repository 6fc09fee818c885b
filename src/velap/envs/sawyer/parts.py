"""The visible surface of a compiled Meta-World model, simplified and merged into few parts.

What a 64×64 frame of a camera that stands still cannot show is left out: collision geoms, fine relief of the arm's meshes,
back faces of what never moves, textures other than those of the static boxes (a part keeps the mean colour of its texture).

Letters: F triangles, W texture width.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.sawyer import meshes
from velap.envs.sawyer.meshes import Array, Mesh
from velap.envs.sawyer.view import View

CELL = 0.015
"""Side of the cubes within which vertices of a mesh are drawn together [m]. ours: one pixel at the middle of the view."""

SMALL_MESH = 1000
"""Meshes of up to so many triangles stay as they are. ours: those of all objects; the arm's have 2,400 and more."""

TEXTURE_SIZE = 128
"""Side of a texture, at most [texels]. ours: the table is 70 px wide in the frame."""

STATIC_BODIES = ("tablelink", "RetainingWall", "base")
"""Bodies below the world that stand where they are in every episode: of these only what faces the camera is kept."""

SITES = ("rightEndEffector", "leftEndEffector")
"""Sites that are drawn, red balls on the finger tips. The others mark goals, which a camera does not see."""

SHOWN_GROUPS = 3
"""MuJoCo shows geom groups 0 to 2 unless told otherwise; Meta-World keeps its collision geoms in group 4."""


@dataclass(frozen=True)
class Look:
    """Colour and shine of a part, as MuJoCo's materials have them."""

    rgba: tuple[float, ...]
    specular: float
    shininess: float
    emission: float
    tint: tuple[int, ...] = ()
    """Mean colour of its texture. OpenGL clamps the light before it multiplies by a texture, hence not one with rgba."""


@dataclass(frozen=True)
class Part:
    """A surface of one look on one body."""

    body: int
    """Body of the Meta-World model that carries it; 0 is the world."""
    look: Look
    surface: Mesh
    """In the frame of that body."""


@dataclass(frozen=True)
class Block:
    """A box of the static world that keeps its texture."""

    position: Array
    """[3] [m]"""
    rotation: Array
    """[3, 3]"""
    half_size: Array
    """[3] [m]"""
    look: Look
    material: int
    """Number of the material in the Meta-World model."""


def collect_parts(model: Any, view: View) -> list[Part]:
    """All that may show, one part for each body that carries some and each look, and for each large mesh."""
    data = _at_rest(model)
    found: dict[tuple[int, Look, int], list[Mesh]] = defaultdict(list)
    for number, (body, look, surface, position, rotation) in enumerate(_surfaces(model, data)):
        anchor = _anchor(model, body)
        placed = surface.moved(position, rotation)
        if anchor == 0:
            placed = view.facing(placed)
        large = len(placed) > SMALL_MESH
        if large:
            placed = meshes.simplified(placed, CELL)
        if len(placed):
            turn = data.xmat[anchor].reshape(3, 3).T
            # a large one stays alone: it may be beside the frame when the others are not
            found[anchor, look, number if large else -1].append(placed.moved(-turn @ data.xpos[anchor], turn))
    return [Part(body, look, meshes.merged(surfaces)) for (body, look, _), surfaces in found.items()]


def collect_blocks(model: Any, view: View) -> list[Block]:
    """The textured boxes of the static world that may show."""
    data, blocks = _at_rest(model), []
    for geom in filter(lambda geom: _shows(model, geom) and _is_block(model, geom), range(model.ngeom)):
        material, half_size = int(model.geom_matid[geom]), model.geom_size[geom]
        position, rotation = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        if len(view.facing(meshes.box(half_size).moved(position, rotation))):
            blocks.append(Block(position, rotation, half_size, _look(model, material, model.geom_rgba[geom]), material))
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
    """Does the geom keep its texture? The boxes of the static world do: the wood of the table shows at 64×64."""
    boxed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
    return bool(boxed and _anchor(model, model.geom_bodyid[geom]) == 0 and _texture_of(model, model.geom_matid[geom]) >= 0)


def _shape(model: Any, kind: int, size: Array, mesh: int) -> Mesh:
    """The surface of a geom or site in its own frame."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH.value:
        return _stored_mesh(model, mesh)
    if kind == types.mjGEOM_PLANE.value:
        lid = meshes.box(np.array([size[0], size[1], 0.0]))
        return lid.kept(lid.normals[:, 0, 2] > 0)
    solids = {
        types.mjGEOM_BOX.value: lambda: meshes.box(size),
        types.mjGEOM_CYLINDER.value: lambda: meshes.cylinder(size[0], size[1]),
        types.mjGEOM_CAPSULE.value: lambda: meshes.capsule(size[0], size[1]),
        types.mjGEOM_SPHERE.value: lambda: meshes.sphere(size[0]),
    }
    return solids[kind]()


def _stored_mesh(model: Any, mesh: int) -> Mesh:
    """A mesh of a compiled model."""
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(np.float64)
    normals = model.mesh_normal[model.mesh_normaladr[mesh] :].astype(np.float64)
    return Mesh(vertices[model.mesh_face[faces]], normals[model.mesh_facenormal[faces]])


def _look(model: Any, material: int, rgba: Array) -> Look:
    """What MuJoCo would draw a geom or site of this material with."""
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
