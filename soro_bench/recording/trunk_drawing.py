"""The drawing of a trunk: skin, backbone, cables coloured by their tension, and the scene."""

from collections.abc import Iterator, Mapping
from functools import lru_cache

import mujoco
import numpy as np

from soro_bench.arrays import rotate_by_quaternion
from soro_bench.evaluation import Episode
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.trunk_geometry import build_skin
from soro_bench.recording.drawing import Box, Drawing, Line, Mesh, Plot, Pose, flat_shaded
from soro_bench.registration import task_type

_BOXES = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_PLANE))
# drawn only
_CABLE_RADIUS = 0.0008  # m
_BACKBONE_RADIUS = 0.0008  # m
_NECK_SEGMENTS = 16  # around a neck
_FLOOR_THICKNESS = 0.001  # m
_NEARER = 0.6  # than the camera of the MJCF, as the view of a tab is small
_SKIN_ALPHA = 0.35  # cables and backbone show through
_BACKBONE_COLOR = np.array([214, 60, 52], np.uint8)
_FLOOR_COLOR = np.array([52, 56, 62, 255], np.uint8)
# viridis at equal steps from 0.1 to 1 (its first tenth is too dark to see); perceptually uniform
_VIRIDIS = np.array([
    (72, 37, 118), (65, 68, 135), (53, 95, 141), (42, 120, 142), (33, 145, 140),
    (34, 168, 132), (68, 191, 112), (122, 209, 81), (189, 223, 38), (253, 231, 37),
])  # fmt: skip
# one hue per side of the trunk (+y, -x, -y, +x); short cables in a lighter tint
_LONG_COLORS = np.array([(31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40)])
_CABLE_COLORS = np.concatenate([_LONG_COLORS, (_LONG_COLORS + 255) // 2]).astype(np.uint8)


def draw_trunk(episode: Episode) -> Drawing:
    """The drawing of an episode of a trunk task."""
    model, data = _scene_at_rest(task_type(episode.env_id).scene)
    links, signals = _links(model), episode.signals
    boxes = dict(_boxes(model, data, episode))
    goal = model.geom("goal")
    skin = _skin(data.xpos[links], signals, _color(model, model.mat("silicone").id, _SKIN_ALPHA))
    return Drawing(
        meshes=skin,
        boxes=boxes,
        lines={"backbone": _backbone(signals["keypoints"]), **_cables(model, links, signals)},
        plots={
            "tension": Plot("tension [N]", signals["tension"], geo.CABLE_NAMES, _CABLE_COLORS),
            "commanded": Plot("commanded pull [mm]", 1e3 * signals["commanded"], geo.CABLE_NAMES, _CABLE_COLORS),
        },
        outline="backbone",
        body=tuple(skin),
        note=f"Cables are coloured by their tension, from violet (0) to yellow ({trunk.MAX_TENSION:g} N and more).",
        goal_radius=float(goal.size[0]),
        goal_color=_color(model, goal.matid[0], 1.0),
        up=(0, 1, 0),
        floor=float(data.geom_xpos[model.geom("floor").id, 1]) if "floor" in boxes else None,
        eye=model.stat.center + _NEARER * (model.cam("review").pos - model.stat.center),
        target=model.stat.center,
    )


def tension_colors(tension: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 colours of tensions [N]: viridis from 0 (also for NaN) to the largest in version 0."""
    tension = np.nan_to_num(tension)
    knots = np.linspace(0.0, trunk.MAX_TENSION, len(_VIRIDIS))
    return np.stack([np.interp(tension, knots, channel) for channel in _VIRIDIS.T], axis=-1).astype(np.uint8)


@lru_cache(maxsize=4)
def _scene_at_rest(scene: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The compiled scene; the cheap model has the same links, eyelets and surroundings as the accurate one."""
    model = trunk.build_spec(scene, "cable").compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def _links(model: mujoco.MjModel) -> np.ndarray:
    """(11,) bodies of the base and the vertebrae, in the order of the signals."""
    return np.array([model.body("base").id, *(model.body(f"vertebra{k}").id for k in range(geo.NUM_NECKS))])


def _skin(origins: np.ndarray, signals: Mapping[str, np.ndarray], color: np.ndarray) -> dict[str, Mesh]:
    """One rigid piece per link, whose frame rests at ``origins`` (11, 3) m: its disc and half of each neck beside it.

    Pieces with poses take a twentieth of the space of one mesh with vertices for each state.
    """
    skin = build_skin()
    link_of_face = skin.link[skin.faces]
    quaternions = np.roll(signals["link_quaternion"], -1, axis=-1)
    meshes = {}
    for k, origin in enumerate(origins):
        faces = skin.faces[(link_of_face == k).all(axis=1)]
        surfaces = [(skin.vertices, faces), *(_tube(*ends) for ends in _half_necks(k))]
        pieces = [flat_shaded(vertices - origin, corners) for vertices, corners in surfaces]
        vertices, normals = (np.concatenate([piece[i] for piece in pieces]) for i in (0, 1))
        pose = Pose(signals["link_position"][:, k], quaternions[:, k])
        corners = np.arange(len(vertices)).reshape(-1, 3)  # flat faces share no vertex
        meshes[f"skin/link{k:02d}"] = Mesh(vertices, normals, corners, color, pose)
    return meshes


def _half_necks(link: int) -> list[tuple[float, float]]:
    """Where the halves of necks [m] along the trunk begin and end that follow a link (0 is the base)."""
    before = [(geo.NECK_MIDDLE[link - 1], geo.NECK_END[link - 1])] if link else []
    after = [(geo.NECK_START[link], geo.NECK_MIDDLE[link])] if link < geo.NUM_NECKS else []
    return before + after


def _tube(begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) vertices [m] and (F, 3) faces of a tube of a neck's radius along the trunk at rest, open at its ends."""
    angle = np.arange(_NECK_SEGMENTS) * 2 * np.pi / _NECK_SEGMENTS
    circle = geo.NECK_RADIUS * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_NECK_SEGMENTS)])
    i = np.arange(_NECK_SEGMENTS)
    j = (i + 1) % _NECK_SEGMENTS
    lower, upper = (
        np.column_stack([i, j, i + _NECK_SEGMENTS]),
        np.column_stack([j, j + _NECK_SEGMENTS, i + _NECK_SEGMENTS]),
    )
    return np.concatenate([circle + np.array([0, 0, z]) for z in (begin, end)]), np.concatenate([lower, upper])


def _backbone(keypoints: np.ndarray) -> Line:
    return Line(keypoints, _BACKBONE_RADIUS, np.tile(_BACKBONE_COLOR, (len(keypoints), 1)))


def _cables(model: mujoco.MjModel, links: np.ndarray, signals: Mapping[str, np.ndarray]) -> dict[str, Line]:
    """A line through the eyelets of each cable, which follow their links."""
    link_of_body = np.zeros(model.nbody, int)
    link_of_body[links] = np.arange(len(links))
    colors = tension_colors(signals["tension"])
    cables = {}
    for c, name in enumerate(geo.CABLE_NAMES):
        tendon = model.tendon(name).id
        start = model.tendon_adr[tendon]
        sites = model.wrap_objid[start : start + model.tendon_num[tendon]]
        link = link_of_body[model.site_bodyid[sites]]
        offsets = rotate_by_quaternion(model.site_pos[sites], signals["link_quaternion"][:, link])
        cables[f"cables/{name}"] = Line(signals["link_position"][:, link] + offsets, _CABLE_RADIUS, colors[:, c])
    return cables


def _boxes(model: mujoco.MjModel, data: mujoco.MjData, episode: Episode) -> Iterator[tuple[str, Box]]:
    """Name and box of the clamp and of what the scene has of object, floor and wall."""
    for i in range(model.ngeom):
        geom = model.geom(i)
        if int(geom.type[0]) not in _BOXES:
            continue
        name = geom.name or model.body(geom.bodyid[0]).name
        size, position, color = geom.size, data.geom_xpos[i].copy(), _color(model, geom.matid[0])
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[i])
        pose = Pose(position, np.roll(quaternion, -1))
        if name == "floor":
            size, color = np.append(size[:2], _FLOOR_THICKNESS / 2), _FLOOR_COLOR
            position[1] -= _FLOOR_THICKNESS / 2
        elif name == "wall":
            position[0] += episode.params["wall_offset"]
        elif name == "object":
            signals = episode.signals
            pose = Pose(signals["object_position"], np.roll(signals["object_quaternion"], -1, axis=-1))
        yield name, Box(size, color, pose)


def _color(model: mujoco.MjModel, material: int, alpha: float | None = None) -> np.ndarray:
    """(4,) uint8 colour of a material, with another opacity if given."""
    rgba = model.mat_rgba[material].copy()
    if alpha is not None:
        rgba[3] = alpha
    return np.round(255 * rgba).astype(np.uint8)
