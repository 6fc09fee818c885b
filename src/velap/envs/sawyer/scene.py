"""Fast drawing of Meta-World's scenes in software: what a 64×64 frame of the one static camera can show, and nothing else.

What shows was taken from Meta-World's scenes once (`studies/bake_meshes.py`) and is kept in `assets/drawing.npz`. A
`SawyerScene` makes a drawing model of it, with the lights of the physics model; a frame copies body poses into it.

Letters: B bodies that carry something visible, P parts, F triangles, W texture width.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.pixels import FRAME_SIZE, Frame, shared_renderer
from velap.envs.sawyer.view import View

VIEW = View(position=(1.08, 0.03, 0.93), target=(0.02, 0.65, 0.07), fovy=36.5)
"""ours: the view of all four tasks, right side up, from the right of the arm and above: it shows the fronts of the objects
and ways along all three axes. Finger tips at |x| ≤ 0.4, 0.34 ≤ y ≤ 0.8, 0.01 ≤ z ≤ 0.3 m and objects beyond them fill it."""
ASSETS = Path(__file__).with_name("assets") / "drawing.npz"
"""The baked drawings of all tasks."""
SHOWN_GROUPS = 3
"""MuJoCo shows geom groups 0 to 2 unless told otherwise; Meta-World keeps its collision geoms in group 4."""

_HIDDEN_GROUP = SHOWN_GROUPS
_numbers = count()


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

    body: str
    """Body of the Meta-World model that carries it; empty for the world."""
    look: Look
    corners: NDArray[np.float32]
    """[F, 3, 3] (triangle, corner, xyz) in the frame of that body [m], counter-clockwise from outside."""
    normals: NDArray[np.float32]
    """[F, 3, 3] unit normal at each corner."""


@dataclass(frozen=True)
class Block:
    """A box of the static world that keeps its texture."""

    position: NDArray[np.float64]
    """[3] [m]"""
    rotation: NDArray[np.float64]
    """[3, 3]"""
    half_size: NDArray[np.float64]
    """[3] [m]"""
    look: Look
    texture: NDArray[np.uint8]
    """[W, W, 3], on all six sides."""


@dataclass(frozen=True)
class Drawing:
    """All that a task shows."""

    parts: tuple[Part, ...]
    """In the order of Meta-World's geoms."""
    blocks: tuple[Block, ...]


def save_drawings(path: Path, drawings: Mapping[str, Drawing]) -> None:
    """Write the drawings of several tasks; a surface or texture that they share is kept once."""
    arrays: dict[bytes, NDArray[Any]] = {}

    def kept(array: NDArray[Any]) -> str:
        arrays[array.tobytes()] = array
        return f"array{list(arrays).index(array.tobytes())}"

    index = {
        name: {
            "parts": [{"body": part.body, "look": asdict(part.look), "corners": kept(part.corners),
                       "normals": kept(part.normals)} for part in drawing.parts],
            "blocks": [{"position": block.position.tolist(), "rotation": block.rotation.tolist(),
                        "half_size": block.half_size.tolist(), "look": asdict(block.look), "texture": kept(block.texture)}
                       for block in drawing.blocks],
        }
        for name, drawing in drawings.items()
    }
    named = {f"array{number}": array for number, array in enumerate(arrays.values())}
    np.savez_compressed(path, allow_pickle=False, index=np.array(json.dumps(index)), **named)


def load_drawing(task: str, path: Path = ASSETS) -> Drawing:
    """The baked drawing of a task, by the name of its `assets`."""

    def look(stored: dict[str, Any]) -> Look:
        return Look(**{**stored, "rgba": tuple(stored["rgba"]), "tint": tuple(stored["tint"])})

    with np.load(path, allow_pickle=False) as file:
        stored = json.loads(str(file["index"]))[task]
        parts = tuple(Part(part["body"], look(part["look"]), file[part["corners"]], file[part["normals"]])
                      for part in stored["parts"])
        blocks = tuple(Block(np.array(block["position"]), np.array(block["rotation"]), np.array(block["half_size"]),
                             look(block["look"]), file[block["texture"]]) for block in stored["blocks"])
    return Drawing(parts, blocks)


class SawyerScene:
    """Draws states of one task's Meta-World model; one thread at a time. Models that differ in poses only may share it."""

    def __init__(self, drawing: Drawing, model: Any, view: View = VIEW) -> None:
        """Bodies right below the world, except table, wall and base, may be moved between frames (`model.body_pos`)."""
        self.view = view
        names = {part.body for part in drawing.parts} - {""}
        self._bodies: NDArray[np.int64] = np.array(sorted(model.body(name).id for name in names), dtype=np.int64)
        self.model = _drawing_model(drawing, model, [model.body(body).name for body in self._bodies], view)
        self._data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self._data)
        self._assets = f"sawyer scene {next(_numbers)}"

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]. The physics model is never changed."""
        drawn = self._data
        drawn.mocap_pos[:] = data.xpos[self._bodies]
        drawn.mocap_quat[:] = data.xquat[self._bodies]
        mujoco.mj_kinematics(self.model, drawn)
        # a part whose bounding box is beside the frame would only cost: its group hides it
        rotations = drawn.geom_xmat.reshape(-1, 3, 3)
        centres = drawn.geom_xpos + np.einsum("gij,gj->gi", rotations, self.model.geom_aabb[:, :3])
        self.model.geom_group[:] = _HIDDEN_GROUP * self.view.beside(centres, rotations, self.model.geom_aabb[:, 3:])
        return shared_renderer(self._assets, self.model, size).draw(self.model, drawn)


def _drawing_model(drawing: Drawing, model: Any, bodies: list[str], view: View) -> Any:
    """A model of the parts on mocap bodies, in the order of `bodies`, with the textured boxes, the lights and the camera."""
    spec = mujoco.MjSpec()
    spec.visual.quality.numquads = 1  # a side of a box needs no raster of vertices under lights from afar
    carriers = {body: spec.worldbody.add_body(mocap=True) for body in bodies}
    # geoms are drawn in the order of their bodies: what is behind comes last, so that hidden pixels cost nothing
    carriers[""] = spec.worldbody.add_body()
    for number, block in enumerate(drawing.blocks):
        name = f"block{number}"
        _add_material(spec, name, block.look, block.texture)
        geom = carriers[""].add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=block.half_size, pos=block.position,
                                     material=name, contype=0, conaffinity=0)
        mujoco.mju_mat2Quat(geom.quat, block.rotation.ravel())
    for number, part in reversed(list(enumerate(drawing.parts))):
        _add_part(spec, carriers[part.body], f"part{number}", part)
    _add_lights(spec, model)
    camera = spec.worldbody.add_camera(pos=view.position, fovy=view.fovy)
    mujoco.mju_mat2Quat(camera.quat, view.axes.T.ravel())
    compiled = spec.compile()
    for field in ("ambient", "diffuse", "specular", "active"):
        setattr(compiled.vis.headlight, field, getattr(model.vis.headlight, field))
    compiled.stat.extent, compiled.vis.map.znear, compiled.vis.map.zfar = 1.0, 0.05, 10.0  # near and far plane [m]
    return compiled


def _add_part(spec: Any, body: Any, name: str, part: Part) -> None:
    """A geom with the part's surface and look."""
    stored = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    stored.uservert = part.corners.ravel()
    stored.usernormal = part.normals.ravel()
    stored.userface = np.arange(3 * len(part.corners), dtype=np.int32)
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
