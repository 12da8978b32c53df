"""Tau-Jerk motion of a pose: the distance to the goal and the angle to it are two coupled gaps.

The position goes straight, the orientation turns about one axis: R(t) = R_0 exp(share of the way [w]x) with
w = log(R_0^T R_goal), the shortest turn. One axis commutes with itself, so angular velocity, acceleration
and jerk are the axis times the derivatives of the angle's gap.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from seal_gym.core.frames import Array, axis_angle, transform
from seal_gym.planning.tau_jerk import DEFAULT_K, RateLimitsCfg, TauJerk, couple, shortest_duration


class PoseMotion(NamedTuple):
    """A pose and its derivatives, rates resolved along the axes of the frame that the poses are given in.

    Attributes:
        pose: Shape (..., m, 4, 4), m.
        twist: Velocity of the origin and angular velocity, shape (..., m, 6), m/s and rad/s.
        acceleration: Its derivative, shape (..., m, 6), m/s^2 and rad/s^2.
        jerk: The next one, shape (..., m, 6), m/s^3 and rad/s^3.
    """

    pose: Array
    twist: Array
    acceleration: Array
    jerk: Array


def rotation_vector(rotation: Array) -> Array:
    """Logarithm of a rotation: its axis times its angle in [0, pi].

    Args:
        rotation: Shape (..., 3, 3).

    Returns:
        Shape (..., 3), rad.
    """
    vector = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vector.reshape(rotation.shape[:-1]))


def rotation_matrix(vector: Array) -> Array:
    """Exponential of a rotation vector.

    Args:
        vector: Axis times angle, shape (..., 3), rad.

    Returns:
        Shape (..., 3, 3).
    """
    angle = np.linalg.norm(vector, axis=-1)
    return axis_angle(vector / np.where(angle > 0.0, angle, 1.0)[..., None], angle)


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTauJerk:
    """Motion of a pose from rest to rest, or a batch of such motions.

    Attributes:
        start: ``T_frame_moving`` at first, shape (..., 4, 4), m.
        way: Gaps at first, closed from 0: displacement along the frame's axes [m] and rotation vector along
            the start's [rad], 6 axes.
    """

    start: Array
    way: TauJerk

    def sample(self, time_s: Array | float) -> PoseMotion:
        """The motion at some times; at rest before 0 and after the end.

        Args:
            time_s: Since the start, shape (m,), or (..., m) with times for each of the batch, s.

        Returns:
            Shapes (..., m, 4, 4) and (..., m, 6).
        """
        gone = self.way.sample(time_s)
        first = self.start[..., None, :3, :3]
        rotation = first @ rotation_matrix(gone.position[..., 3:])
        pose = transform(rotation, self.start[..., None, :3, 3] + gone.position[..., :3])
        # The axis of the turn is the same in the start's frame and in the moving one.
        rates = (
            np.concatenate((rate[..., :3], (first @ rate[..., 3:, None])[..., 0]), axis=-1)
            for rate in gone[1:]
        )
        return PoseMotion(pose, *rates)

    @property
    def duration_s(self) -> Array:
        """T, shape (...), s."""
        return self.way.duration_s


def plan_pose(
    start: Array,
    goal: Array,
    linear: RateLimitsCfg,
    angular: RateLimitsCfg,
    k: float = DEFAULT_K,
    ratio: float = 1.0,
) -> PoseTauJerk:
    """The fastest tau-Jerk motion between two poses that keeps to the limits.

    Args:
        start: ``T_frame_moving``, shape (..., 4, 4), m; broadcast against the goal.
        goal: Shape (..., 4, 4), m.
        linear: Limits of the origin's motion along its line [m]; numbers.
        angular: Limits of the turn about its axis [rad]; numbers.
        k: Of the distance's gap.
        ratio: Coupling of the angle's gap to it: below 1 the turn is ahead of the displacement.

    Returns:
        The motion.

    Raises:
        ConfigError: See ``couple`` and ``shortest_duration``.
    """
    start, goal = (np.array(x, dtype=np.float64) for x in np.broadcast_arrays(start, goal))
    displacement = goal[..., :3, 3] - start[..., :3, 3]
    turn = rotation_vector(np.swapaxes(start[..., :3, :3], -1, -2) @ goal[..., :3, :3])
    turn_k = float(couple(k, ratio))
    moves = ((displacement, linear, k), (turn, angular, turn_k))
    durations = [shortest_duration(np.linalg.norm(x, axis=-1)[..., None], cfg, of) for x, cfg, of in moves]
    way = np.concatenate((displacement, turn), axis=-1)
    return PoseTauJerk(
        start=start,
        way=TauJerk(
            start=np.zeros_like(way),
            goal=way,
            duration_s=np.maximum(*durations),
            k=np.repeat((k, turn_k), 3),
        ),
    )
