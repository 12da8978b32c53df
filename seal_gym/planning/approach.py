"""The way of the gun from a posture of rest to a hover at a seam's start, by tau-Jerk in the joints."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, T_TOOL0_TIP
from seal_gym.planning import ik, ik_kernel
from seal_gym.planning.tau_jerk import DEFAULT_K, RateLimitsCfg, plan


@dataclass(frozen=True, kw_only=True)
class ApproachCfg:
    """How fast the joints may go. Their acceleration's limit is the cell's."""

    speed_share: float = 0.5
    """Of the UR5's joint speeds, in (0, 1]."""
    jerk_rad_s3: float = 150.0
    """The makers give none: full acceleration of the nominal cell, 15 rad/s^2, after 0.1 s. [rad/s^3]"""
    k: float = DEFAULT_K
    """Of all joints, in (0, 1/3]."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, high in (("speed_share", 1.0), ("jerk_rad_s3", math.inf), ("k", 1.0 / 3.0)):
            value = getattr(self, name)
            require(
                is_number(value) and 0.0 < value <= high,
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
    limits = RateLimitsCfg(
        speed=tuple(cfg.speed_share * JOINT_SPEED),
        acceleration=cell.limits.joint_rad_s2,
        jerk=cfg.jerk_rad_s3,
    )
    motion = plan(home_q, goal, limits, cfg.k)
    rate = cell.timing.frame_rate_hz
    frames = math.ceil(float(motion.duration_s.max()) * rate)
    time = np.arange(frames + 1) / rate
    sampled = motion.sample(time)
    return Approach(time, sampled.position, sampled.velocity, sampled.acceleration, motion.duration_s)
