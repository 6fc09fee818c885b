"""Fast drawing of Meta-World's scenes in software: what a 64×64 frame of the one static camera can show, and nothing else.

A `SawyerScene` reads the geometry of a compiled Meta-World model once, simplifies it, merges what is rigidly attached and
looks the same, and keeps a drawing model of its own; a frame copies body poses into it. The physics model is never changed.

Letters: F triangles, P parts.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs import meshes
from velap.envs.gl import mujoco
from velap.envs.meshes import Array, Mesh
from velap.envs.pixels import FRAME_SIZE, Frame, Renderer


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


VIEW = View(position=(1.132, 0.083, 1.007), target=(0.068, 0.698, 0.147), fovy=36.9)
"""ours: the view of all four tasks. It is right side up; hand targets of |x| ≤ 0.4, 0.4 ≤ y ≤ 0.95, 0.03 ≤ z ≤ 0.4 m fill it."""

CELL = 0.02
"""Side of the cubes within which vertices of a mesh are drawn together [m]. ours: 1.3 px at the middle of the view."""

STATIC_BODIES = ("tablelink", "RetainingWall", "base")
"""Bodies below the world that stand where they are in every episode: of these only what faces the camera is kept."""

SITES = ("rightEndEffector", "leftEndEffector")
"""Sites that are drawn, red balls on the finger tips. The others mark goals, which a camera does not see."""

_SHOWN_GROUPS = 3
"""MuJoCo shows geom groups 0 to 2 unless told otherwise; Meta-World keeps its collision geoms in group 4."""


@dataclass(frozen=True)
class Look:
    """Colour and shine of a part."""

    rgba: tuple[float, ...]
    specular: float
    shininess: float
    emission: float


def _look(model: Any, material: int, rgba: Array) -> Look:
    """What MuJoCo would draw a geom or site of this material with; textures count with their mean colour."""
    plain = tuple(float(value) for value in rgba)
    if material < 0:
        return Look(plain, 0.5, 0.5, 0.0)
    colour = model.mat_rgba[material].astype(float)
    if plain != (0.5, 0.5, 0.5, 1.0):  # MuJoCo's sign of a geom without a colour of its own
        colour = np.array(plain)
    for texture in model.mat_texid[material]:
        if texture >= 0:
            colour[:3] = colour[:3] * _mean_colour(model, texture)
    shine = model.mat_specular[material], model.mat_shininess[material], model.mat_emission[material]
    return Look(tuple(colour.round(4).tolist()), *(float(value) for value in shine))


def _mean_colour(model: Any, texture: int) -> Array:
    """Mean of a texture [3] in [0, 1]."""
    channels = int(model.tex_nchannel[texture])
    size = int(model.tex_width[texture]) * int(model.tex_height[texture]) * channels
    start = int(model.tex_adr[texture])
    return model.tex_data[start : start + size].reshape(-1, channels)[:, :3].mean(0) / 255


def _shape(model: Any, kind: int, size: Array, mesh: int) -> Mesh | None:
    """The surface of a geom or site in its own frame; None for what is not drawn."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH.value:
        return meshes.simplified(_stored_mesh(model, mesh), CELL)
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
        if model.geom_group[geom] < _SHOWN_GROUPS and model.geom_rgba[geom][3] > 0:
            surface = _shape(model, model.geom_type[geom], model.geom_size[geom], model.geom_dataid[geom])
            look = _look(model, model.geom_matid[geom], model.geom_rgba[geom])
            add(model.geom_bodyid[geom], look, surface, data.geom_xpos[geom], data.geom_xmat[geom])
    for site in range(model.nsite):
        if model.site(site).name in SITES:
            look = _look(model, model.site_matid[site], model.site_rgba[site])
            surface = _shape(model, model.site_type[site], model.site_size[site], -1)
            add(model.site_bodyid[site], look, surface, data.site_xpos[site], data.site_xmat[site])
    return {key: meshes.merged(parts) for key, parts in found.items()}


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
        self._renderers: dict[int, Renderer] = {}

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]."""
        if size not in self._renderers:
            self._renderers[size] = Renderer(self.model, size)
        self._data.mocap_pos[:] = data.xpos[self._bodies]
        self._data.mocap_quat[:] = data.xquat[self._bodies]
        mujoco.mj_kinematics(self.model, self._data)
        return self._renderers[size].draw(self.model, self._data)


def _add_part(spec: Any, body: Any, name: str, look: Look, mesh: Mesh) -> None:
    """A geom of that mesh and look."""
    stored = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    stored.uservert = mesh.corners.ravel()
    stored.usernormal = mesh.normals.ravel()
    stored.userface = np.arange(3 * len(mesh), dtype=np.int32)
    spec.add_material(
        name=name, rgba=look.rgba, specular=look.specular, shininess=look.shininess, emission=look.emission
    )
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0)


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
