"""The palette cell as a MuJoCo model: the UR5 with the tie tool over a cable-harness palette."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CellCfg
from seal_gym.core.frames import Array
from seal_gym.core.paths import asset
from seal_gym.sim.scene import ENVIRONMENT, GROUP_PART, TABLE_TOP_M, VISUAL, add_furniture
from seal_gym.workpieces.palette import (
    BOARD_M,
    CABLE_RADIUS_M,
    CONNECTOR_M,
    HEAD_M,
    PEG_RADIUS_M,
    RIVET_M,
    TRAVEL_M,
    ZONE_M,
    PaletteLayout,
    Spot,
)

CLASSES = ("board", "cable", "connector", "peg", "rivet", "tie")
"""What a tool may touch by mistake; ``tie`` are the ties that sit already."""
TOOL_PREFIX = "tool/"
BOARD_TOP_M = TABLE_TOP_M + 0.06
"""Height of the board's top in the world [m]."""
# Colours as Table I of paper T codes them by thresholded channels: cable black (0, 0, 0), connector blue
# (0, 0, 1), rivet green (0, 1, 0), target red (1, 0, 0), board light (1, 1, 1). Nylon is white too.
RGB = {
    "board": (0.80, 0.79, 0.76),
    "cable": (0.05, 0.05, 0.05),
    "connector": (0.08, 0.16, 0.72),
    "peg": (0.66, 0.65, 0.63),
    "rivet": (0.10, 0.55, 0.16),
    "tie": (0.93, 0.93, 0.91),
    "target": (0.78, 0.08, 0.07),
}
_SPRING_N_M = 1000.0
_PRELOAD_N = 3.0
_DAMPING_N_S_M = 40.0
_HEAD_KG = 0.02
# A limit of a joint is as stiff as the inertia behind it allows (MuJoCo's constraints act on accelerations):
# with this one the seat gives 0.07 mm/N, as a cable does.
_ARMATURE_KG = 1.0
_LIMIT_SOLREF = (0.0085, 1.0)
_STRAP_M = 0.005
_G, _S = mujoco.mjtGeom, mujoco.mjtSensor
# Contact sensors: bits of found and force, reduced to the net force in the world frame.
_FOUND_AND_FORCE, _LARGEST, _NET_FORCE = 0b11, 2, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class PaletteScene:
    """A compiled palette cell.

    Sensor data, in order: for each target the number of contacts of the pad with its tie and their net force
    in the world frame (4 numbers), then for each of ``CLASSES`` the same of the arm and tool with it, then
    the largest force in any contact of arm and tool, then each target's slide.

    Attributes:
        model: The MuJoCo model; joints 6.. are the targets' slides, equality constraints their latches.
        layout: What lies where.
        cell: The cell it was built for.
    """

    model: mujoco.MjModel
    layout: PaletteLayout
    cell: CellCfg


@dataclass(frozen=True, kw_only=True, eq=False)
class Touches:
    """What touched what after each physics step of a frame.

    Attributes:
        press_n: Force of the pad on each target along its slide, shape (S, n), N.
        slide_m: How far each target has been pressed, shape (S, n), m.
        wrong: Whether each of ``CLASSES`` and, last, anything else was touched, shape (S, 7).
        wrong_n: Force on each of ``CLASSES``; last, the largest in any contact, shape (S, 7), N.
    """

    press_n: Array
    slide_m: Array
    wrong: NDArray[np.bool_]
    wrong_n: Array


def read_touches(scene: PaletteScene, contacts: Array, sensors: Array) -> Touches:
    """Takes recorded contacts apart.

    Args:
        scene: The scene.
        contacts: Number of contacts after each step, shape (S,).
        sensors: Sensor data after each step, shape (S, k).

    Returns:
        See ``Touches``.
    """
    n, steps = len(scene.layout.targets), len(contacts)
    pairs = sensors[:, : 4 * (n + len(CLASSES) + 1)].reshape(steps, -1, 4)
    press = np.abs(pairs[:, :n, 3])  # the palette lies level: its ties slide along the world's z
    force = np.linalg.norm(pairs[:, n:, 1:], axis=2)
    count = pairs[:, :-1, 0]
    other = contacts - count.sum(axis=1)
    wrong = np.column_stack((count[:, n:], other)) > 0
    return Touches(press_n=press, slide_m=-sensors[:, -n:], wrong=np.asarray(wrong), wrong_n=force)


def _quat(yaw: float) -> Array:
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def _solid(body: mujoco.MjsBody, kind: int, look: str, **where: Any) -> None:
    body.add_geom(type=kind, material=look, group=GROUP_PART, **ENVIRONMENT, **where)


def _box(x: float, y: float, z: float) -> list[float]:
    """MuJoCo's half sizes."""
    return [x / 2, y / 2, z / 2]


def _add_board(part: mujoco.MjsBody) -> None:
    body = part.add_body(name="board")
    x, y, z = BOARD_M
    _solid(body, _G.mjGEOM_BOX, "board", pos=[0, 0, -z / 2], size=_box(x, y, z))
    leg = BOARD_TOP_M - TABLE_TOP_M - z
    for sx in (-1, 1):
        for sy in (-1, 1):
            body.add_geom(
                type=_G.mjGEOM_CYLINDER,
                pos=[sx * (x / 2 - 0.02), sy * (y / 2 - 0.02), -z - leg / 2],
                size=[0.012, leg / 2, 0],
                material="steel",
                group=GROUP_PART,
                **VISUAL,
            )


def _add_cables(part: mujoco.MjsBody, layout: PaletteLayout) -> None:
    body = part.add_body(name="cable")
    for line in layout.cables:
        for a, b in pairwise(line):
            ends = [*a, *b]
            _solid(body, _G.mjGEOM_CAPSULE, "cable", fromto=ends, size=[CABLE_RADIUS_M, 0, 0])


def _add_fixtures(part: mujoco.MjsBody, layout: PaletteLayout) -> None:
    body = part.add_body(name="connector")
    for spot, height in zip(layout.connectors, layout.connector_height_m, strict=True):
        place = {"pos": [spot.x, spot.y, height / 2], "quat": _quat(spot.yaw)}
        _solid(body, _G.mjGEOM_BOX, "connector", size=_box(*CONNECTOR_M, height), **place)
    body = part.add_body(name="peg")
    for x, y, height in layout.pegs:
        size = [PEG_RADIUS_M, height / 2, 0]
        _solid(body, _G.mjGEOM_CYLINDER, "peg", pos=[x, y, height / 2], size=size)
    body = part.add_body(name="rivet")
    radius, height = RIVET_M
    for x, y in layout.rivets:
        _solid(body, _G.mjGEOM_CYLINDER, "rivet", pos=[x, y, height / 2], size=[radius, height / 2, 0])


def _add_strap(body: mujoco.MjsBody, height: float, **where: Any) -> None:
    """The band round the cable, to look at."""
    size = _box(_STRAP_M, 2 * CABLE_RADIUS_M + 0.002, height)
    body.add_geom(type=_G.mjGEOM_BOX, size=size, material="tie", group=GROUP_PART, **VISUAL, **where)


def _add_seated(part: mujoco.MjsBody, layout: PaletteLayout) -> None:
    body = part.add_body(name="tie")
    for spot in layout.seated:
        quat = _quat(spot.yaw)
        z = 2 * CABLE_RADIUS_M
        _add_strap(body, z, pos=[spot.x, spot.y, z / 2], quat=quat)
        _solid(
            body, _G.mjGEOM_BOX, "tie", pos=[spot.x, spot.y, z + HEAD_M[2] / 2], quat=quat, size=_box(*HEAD_M)
        )


def _add_target(spec: mujoco.MjSpec, part: mujoco.MjsBody, k: int, spot: Spot) -> None:
    """A painted square and, over the cable, a tie's head on a spring, with a latch at its seat."""
    part.add_geom(
        type=_G.mjGEOM_BOX,
        pos=[spot.x, spot.y, 0.0],
        quat=_quat(spot.yaw),
        size=_box(ZONE_M, ZONE_M, 0.0006),
        material="target",
        group=GROUP_PART,
        **VISUAL,
    )
    seat = 2 * CABLE_RADIUS_M + HEAD_M[2] / 2
    body = part.add_body(name=f"target_{k}", pos=[spot.x, spot.y, seat + TRAVEL_M], quat=_quat(spot.yaw))
    body.gravcomp = 1.0
    joint = body.add_joint(
        name=f"target_{k}",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 0, 1],
        range=[-TRAVEL_M, 0.0],
        limited=True,
        springref=_PRELOAD_N / _SPRING_N_M,
        armature=_ARMATURE_KG,
        solref_limit=_LIMIT_SOLREF,
    )
    joint.stiffness = np.array([_SPRING_N_M, 0, 0])
    joint.damping = np.array([_DAMPING_N_S_M, 0, 0])
    _add_strap(body, 0.012, pos=[0, 0, -0.006])
    body.add_geom(
        name=f"target_{k}",
        type=_G.mjGEOM_BOX,
        size=_box(*HEAD_M),
        mass=_HEAD_KG,
        material="tie",
        group=GROUP_PART,
        **ENVIRONMENT,
    )
    latch = spec.add_equality(name=f"latch_{k}", type=mujoco.mjtEq.mjEQ_JOINT, active=False)
    latch.objtype = mujoco.mjtObj.mjOBJ_JOINT
    latch.name1 = f"target_{k}"
    latch.data[0] = -TRAVEL_M


def _add_sensors(spec: mujoco.MjSpec, targets: int) -> None:
    contact = {
        "type": _S.mjSENS_CONTACT,
        "intprm": [_FOUND_AND_FORCE, _NET_FORCE, 1],
    }
    for k in range(targets):
        spec.add_sensor(
            name=f"press_{k}",
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=TOOL_PREFIX + "pad",
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=f"target_{k}",
            **contact,
        )
    for name in CLASSES:
        spec.add_sensor(
            name=f"touch_{name}",
            objtype=mujoco.mjtObj.mjOBJ_XBODY,  # with its subtree: the arm and the tool
            objname="base_link",
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=name,
            **contact,
        )
    spec.add_sensor(
        name="touch",
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname="base_link",
        **contact | {"intprm": [_FOUND_AND_FORCE, _LARGEST, 1]},
    )
    for k in range(targets):
        spec.add_sensor(
            name=f"slide_{k}",
            type=_S.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=f"target_{k}",
        )


def build_palette(layout: PaletteLayout, cell: CellCfg) -> PaletteScene:
    """Composes and compiles the cell.

    World frame: the robot's DH base frame, z up. The palette is the mocap body ``part``.

    Args:
        layout: What lies where.
        cell: Timing and limits.

    Returns:
        The scene.
    """
    spec = mujoco.MjSpec.from_file(str(asset("ur5_sealgun", "ur5.xml")))
    tool = mujoco.MjSpec.from_file(str(asset("tie_tool", "tie_tool.xml")))
    spec.attach(tool, prefix=TOOL_PREFIX, site=spec.site("tool0"))
    spec.option.timestep = cell.timing.step_s
    add_furniture(spec)
    for name, rgb in RGB.items():
        spec.add_material(name=name, rgba=[*rgb, 1.0], specular=0.1, shininess=0.1)
    part = spec.worldbody.add_body(name="part", mocap=True)
    _add_board(part)
    _add_cables(part, layout)
    _add_fixtures(part, layout)
    _add_seated(part, layout)
    for k, spot in enumerate(layout.targets):
        _add_target(spec, part, k, spot)
    _add_sensors(spec, len(layout.targets))
    return PaletteScene(model=spec.compile(), layout=layout, cell=cell)
