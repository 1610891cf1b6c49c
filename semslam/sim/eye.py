"""What a camera sees in a simulated home: colour, depth, instances, classes, drawn by MuJoCo Warp on the CPU.

One ray a pixel, textures, hard shadows of the lights that cast them. Always on the device `cpu`, so that the same home
and pose give the same bytes with or without a graphics card.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from semslam.geometry.camera import Camera
from semslam.labels import FIRST_OBJECT, FREE_FLOOR, OBSTACLE, UNOBSERVED
from semslam.sim.engine import start_engine
from semslam.sim.home import (
    FLOOR_KINDS,
    SKY_KINDS,
    Array,
    Colour,
    Fixture,
    Home,
    Light,
    Look,
    Mesh,
    Part,
    Piece,
    Placed,
    Room,
)
from semslam.sim.shapes import box, merge, transformed
from semslam.sim.textures import SIZE, tile

AMBIENT = 0.36
"""Share of its colour that a surface shows without any light of the home."""
_HEADLIGHT = 0.10
"""A weak light at the camera keeps dark corners readable."""
_SHADOW = 0.35
"""Share of a light that reaches what it does not see: stands for light that is thrown about."""
_WALKER = "walker"


@dataclass(frozen=True, eq=False)
class Sight:
    """One view, without any noise."""

    rgb: NDArray[np.uint8]
    """(H, W, 3)."""
    depth_m: NDArray[np.float32]
    """(H, W) along the optical axis; 0 where there is nothing."""
    instances: NDArray[np.uint16]
    """(H, W) `Placed.instance` or the walker's; 0 is the building and loose things."""
    classes: NDArray[np.uint8]
    """(H, W) ids of `semslam.labels`: ceiling and nothing are unobserved, floor and rugs free floor, walls, doors,
    people and loose things obstacle, then the object classes in the order of `Home.classes`."""
    normals_cos: NDArray[np.float32]
    """(H, W) cosine between the line of sight and the surface's normal, 0 (grazing) to 1 (head-on)."""


class Eye:
    """A camera in a home. Building one costs seconds, a look about 0.4 s at 640x480.

    Args:
        camera: pinhole, square pixels, principal point in the middle.

    Raises:
        ValueError: another kind of camera.
    """

    def __init__(self, home: Home, camera: Camera) -> None:
        _require_plain_pinhole(camera)
        self.home, self.camera = home, camera
        self._model, geoms = build_model(home, camera)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._instances = np.array([0, *(instance for instance, _ in geoms)], np.uint16)
        self._classes = np.array([UNOBSERVED, *(label for _, label in geoms)], np.uint8)
        self._rays = _rays(camera)
        start_engine()
        import mujoco_warp
        import warp

        self._warp, self._render = warp, mujoco_warp
        with warp.ScopedDevice("cpu"):
            self._device_model = mujoco_warp.put_model(self._model)
            self._device_data = mujoco_warp.put_data(self._model, self._data)
            self._context = mujoco_warp.create_render_context(
                self._model,
                1,
                cam_res=(camera.width, camera.height),
                render_rgb=True,
                render_depth=True,
                render_seg=True,
                use_shadows=True,
                use_fast_math=False,
                shadow_light_fraction=_SHADOW,
                enable_per_light_ambient=False,
            )

    def look(self, world_from_camera: Array, time_s: float = 0.0) -> Sight:
        """What the camera sees from a pose (4, 4) of its optical frame; `time_s` places who walks about."""
        warp = self._warp
        with warp.ScopedDevice("cpu"):
            self._place_walker(time_s)
            self._place_camera(world_from_camera)
            self._render.render(self._device_model, self._device_data, self._context)
            warp.synchronize()
            packed = self._context.rgb_data.numpy()[0]
            depth = self._context.depth_data.numpy()[0]
            hits = self._context.seg_data.numpy()[0][:, 0]
        return self._sight(packed, depth, hits)

    def _sight(self, packed: NDArray[np.uint32], depth: NDArray[np.float32], hits: NDArray[np.int32]) -> Sight:
        shape = self.camera.height, self.camera.width
        rgb = np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], -1).astype(np.uint8)
        depth_m = np.ascontiguousarray(depth, np.float32).reshape(shape)
        hits = hits.reshape(shape)
        return Sight(
            rgb.reshape(*shape, 3),
            depth_m,
            self._instances[hits + 1],
            self._classes[hits + 1],
            _facing(depth_m, hits, self._rays),
        )

    def _place_camera(self, world_from_camera: Array) -> None:
        pose = np.asarray(world_from_camera, np.float64)
        turned = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # MuJoCo's cameras look along -z with y up
        self._device_data.cam_xpos.assign(pose[None, None, :3, 3].astype(np.float32))
        self._device_data.cam_xmat.assign(turned[None, None].astype(np.float32))

    def _place_walker(self, time_s: float) -> None:
        if self.home.walker is None:
            return
        x, y, heading = self.home.walker.pose(time_s)
        self._data.mocap_pos[0] = x, y, 0.0
        self._data.mocap_quat[0] = math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)
        mujoco.mj_kinematics(self._model, self._data)
        self._device_data.geom_xpos.assign(self._data.geom_xpos[None].astype(np.float32))
        self._device_data.geom_xmat.assign(self._data.geom_xmat.reshape(1, -1, 3, 3).astype(np.float32))
        self._render.refit_bvh(self._device_model, self._device_data, self._context)


def build_model(home: Home, camera: Camera) -> tuple[mujoco.MjModel, list[tuple[int, int]]]:
    """The home as a MuJoCo model that is only looked at; of every geom its instance and label."""
    spec = mujoco.MjSpec()
    _settings(spec)
    spec.worldbody.add_camera(
        name="eye", resolution=[camera.width, camera.height], fovy=math.degrees(_field_of_view(camera))
    )
    for light in home.lights:
        _add_light(spec, light)
    builder = _Builder(spec)
    for fixture in home.fixtures:
        builder.add(spec.worldbody, fixture.parts, 0, _fixture_label(fixture))
    for item in home.objects:
        builder.add(spec.worldbody, _stand(item), item.instance, FIRST_OBJECT + item.class_id)
    if home.walker is not None:
        body = spec.worldbody.add_body(name=_WALKER, mocap=True)
        builder.add(body, home.walker.piece.parts, home.walker.instance, OBSTACLE)
    builder.finish()
    model = spec.compile()
    labels = dict(builder.geoms)
    return model, [labels[model.geom(index).name] for index in range(model.ngeom)]


def studio(pieces: Sequence[Piece], *, wall_m: float = 1.5) -> Home:
    """A bare stage for looking at furniture: pieces in a row along y on a floor, a wall behind them at x = -wall_m."""
    grey, wood = Look("paint", ((0.80, 0.79, 0.76),), 2.0), Look("planks", ((0.62, 0.47, 0.32),), 1.4)
    y, objects = 0.0, []
    for index, item in enumerate(pieces):
        y += item.width_m / 2 + 0.2
        objects.append(Placed(index + 1, item, 0.0, y, 0.0))
        y += item.width_m / 2 + 0.2
    floor = Fixture("floor", (Part(box((-8, -8, -0.05), (8, y + 8, 0.0)), wood),))
    wall = Fixture("wall", (Part(box((-wall_m - 0.1, -8, 0), (-wall_m, y + 8, 2.6)), grey),))
    lights = (
        Light("point", (2.5, y / 2 - 1.5, 2.4), (0, 0, -1), (0.45, 0.44, 0.42), shadow=True),
        Light("point", (2.0, y / 2 + 2.5, 2.4), (0, 0, -1), (0.22, 0.23, 0.25)),
        Light("sun", (0, 0, 5), (-0.4, 0.5, -0.8), (0.12, 0.12, 0.12)),
        Light("sun", (0, 0, 5), (0, 0, -1), (0, 0, 0)),
    )
    outline = np.array([[-wall_m, -8], [8, -8], [8, y + 8], [-wall_m, y + 8]], np.float64)
    room = Room("studio", (-wall_m, -8.0), (8.0, y + 8))
    return Home(0, "studio", 0, (room,), (outline,), 2.6, tuple(objects), (floor, wall), lights, (3.0, y / 2))


@dataclass(frozen=True)
class _Paint:
    """Surfaces of one colour that differ in nothing else; their colours share one texture, a swatch each."""

    shine: float
    glow: float
    sheet: int
    """Number of the texture among those of the same shine and glow: each has room for 256 colours."""


_EDGE = 16
"""Swatches along one edge of a texture; few and large meshes are drawn faster than many small ones."""


class _Builder:
    """Adds meshes to a model and remembers what they are."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self._spec = spec
        self._materials: dict[Look | _Paint, str] = {}
        self._swatches: dict[tuple[float, float], list[Colour]] = {}
        self.geoms: list[tuple[str, tuple[int, int]]] = []

    def add(self, body: mujoco.MjsBody, parts: Sequence[Part], instance: int, label: int) -> None:
        """Add the parts to a body, one geom a look; all looks of one colour count as one."""
        groups: dict[Look | _Paint, list[Mesh]] = {}
        for part in parts:
            if part.look.pattern == "plain":
                paint, mesh = self._painted(part)
                groups.setdefault(paint, []).append(mesh)
            else:
                scaled = replace(part.mesh, uv=(part.mesh.uv / part.look.tile_m).astype(np.float32))
                groups.setdefault(part.look, []).append(scaled)
        for look, meshes in groups.items():
            self._add_geom(body, merge(meshes), self._material(look), (instance, label))

    def finish(self) -> None:
        """Draw the textures of the swatches, now that all colours are known."""
        for look, name in self._materials.items():
            if isinstance(look, _Paint):
                colours = self._swatches[look.shine, look.glow][look.sheet * _EDGE**2 :][: _EDGE**2]
                self._spec.texture(name).data = _swatch_sheet(colours).tobytes()

    def _painted(self, part: Part) -> tuple[_Paint, Mesh]:
        """The paint of a one-coloured part, and its mesh with every vertex on its swatch."""
        shine, glow = round(part.look.shine, 1), round(part.look.glow, 1)
        colours = self._swatches.setdefault((shine, glow), [])
        if part.look.colours[0] not in colours:
            colours.append(part.look.colours[0])
        sheet, place = divmod(colours.index(part.look.colours[0]), _EDGE**2)
        row, column = divmod(place, _EDGE)
        centre = np.array([(column + 0.5) / _EDGE, (row + 0.5) / _EDGE], np.float32)
        return _Paint(shine, glow, sheet), replace(part.mesh, uv=np.broadcast_to(centre, part.mesh.uv.shape))

    def _add_geom(self, body: mujoco.MjsBody, shape: Mesh, material: str, meaning: tuple[int, int]) -> None:
        name = f"g{len(self.geoms)}"
        mesh = self._spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        corners = shape.faces.astype(np.int32).ravel()
        mesh.uservert = shape.vertices.astype(np.float64).ravel()
        mesh.usernormal = shape.normals.astype(np.float64).ravel()
        mesh.usertexcoord = shape.uv.astype(np.float64).ravel()
        mesh.userface = mesh.userfacenormal = mesh.userfacetexcoord = corners
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=material,
            contype=0,
            conaffinity=0,
        )
        self.geoms.append((name, meaning))

    def _material(self, look: Look | _Paint) -> str:
        if look not in self._materials:
            name = f"m{len(self._materials)}"
            texture = self._spec.add_texture(
                name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=SIZE, height=SIZE, nchannel=3
            )
            if isinstance(look, Look):
                texture.data = tile(look).tobytes()
            material = self._spec.add_material(
                name=name, specular=look.shine, shininess=0.5, emission=look.glow, texrepeat=[1, 1]
            )
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
            self._materials[look] = name
        return self._materials[look]


def _swatch_sheet(colours: Sequence[Colour]) -> NDArray[np.uint8]:
    """(SIZE, SIZE, 3) squares of one colour each, row by row."""
    cells = np.zeros((_EDGE * _EDGE, 3))
    cells[: len(colours)] = colours
    grid = np.round(np.clip(cells, 0, 1) * 255).astype(np.uint8).reshape(_EDGE, _EDGE, 3)
    return grid.repeat(SIZE // _EDGE, 0).repeat(SIZE // _EDGE, 1)


def _settings(spec: mujoco.MjSpec) -> None:
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 100.0
    spec.visual.headlight.active = 1
    spec.visual.headlight.ambient = [AMBIENT] * 3
    spec.visual.headlight.diffuse = [_HEADLIGHT] * 3
    spec.visual.headlight.specular = [0.0] * 3


def _add_light(spec: mujoco.MjSpec, light: Light) -> None:
    kinds = {"point": mujoco.mjtLightType.mjLIGHT_POINT, "sun": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL}
    spec.worldbody.add_light(
        type=kinds[light.kind],
        pos=light.position,
        dir=light.direction,
        diffuse=light.colour,
        specular=[0.3 * value for value in light.colour],
        ambient=[0.0] * 3,
        attenuation=light.fade,
        castshadow=light.shadow,
    )


def _fixture_label(fixture: Fixture) -> int:
    if fixture.kind in FLOOR_KINDS:
        return FREE_FLOOR
    return UNOBSERVED if fixture.kind in SKY_KINDS else OBSTACLE


def _stand(item: Placed) -> list[Part]:
    """The parts of an object where it stands."""
    where = (item.x_m, item.y_m, item.z_m)
    return [Part(transformed(part.mesh, where, item.yaw_rad), part.look) for part in item.piece.parts]


def _require_plain_pinhole(camera: Camera) -> None:
    middle = (camera.width - 1) / 2, (camera.height - 1) / 2
    if camera.distortion or abs(camera.fx - camera.fy) > 1e-9 or not np.allclose((camera.cx, camera.cy), middle):
        raise ValueError("the simulated eye is a pinhole with square pixels and the principal point in the middle")


def _field_of_view(camera: Camera) -> float:
    """Upright field of view, radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def _rays(camera: Camera) -> NDArray[np.float32]:
    """(H, W, 3) lines of sight in the optical frame, one metre along the axis."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(columns.shape)]
    return np.stack(rays, -1).astype(np.float32)


def _facing(depth_m: NDArray[np.float32], hits: NDArray[np.int32], rays: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) cosine between line of sight and normal, from differences of depth between neighbours on one surface."""
    points = rays * depth_m[..., None]
    across, down = _difference(points, hits, 1), _difference(points, hits, 0)
    normals = np.cross(across, down)
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(rays, axis=-1)
    cos = np.abs(np.einsum("ijk,ijk->ij", normals, rays)) / np.maximum(lengths, np.float32(1e-12))
    return np.asarray(np.clip(cos, 0, 1), np.float32)


def _difference(points: NDArray[np.float32], hits: NDArray[np.int32], axis: int) -> NDArray[np.float32]:
    """To the next pixel along an axis, or from the one before where the next lies on another surface."""
    ahead = np.diff(points, axis=axis)
    same = np.diff(hits, axis=axis) == 0
    pad = [(0, 0)] * 3
    pad[axis] = (0, 1)
    after, after_same = np.pad(ahead, pad, mode="edge"), np.pad(same, pad[:2])
    pad[axis] = (1, 0)
    before = np.pad(ahead, pad, mode="edge")
    return np.where(after_same[..., None], after, before)
