"""Fast drawing of Meta-World's scenes in software: what a 64×64 frame of the one static camera can show, and nothing else.

A `SawyerScene` reads the surface of a compiled Meta-World model once (`sawyer_parts`) and keeps a drawing model of its own
with the same lights; a frame copies body poses into it. The physics model is never changed.

Letters: B bodies that carry something visible, P parts.
"""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.pixels import FRAME_SIZE, Frame, shared_renderer
from velap.envs.sawyer.parts import SHOWN_GROUPS, SITES, Look, Part, collect_blocks, collect_parts, shrunk_texture
from velap.envs.sawyer.view import View

VIEW = View(position=(1.08, 0.03, 0.93), target=(0.02, 0.65, 0.07), fovy=36.5)
"""ours: the view of all four tasks, right side up, from the right of the arm and above: it shows the fronts of the objects
and ways along all three axes. Finger tips at |x| ≤ 0.4, 0.34 ≤ y ≤ 0.8, 0.01 ≤ z ≤ 0.3 m and objects beyond them fill it."""

_HIDDEN_GROUP = SHOWN_GROUPS
_numbers = count()


class SawyerScene:
    """Draws states of one compiled Meta-World model; one thread at a time. Models that differ in poses only may share it."""

    def __init__(self, model: Any, view: View = VIEW) -> None:
        """Bodies right below the world may be moved between frames (`model.body_pos`), but for `STATIC_BODIES`."""
        self.view = view
        parts = collect_parts(model, view)
        self._bodies: NDArray[np.int64] = np.array(sorted({part.body for part in parts} - {0}), dtype=np.int64)
        self.model = _drawing_model(model, parts, self._bodies.tolist(), view)
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        self._assets = f"sawyer scene {next(_numbers)}"

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]."""
        drawn = self._data
        drawn.mocap_pos[:] = data.xpos[self._bodies]
        drawn.mocap_quat[:] = data.xquat[self._bodies]
        mujoco.mj_kinematics(self.model, drawn)
        # a part whose bounding box is beside the frame would only cost: its group hides it
        rotations = drawn.geom_xmat.reshape(-1, 3, 3)
        centres = drawn.geom_xpos + np.einsum("gij,gj->gi", rotations, self.model.geom_aabb[:, :3])
        self.model.geom_group[:] = _HIDDEN_GROUP * self.view.beside(centres, rotations, self.model.geom_aabb[:, 3:])
        return shared_renderer(self._assets, self.model, size).draw(self.model, drawn)


class OriginalScene:
    """The same view of Meta-World's own geometry, without shadows, reflections and goal marks; slow, to compare with."""

    def __init__(self, model: Any, view: View = VIEW) -> None:
        self.model, self.view = model.__copy__(), view
        for site in range(model.nsite):
            self.model.site_group[site] = 0 if model.site(site).name in SITES else _HIDDEN_GROUP
        self.model.cam_fovy[0] = view.fovy
        self._assets = f"original scene {next(_numbers)}"

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]."""
        state = data.__copy__()
        state.cam_xpos[0], state.cam_xmat[0] = self.view.position, self.view.axes.T.ravel()
        return shared_renderer(self._assets, self.model, size).draw(self.model, state, camera=0)


def _drawing_model(model: Any, parts: list[Part], bodies: list[int], view: View) -> Any:
    """A model of the parts on the mocap bodies `bodies`, the textured boxes, the lights and the camera."""
    spec = mujoco.MjSpec()
    spec.visual.quality.numquads = 1  # a side of a box needs no raster of vertices under lights from afar
    carriers = {body: spec.worldbody.add_body(mocap=True) for body in bodies}
    # geoms are drawn in the order of their bodies: what is behind comes last, so that hidden pixels cost nothing
    carriers[0] = spec.worldbody.add_body()
    for number, block in enumerate(collect_blocks(model, view)):
        name = f"block{number}"
        _add_material(spec, name, block.look, shrunk_texture(model, block.material))
        geom = carriers[0].add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=block.half_size, pos=block.position,
                                       material=name, contype=0, conaffinity=0)
        mujoco.mju_mat2Quat(geom.quat, block.rotation.ravel())
    for number, part in reversed(list(enumerate(parts))):
        _add_part(spec, carriers[part.body], f"part{number}", part)
    _add_lights(spec, model)
    camera = spec.worldbody.add_camera(pos=view.position, fovy=view.fovy)
    mujoco.mju_mat2Quat(camera.quat, view.axes.T.ravel())
    drawing = spec.compile()
    for field in ("ambient", "diffuse", "specular", "active"):
        setattr(drawing.vis.headlight, field, getattr(model.vis.headlight, field))
    drawing.stat.extent, drawing.vis.map.znear, drawing.vis.map.zfar = 1.0, 0.05, 10.0  # near and far plane [m]
    return drawing


def _add_part(spec: Any, body: Any, name: str, part: Part) -> None:
    """A geom with the part's surface and look."""
    stored = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    stored.uservert = part.surface.corners.ravel()
    stored.usernormal = part.surface.normals.ravel()
    stored.userface = np.arange(3 * len(part.surface), dtype=np.int32)
    tint = part.look.tint
    _add_material(spec, name, part.look, np.array(tint, np.uint8).reshape(1, 1, 3) if tint else None)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0)


def _add_material(spec: Any, name: str, look: Look, pixels: NDArray[np.uint8] | None) -> None:
    """A material, and its cube texture with all six sides alike, pixels[W, W, 3]."""
    material = spec.add_material(name=name, rgba=look.rgba, specular=look.specular, shininess=look.shininess,
                                 emission=look.emission)
    if pixels is not None:
        side = len(pixels)
        texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_CUBE, width=side, height=6 * side, nchannel=3)
        texture.data = np.tile(pixels, (6, 1, 1)).tobytes()
        layers = [""] * mujoco.mjtTextureRole.mjNTEXROLE
        layers[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.textures = layers


def _add_lights(spec: Any, model: Any) -> None:
    """The lights that hang on the world."""
    for light in range(model.nlight):
        spec.worldbody.add_light(
            pos=model.light_pos[light], dir=model.light_dir[light], directional=bool(model.light_directional[light]),
            castshadow=False, ambient=model.light_ambient[light], diffuse=model.light_diffuse[light],
            specular=model.light_specular[light], attenuation=model.light_attenuation[light])
