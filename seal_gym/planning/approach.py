"""The gun's ways from a posture of rest to a hover at a seam's start and back, by tau-Jerk in the joints."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, transform
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, T_TOOL0_TIP, tip_kinematics
from seal_gym.planning import ik, ik_kernel
from seal_gym.planning.tau_jerk import DEFAULT_K, Motion, RateLimitsCfg, plan


@dataclass(frozen=True, kw_only=True)
class ApproachCfg:
    """How fast the joints may go. Their acceleration's limit is the cell's."""

    speed_share: float = 0.5
    """Of the UR5's joint speeds, in (0, 1]."""
    jerk_rad_s3: float = 150.0
    """The makers give none: full acceleration of the nominal cell, 15 rad/s^2, after 0.1 s. [rad/s^3]"""
    k: float = DEFAULT_K
    """Of all joints, in (0, 1/3]."""
    tip_m_s2: float = math.inf
    """Largest acceleration of the tip: a motion that exceeds it is slowed down as a whole. [m/s^2]"""
    room_m: float = 0.05
    """Above a hover, along the nozzle, where ways from and to the posture of rest stop over. [m]"""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, high in (
            ("speed_share", 1.0),
            ("jerk_rad_s3", math.inf),
            ("k", 1.0 / 3.0),
            ("tip_m_s2", math.inf),
            ("room_m", 0.5),
        ):
            value = getattr(self, name)
            require(
                (is_number(value) or value == math.inf) and 0.0 < value <= high,
                f"ApproachCfg.{name} = {value!r}: must be positive and at most {high:.3g}",
            )


class Approach(NamedTuple):
    """Commands at the control rate, from rest to rest.

    Attributes:
        time_s: Since the start, shape (m,), s.
        q: Joint angles, shape (..., m, 6), rad; the last ones put the tip in the hover.
        qd: Joint speeds, shape (..., m, 6), rad/s.
        qdd: Joint accelerations, shape (..., m, 6), rad/s^2.
        duration_s: Of the motion, shape (...), s; after it the joints rest.
    """

    time_s: Array
    q: Array
    qd: Array
    qdd: Array
    duration_s: Array


def plan_approach(
    home_q: Array,
    hover: Array,
    cell: CellCfg | None = None,
    cfg: ApproachCfg | None = None,
    tool: Array = T_TOOL0_TIP,
) -> Approach:
    """Plans the joints' motion from a posture to a pose of the tip, within the UR5's limits.

    All joints close their gaps together, to the branch of the inverse kinematics nearest to the posture. What
    stands in the way it does not know: choose a home from which the way is free.

    Args:
        home_q: Posture to begin from, shape (6,), rad.
        hover: ``T_base_tip`` to end at, or a batch of them, shape (..., 4, 4), m.
        cell: Control rate and acceleration, by default the nominal cell's.
        cfg: How fast.
        tool: ``T_tool0_tip``, shape (4, 4), m.

    Returns:
        Commands, for as long as the longest motion of the batch.

    Raises:
        ConfigError: If the posture is beyond the joints' limits or a hover out of reach.
    """
    cell, cfg = cell or load_cell(), cfg or ApproachCfg()
    require(
        home_q.shape == (6,) and bool(np.all((home_q >= JOINT_LOWER) & (home_q <= JOINT_UPPER))),
        f"home_q = {home_q}: must be six joint angles within {JOINT_LOWER} and {JOINT_UPPER} rad",
    )
    goal = ik.nearest_within(ik_kernel.solve(hover, tool), home_q)
    require(
        bool(np.isfinite(goal).all()),
        f"hover: {np.isnan(goal).any(axis=-1).sum()} poses are out of the arm's reach: move them closer",
    )
    return plan_joints(home_q, goal, cell, cfg)


def plan_joints(start_q: Array, goal_q: Array, cell: CellCfg, cfg: ApproachCfg) -> Approach:
    """Plans the joints' motion between two postures, within the UR5's limits and the tip's.

    Args:
        start_q: Shape (6,), rad.
        goal_q: Shape (..., 6), rad.
        cell: Control rate and acceleration.
        cfg: How fast.

    Returns:
        Commands, for as long as the longest motion of the batch.
    """
    limits = RateLimitsCfg(
        speed=tuple(cfg.speed_share * JOINT_SPEED),
        acceleration=cell.limits.joint_rad_s2,
        jerk=cfg.jerk_rad_s3,
    )
    motion = plan(start_q, goal_q, limits, cfg.k)
    rate = cell.timing.frame_rate_hz
    slow = 1.0
    if math.isfinite(cfg.tip_m_s2):
        fine = np.arange(0.0, float(motion.duration_s.max()), 0.1 / rate)
        peak = _tip_acceleration(motion.sample(fine))
        slow = max(1.0, math.sqrt(peak / cfg.tip_m_s2))
    duration = slow * motion.duration_s
    time = np.arange(math.ceil(float(duration.max()) * rate) + 1) / rate
    m = motion.sample(time / slow)
    return Approach(time, m.position, m.velocity / slow, m.acceleration / slow**2, duration)


def _tip_acceleration(motion: Motion) -> float:
    """The largest acceleration of the tip [m/s^2]."""
    q, qd, qdd = (x.reshape(-1, 6) for x in (motion.position, motion.velocity, motion.acceleration))
    tip = tip_kinematics(q, qd)
    accel = (tip.jacobian @ qdd[:, :, None])[:, :3, 0] + tip.drift[:, :3]
    return float(np.sqrt((accel**2).sum(axis=1)).max())


def plan_journey(
    home_q: Array, hover: Array, cell: CellCfg | None = None, cfg: ApproachCfg | None = None
) -> Approach:
    """From a posture of rest to a hover, with a stop straight above it.

    Args:
        home_q: Posture to begin from, shape (6,), rad.
        hover: ``T_base_tip`` to end at, shape (4, 4), m.
        cell: Control rate and acceleration, by default the nominal cell's.
        cfg: How fast, and how far above.

    Returns:
        Commands.

    Raises:
        ConfigError: See ``plan_approach``.
    """
    cell, cfg = cell or load_cell(), cfg or ApproachCfg()
    above = plan_approach(home_q, _above(hover, cfg.room_m), cell, cfg)
    return _joined(above, plan_approach(above.q[-1], hover, cell, cfg), cell)


def plan_departure(
    q: Array, home_q: Array, cell: CellCfg | None = None, cfg: ApproachCfg | None = None
) -> Approach:
    """From where a seam has ended straight up along the nozzle, and to a posture of rest.

    Args:
        q: Posture to begin from, shape (6,), rad.
        home_q: Posture to end in, shape (6,), rad.
        cell: Control rate and acceleration, by default the nominal cell's.
        cfg: How fast, and how far up.

    Returns:
        Commands.

    Raises:
        ConfigError: See ``plan_approach``.
    """
    cell, cfg = cell or load_cell(), cfg or ApproachCfg()
    tip = tip_kinematics(q[None], np.zeros((1, 6))).pose[0]
    up = plan_approach(q, _above(tip, cfg.room_m), cell, cfg)
    return _joined(up, plan_joints(up.q[-1], home_q, cell, cfg), cell)


def _above(tip: Array, room_m: float) -> Array:
    return np.asarray(tip @ transform(np.eye(3), np.array([0.0, 0.0, room_m])))


def _joined(first: Approach, then: Approach, cell: CellCfg) -> Approach:
    """One motion after another; the rest between them is one frame."""
    q, qd, qdd = (np.concatenate((a, b[1:])) for a, b in zip(first[1:4], then[1:4], strict=True))
    time = np.arange(len(q), dtype=np.float64) * cell.timing.frame_s
    return Approach(time, q, qd, qdd, first.time_s[-1] + then.duration_s)
