"""Fast drawing of Meta-World's scenes in software: what a 64×64 frame of the one static camera can show, and nothing else.

A `SawyerScene` reads the geometry of a compiled Meta-World model once, simplifies it, merges what is rigidly attached and
looks the same, and keeps a drawing model of its own; a frame copies body poses into it. The physics model is never changed.

Letters: F triangles, P parts.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs import meshes
from velap.envs.gl import mujoco
from velap.envs.meshes import Array, Mesh
from velap.envs.pixels import FRAME_SIZE, Frame, shared_renderer


@dataclass(frozen=True)
class View:
    """A perspective camera that stands still."""

    position: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """What it looks at [m]."""
    fovy: float
    """Vertical field of view [degrees]."""

    def axes(self) -> Array:
        """Right, up and backward [3, 3], unit rows."""
        back = np.subtract(self.position, self.target)
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])


VIEW = View(position=(1.08, 0.03, 0.93), target=(0.02, 0.65, 0.07), fovy=36.5)
"""ours: the view of all four tasks, right side up, from the right of the arm and above: it shows the fronts of the objects and
the ways along all three axes. Finger tips at |x| ≤ 0.4, 0.34 ≤ y ≤ 0.8, 0.01 ≤ z ≤ 0.3 m and objects beyond them fill it."""

CELL = 0.02
"""Side of the cubes within which vertices of a mesh are drawn together [m]. ours: 1.3 px at the middle of the view."""

SMALL_MESH = 1000
"""Meshes of up to so many triangles stay as they are. ours: those of all objects; the arm's have 2,400 and more."""

STATIC_BODIES = ("tablelink", "RetainingWall", "base")
"""Bodies below the world that stand where they are in every episode: of these only what faces the camera is kept."""

TEXTURE_SIZE = 128
"""Side of a texture, at most [texels]. ours: the table is 70 px wide in the frame."""

SITES = ("rightEndEffector", "leftEndEffector")
"""Sites that are drawn, red balls on the finger tips. The others mark goals, which a camera does not see."""

_HIDDEN_GROUP = 5
_SHOWN_GROUPS = 3
"""MuJoCo shows geom groups 0 to 2 unless told otherwise; Meta-World keeps its collision geoms in group 4."""


@dataclass(frozen=True)
class Look:
    """Colour and shine of a part."""

    rgba: tuple[float, ...]
    specular: float
    shininess: float
    emission: float
    tint: tuple[int, ...] = ()
    """Mean colour of its texture. OpenGL clamps the light before it multiplies by a texture, hence not one with rgba."""


def _look(model: Any, material: int, rgba: Array) -> Look:
    """What MuJoCo would draw a geom or site of this material with."""
    plain = tuple(float(value) for value in rgba)
    if material < 0:
        return Look(plain, 0.5, 0.5, 0.0)
    if plain == (0.5, 0.5, 0.5, 1.0):  # MuJoCo's sign of a geom without a colour of its own
        plain = tuple(float(value) for value in model.mat_rgba[material])
    shine = model.mat_specular[material], model.mat_shininess[material], model.mat_emission[material]
    texture = _texture_of(model, material)
    tint = () if texture < 0 else tuple(int(value) for value in _pixels(model, texture).mean((0, 1)).round())
    return Look(plain, *(float(value) for value in shine), tint)


def _texture_of(model: Any, material: int) -> int:
    """The number of a material's texture, -1 without."""
    return int(model.mat_texid[material].max()) if material >= 0 else -1


def _pixels(model: Any, texture: int) -> NDArray[np.uint8]:
    """A texture [H, W, channels]."""
    shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    start = int(model.tex_adr[texture])
    return model.tex_data[start : start + shape[0] * shape[1] * shape[2]].reshape(shape)


def _shape(model: Any, kind: int, size: Array, mesh: int) -> Mesh | None:
    """The surface of a geom or site in its own frame; None for what is not drawn."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH.value:
        surface = _stored_mesh(model, mesh)
        return surface if len(surface) <= SMALL_MESH else meshes.simplified(surface, CELL)
    if kind == types.mjGEOM_BOX.value:
        return meshes.box(size)
    if kind == types.mjGEOM_CYLINDER.value:
        return meshes.cylinder(size[0], size[1])
    if kind == types.mjGEOM_CAPSULE.value:
        return meshes.capsule(size[0], size[1])
    if kind == types.mjGEOM_SPHERE.value:
        return meshes.sphere(size[0])
    if kind == types.mjGEOM_PLANE.value:
        lid = meshes.box(np.array([size[0], size[1], 0.0]))
        return lid.kept((lid.normals[:, :, 2] > 0).all(1))
    return None


def _stored_mesh(model: Any, mesh: int) -> Mesh:
    """A mesh of a compiled model."""
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(np.float64)
    normals = model.mesh_normal[model.mesh_normaladr[mesh] :].astype(np.float64)
    return Mesh(vertices[model.mesh_face[first : first + count]], normals[model.mesh_facenormal[first : first + count]])


def _anchor(model: Any, body: int) -> int:
    """The body whose pose carries this one: the nearest ancestor that a joint moves, else the one right below the world.
    The world itself carries STATIC_BODIES."""
    anchor = int(model.body_weldid[body]) or int(model.body_rootid[body])
    return 0 if model.body(anchor).name in STATIC_BODIES else anchor


def _collect(model: Any) -> dict[tuple[int, Look], Mesh]:
    """All that shows, by the body that carries it and by its look, in that body's frame."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found: dict[tuple[int, Look], list[Mesh]] = defaultdict(list)

    def add(body: int, look: Look, surface: Mesh | None, position: Array, rotation: Array) -> None:
        if surface is None or not len(surface) or look.rgba[3] == 0:
            return
        anchor = _anchor(model, body)
        origin, turn = data.xpos[anchor], data.xmat[anchor].reshape(3, 3)
        found[anchor, look].append(surface.moved(turn.T @ (position - origin), turn.T @ rotation.reshape(3, 3)))

    for geom in range(model.ngeom):
        if model.geom_group[geom] < _SHOWN_GROUPS and model.geom_rgba[geom][3] > 0 and not _is_patterned(model, geom):
            surface = _shape(model, model.geom_type[geom], model.geom_size[geom], model.geom_dataid[geom])
            look = _look(model, model.geom_matid[geom], model.geom_rgba[geom])
            add(model.geom_bodyid[geom], look, surface, data.geom_xpos[geom], data.geom_xmat[geom])
    for site in range(model.nsite):
        if model.site(site).name in SITES:
            look = _look(model, model.site_matid[site], model.site_rgba[site])
            surface = _shape(model, model.site_type[site], model.site_size[site], -1)
            add(model.site_bodyid[site], look, surface, data.site_xpos[site], data.site_xmat[site])
    return {key: meshes.merged(parts) for key, parts in found.items()}


def _is_patterned(model: Any, geom: int) -> bool:
    """Does the geom keep its texture? The boxes of the static world do: the wood of the table shows at 64×64."""
    boxed = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
    return bool(boxed and _anchor(model, model.geom_bodyid[geom]) == 0 and _texture_of(model, model.geom_matid[geom]) >= 0)


def facing(mesh: Mesh, view: View) -> Mesh:
    """The triangles (in the world's frame) that turn their front to the camera and are not wholly beside the frame."""
    relative = mesh.corners - np.array(view.position)
    front = (meshes.face_normals(mesh.corners) * relative[:, 0]).sum(1) < 0
    across, up, back = np.moveaxis(relative @ view.axes().T, -1, 0)
    depth = -back * np.tan(np.radians(view.fovy / 2))
    beside = (across > depth).all(1) | (across < -depth).all(1) | (up > depth).all(1) | (up < -depth).all(1)
    return mesh.kept(front & ~beside)


class SawyerScene:
    """Draws the states of one compiled Meta-World model. Models that differ in poses only may share it."""

    def __init__(self, model: Any, view: View = VIEW) -> None:
        """Bodies right below the world may be moved between frames (`model.body_pos`), except STATIC_BODIES."""
        self.view = view
        spec = mujoco.MjSpec()
        anchors: dict[int, Any] = {}
        for number, ((anchor, look), mesh) in enumerate(_collect(model).items()):
            if anchor and anchor not in anchors:
                anchors[anchor] = spec.worldbody.add_body(mocap=True)
            body, mesh = (anchors[anchor], mesh) if anchor else (spec.worldbody, facing(mesh, view))
            if not len(mesh):
                continue
            _add_part(spec, body, f"part{number}", look, mesh)
        self._bodies: NDArray[np.int64] = np.array(list(anchors), dtype=np.int64)
        _add_patterned(spec, model, view)
        _add_lights(spec, model)
        camera = spec.worldbody.add_camera(pos=view.position, fovy=view.fovy)
        mujoco.mju_mat2Quat(camera.quat, view.axes().T.ravel())
        self.model = spec.compile()
        visual, source = self.model.vis, model.vis
        for field in ("ambient", "diffuse", "specular", "active"):
            setattr(visual.headlight, field, getattr(source.headlight, field))
        self.model.stat.extent, self.model.vis.map.znear, self.model.vis.map.zfar = 1.0, 0.05, 10.0
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        self._sides = _frustum(view)
        self._assets = f"sawyer scene {next(_numbers)}"

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]."""
        drawn = self._data
        drawn.mocap_pos[:] = data.xpos[self._bodies]
        drawn.mocap_quat[:] = data.xquat[self._bodies]
        mujoco.mj_kinematics(self.model, drawn)
        # parts whose bounding ball is beside the frame would only cost: a hidden group takes them out
        distances = (drawn.geom_xpos - self.view.position) @ self._sides
        beside = (distances < -self.model.geom_rbound[:, None]).any(1)
        self.model.geom_group[:] = np.where(beside, _HIDDEN_GROUP, 0)
        return shared_renderer(self._assets, self.model, size).draw(self.model, drawn)


_numbers = count()


def _frustum(view: View) -> Array:
    """Unit normals [3, 4] of the four sides of what the camera sees, pointing inwards."""
    right, up, back = view.axes()
    half = np.radians(view.fovy / 2)
    return np.stack([sign * np.cos(half) * side - np.sin(half) * back for side in (right, up) for sign in (-1.0, 1.0)], axis=1)


def _add_part(spec: Any, body: Any, name: str, look: Look, mesh: Mesh) -> None:
    """A geom of that mesh and look."""
    stored = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    stored.uservert = mesh.corners.ravel()
    stored.usernormal = mesh.normals.ravel()
    stored.userface = np.arange(3 * len(mesh), dtype=np.int32)
    _add_material(spec, name, look, np.broadcast_to(np.array(look.tint, np.uint8), (1, 1, 3)) if look.tint else None)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0)


def _add_material(spec: Any, name: str, look: Look, pixels: NDArray[np.uint8] | None) -> None:
    """A material, and its cube texture with all six sides alike, pixels[W, W, 3]."""
    material = spec.add_material(name=name, rgba=look.rgba, specular=look.specular, shininess=look.shininess, emission=look.emission)
    if pixels is not None:
        side = len(pixels)
        texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_CUBE, width=side, height=6 * side, nchannel=3)
        texture.data = np.tile(pixels, (6, 1, 1)).tobytes()
        layers = [""] * mujoco.mjtTextureRole.mjNTEXROLE
        layers[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.textures = layers


def _add_patterned(spec: Any, model: Any, view: View) -> None:
    """The textured boxes of the static world, as far as they show."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in (geom for geom in range(model.ngeom) if _is_patterned(model, geom)):
        position, rotation, size = data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom]
        if model.geom_group[geom] >= _SHOWN_GROUPS or not len(facing(meshes.box(size).moved(position, rotation.reshape(3, 3)), view)):
            continue
        material = int(model.geom_matid[geom])
        name = f"material{material}"
        if spec.material(name) is None:
            look = _look(model, material, model.geom_rgba[geom])
            _add_material(spec, name, look, _shrunk(_pixels(model, _texture_of(model, material))))
        placed = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=position, material=name)
        placed.contype = placed.conaffinity = 0
        mujoco.mju_mat2Quat(placed.quat, rotation)


def _shrunk(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The first side of a cube texture [6 W, W, 3] as [W', W', 3], W' at most TEXTURE_SIZE."""
    width = pixels.shape[1]
    block = max(1, -(-width // TEXTURE_SIZE))
    side = width // block
    blocks = pixels[: side * block, : side * block].reshape(side, block, side, block, -1)
    return blocks.mean((1, 3)).round().astype(np.uint8)


def _add_lights(spec: Any, model: Any) -> None:
    """The lights that hang on the world."""
    for light in range(model.nlight):
        spec.worldbody.add_light(
            pos=model.light_pos[light],
            dir=model.light_dir[light],
            directional=bool(model.light_directional[light]),
            castshadow=False,
            ambient=model.light_ambient[light],
            diffuse=model.light_diffuse[light],
            specular=model.light_specular[light],
            attenuation=model.light_attenuation[light],
        )
