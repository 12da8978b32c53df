"""The smoothing pass after a sealed seam: the arm draws a tool along the way that the gun has taken."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array, transform
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.core import SealCore
from seal_gym.planning import ik
from seal_gym.sealant.smoothing import SmoothingCfg, smooth, tool_path
from seal_gym.sim.arm import ArmBatch
from seal_gym.workpieces.seam import nearest_on_path

_GAIN = 10.0  # of the joints' way back to the path [1/s]


class Smoothed(NamedTuple):
    """What a smoothing pass did.

    Attributes:
        wanted: ``T_part_tool`` of the tool path, shape (m, 4, 4), m.
        centres: Where the ball's centre was at each frame, in the part's frame, shape (m, 3), m.
        touched: Whether gun or arm touched anything.
        removed_m3: What the ball kept [m^3].
    """

    wanted: Array
    centres: Array
    touched: bool
    removed_m3: float


def inverse(pose: Array) -> Array:
    """Inverse of rigid transforms.

    Args:
        pose: Shape (..., 4, 4), m.

    Returns:
        The same shape.
    """
    turn = np.swapaxes(pose[..., :3, :3], -1, -2)
    return transform(turn, -(turn @ pose[..., :3, 3:])[..., 0])


def smoothing_pass(core: SealCore, i: int, tip: Array, cfg: SmoothingCfg | None = None) -> Smoothed:
    """Draws a smoothing tool along one bead, with the arm in the physics.

    The tool is a soft ball about the nozzle's mouth, held further away, so that the gun is free of the part.
    The part stands still where the sealing left it.

    Args:
        core: The simulations, with sealant; ``i``'s bead is changed.
        i: Which simulation.
        tip: ``T_part_tip`` that the gun had in each frame while it sealed, shape (n, 4, 4), m.
        cfg: The tool.

    Returns:
        What it did.

    Raises:
        ConfigError: If there is no sealant, or the arm does not reach the tool path.
    """
    cfg = cfg or SmoothingCfg()
    if core.extrusion is None:
        raise ConfigError("a smoothing pass needs a bead: make the environment with sealant=True")
    cell, part = core.cfg.cell, core.arm.part_pose[i]
    wanted = tool_path(tip, cell.process.stand_off_m, cfg.speed_m_s * cell.timing.frame_s, cfg)
    q = _postures(part @ wanted, core.arm.q[i])
    arm = ArmBatch(core.scene, 1)
    arm.reset(0, q[0], part)
    dt, touched = cell.timing.frame_s, False
    rate = np.gradient(q, dt, axis=0)
    centres = np.empty((len(q), 3))
    to_part = inverse(part)
    for k in range(len(q)):
        pose = to_part @ tip_kinematics(arm.q, arm.qd).pose[0]
        centres[k] = pose[:3, 3]
        ahead = min(k + 1, len(q) - 1)
        speed = rate[ahead] + _GAIN * (q[k] - arm.q_command[0])
        touched = bool(arm.step(((speed - arm.qd_command[0]) / dt)[None])[0]) or touched
    s = arc_of(core, centres)
    fine, fine_s = _finer(centres, s, core.extrusion.bead.strip.arc[1] - core.extrusion.bead.strip.arc[0])
    removed = smooth(core.extrusion.bead, i, fine, fine_s, cfg)
    return Smoothed(wanted, centres, touched, removed)


def _postures(poses: Array, reference: Array) -> Array:
    """Joint angles along a path, each nearest to the one before, shape (m, 6), rad."""
    solutions = ik.solve(poses)
    out = np.empty((len(poses), 6))
    for k, found in enumerate(solutions):
        reference = ik.nearest(found, reference)
        if np.isnan(reference).any():
            raise ConfigError(f"the arm does not reach pose {k} of {len(poses)} of the tool path")
        out[k] = reference
    return out


def arc_of(core: SealCore, points: Array) -> Array:
    """Arc lengths beside which points in order of travel are.

    Args:
        core: For its seam.
        points: In the part's frame, shape (m, 3), m.

    Returns:
        Shape (m,), m.
    """
    seam, window = core.scene.workpiece.seam, core.cfg.task.window_m
    path = seam.tip_path(core.cfg.cell.process.stand_off_m)
    out = np.empty(len(points))
    s = nearest_on_path(path, seam.arc, points[0], seam.arc[0], window)[1]
    for k, point in enumerate(points):
        s = nearest_on_path(path, seam.arc, point, s - window, s + window)[1]
        out[k] = s
    return out


def _finer(points: Array, s: Array, spacing: float) -> tuple[Array, NDArray[np.float64]]:
    """Points no further apart than a spacing, with their arc lengths."""
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    even = np.linspace(0.0, way[-1], max(int(np.ceil(2.0 * way[-1] / spacing)), 1) + 1)
    fine = np.column_stack([np.interp(even, way, column) for column in points.T])
    return fine, np.interp(even, way, s)
