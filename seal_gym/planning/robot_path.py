"""A timed nozzle path as the UR5 can execute it: slowed down where joints or nozzle are too fast.

The planned time tau is the path's parameter; the robot passes it at the rate r = d tau / dt <= 1. The flow is
scaled with the same rate, so that each stretch of the path gets the same volume as planned.
"""

import importlib
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, transform, yaw_pose
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_SPEED, JOINT_UPPER, tip_kinematics
from seal_gym.planning import ik
from seal_gym.planning.bead_config import INSTALL, PlanningError
from seal_gym.planning.bead_geometry import BeadPath

_GRID_STEPS = 3  # steps of the time scaling in an interval of the path
_PLACES_M = ((0.3, 0.4, 0.5, 0.6), (-0.2, 0.0, 0.2), (0.0, 0.15, 0.3))
_YAWS = 12
_PLACE_POSES = 160


@dataclass(frozen=True, kw_only=True)
class RobotLimitsCfg:
    """What the robot may do.

    Attributes:
        joint_rad_s: Largest speed of each joint [rad/s], 6 numbers.
        joint_rad_s2: Largest acceleration of each joint [rad/s^2], 6 numbers.
        nozzle_m_s: Largest speed of the nozzle [m/s].
    """

    joint_rad_s: tuple[float, ...] = tuple(map(float, JOINT_SPEED))
    joint_rad_s2: tuple[float, ...] = field(
        default_factory=lambda: (float(load_cell().limits.joint_rad_s2),) * 6
    )
    nozzle_m_s: float = 1.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name in ("joint_rad_s", "joint_rad_s2"):
            value = getattr(self, name)
            require(
                isinstance(value, tuple) and len(value) == 6 and all(is_number(v) and v > 0.0 for v in value),
                f"RobotLimitsCfg.{name} = {value!r}: must be 6 positive numbers",
                ConfigError,
            )
        require(
            is_number(self.nozzle_m_s) and self.nozzle_m_s > 0.0,
            f"RobotLimitsCfg.nozzle_m_s = {self.nozzle_m_s!r}: must be positive",
            ConfigError,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotPath:
    """A path the robot executes from rest to rest.

    Attributes:
        path: The nozzle's poses by forward kinematics, in the part's frame, with the robot's times and the
            scaled flow.
        q: Joint angles, shape (n, 6), rad.
        qd: Joint speeds, shape (n, 6), rad/s.
        planned_s: tau at each time, shape (n,), s.
        rate: d tau / dt, shape (n,); the flow is scaled with it.
        slow_down: Time taken over time planned, >= 1.
    """

    path: BeadPath
    q: Array
    qd: Array
    planned_s: Array
    rate: Array
    slow_down: float


def joint_path(path: BeadPath, T_base_part: Array, limits: RobotLimitsCfg) -> Array:
    """Joint angles along a path, all in the branch of the inverse kinematics that is least hurried.

    Args:
        path: In the part's frame.
        T_base_part: Pose of the part, shape (4, 4), m.
        limits: By which joint speeds are compared.

    Returns:
        Shape (n, 6), rad, continuous.

    Raises:
        PlanningError: If no branch reaches the whole path within the joints' ranges; the message says how
            far the best one gets.
    """
    poses = T_base_part @ transform(path.rotation, path.position_m)
    q = np.unwrap(ik.solve(poses), axis=0)
    reached = np.all(np.isfinite(q), axis=-1)
    speed = np.abs(np.diff(q, axis=0)) / np.diff(path.time_s)[:, None, None] / np.array(limits.joint_rad_s)
    best, least = None, np.inf
    for branch in np.flatnonzero(reached.all(axis=0)):
        angles = q[:, branch] - 2 * np.pi * np.rint((q[:, branch].max(0) + q[:, branch].min(0)) / (4 * np.pi))
        inside = bool(np.all((angles > JOINT_LOWER) & (angles < JOINT_UPPER)))
        if inside and speed[:, branch].max() < least:
            best, least = angles, float(speed[:, branch].max())
    if best is None:
        share = 100.0 * reached.mean(axis=0).max()
        raise PlanningError(
            f"the robot cannot follow the path: the best branch reaches {share:.0f} % of its poses, or "
            "a joint leaves its range: place the part elsewhere (see robot_path.place)"
        )
    return np.asarray(best)


def place(path: BeadPath, limits: RobotLimitsCfg | None = None) -> Array:
    """A pose of the part at which the robot follows a path with little hurry.

    Tries the path's middle at places in front of the robot and the part at angles about the vertical, and
    takes the pose with the smallest peak of joint speed against its limit, over all joints and poses.

    Args:
        path: In the part's frame, z up.
        limits: By which joint speeds are compared.

    Returns:
        ``T_base_part``, shape (4, 4), m.

    Raises:
        PlanningError: If no place will do.
    """
    limits = limits or RobotLimitsCfg()
    keep = np.unique(np.linspace(0, len(path.time_s) - 1, _PLACE_POSES).astype(int))
    coarse = BeadPath(
        time_s=path.time_s[keep],
        position_m=path.position_m[keep],
        rotation=path.rotation[keep],
        flow_m3_per_s=path.flow_m3_per_s[keep],
    )
    middle = (path.position_m.max(axis=0) + path.position_m.min(axis=0)) / 2.0
    best, least = None, np.inf
    for x, y, z, turn in product(*_PLACES_M, range(_YAWS)):
        pose = yaw_pose(x, y, z, 2 * np.pi * turn / _YAWS)
        pose[:3, 3] -= pose[:3, :3] @ middle
        try:
            q = joint_path(coarse, pose, limits)
        except PlanningError:
            continue
        rate = np.abs(np.diff(q, axis=0)) / np.diff(coarse.time_s)[:, None] / np.array(limits.joint_rad_s)
        if rate.max() < least:
            best, least = pose, float(rate.max())
    if best is None:
        raise PlanningError("the robot can follow the path nowhere in front of it: make the part smaller")
    return best


def _toppra() -> tuple[Any, Any, Any]:
    try:
        return tuple(  # type: ignore[return-value]
            importlib.import_module(f"toppra{part}") for part in ("", ".constraint", ".algorithm")
        )
    except ImportError as error:
        raise PlanningError(f"time scaling needs TOPP-RA, which is not installed: {INSTALL}") from error


def scale_time(
    planned_s: Array, q: Array, nozzle_m_s: Array, limits: RobotLimitsCfg
) -> tuple[Array, Array, Array]:
    """The fastest way along a joint path from rest to rest, never faster than planned.

    Source: Pham and Pham, "A new approach to time-optimal path parameterization based on reachability
    analysis" (2018), by its authors' library.

    Args:
        planned_s: tau of the path's points, rising, shape (n,), s.
        q: Joint angles there, shape (n, 6), rad; a cubic spline runs through them.
        nozzle_m_s: Planned speed of the nozzle there, shape (n,), m/s.
        limits: Of the robot.

    Returns:
        tau, the rate d tau / dt and the time t at the steps of the scaling, each of shape (m,).

    Raises:
        PlanningError: If TOPP-RA is missing or finds no way.
    """
    ta, constraint, algorithm = _toppra()
    # The planned time is a seventh joint, whose speed is the rate.
    spline = ta.SplineInterpolator(planned_s, np.column_stack((q, planned_s)))
    joint = np.array(limits.joint_rad_s)
    acceleration = np.array([*limits.joint_rad_s2, 1e6])

    def speed_limits(tau: float) -> Array:
        nozzle = float(np.interp(tau, planned_s, nozzle_m_s))
        top = np.append(joint, min(1.0, limits.nozzle_m_s / max(nozzle, 1e-9)))
        return np.stack((-top, top), axis=1)

    cut = planned_s[:-1, None] + np.diff(planned_s)[:, None] * np.arange(_GRID_STEPS) / _GRID_STEPS
    tau = np.append(cut.ravel(), planned_s[-1])
    problem = algorithm.TOPPRA(
        [
            constraint.JointVelocityConstraintVarying(speed_limits),
            constraint.JointAccelerationConstraint(np.stack((-acceleration, acceleration), axis=1)),
        ],
        spline,
        gridpoints=tau,
        solver_wrapper="seidel",
    )
    _, rate, _ = problem.compute_parameterization(0.0, 0.0)
    if rate is None or not np.all(np.isfinite(rate)):
        raise PlanningError("no way along the joint path keeps the limits: place the part elsewhere")
    rate = np.maximum(rate, 0.0)
    # Between steps the rate's square is linear in tau.
    time = np.concatenate(([0.0], np.cumsum(2.0 * np.diff(tau) / (rate[1:] + rate[:-1]))))
    return tau, rate, time


def robot_path(path: BeadPath, T_base_part: Array, limits: RobotLimitsCfg | None = None) -> RobotPath:
    """The path as the robot executes it.

    Args:
        path: As planned, in the part's frame; its poses become the knots of a cubic spline in joint space.
        T_base_part: Pose of the part, shape (4, 4), m.
        limits: Of the robot; the UR5's by default.

    Returns:
        Joint path and nozzle path with the robot's times.

    Raises:
        PlanningError: If the robot cannot reach the path, or TOPP-RA is missing.
    """
    limits = limits or RobotLimitsCfg()
    q = joint_path(path, T_base_part, limits)
    spline = CubicSpline(path.time_s, q)
    speed = np.linalg.norm(tip_kinematics(q, spline(path.time_s, 1)).twist[:, :3], axis=1)
    tau, rate, time = scale_time(path.time_s, q, speed, limits)
    angles, speeds = spline(tau), spline(tau, 1) * rate[:, None]
    pose = np.linalg.inv(T_base_part) @ tip_kinematics(angles, speeds).pose
    flow = np.interp(tau, path.time_s, path.flow_m3_per_s) * rate
    return RobotPath(
        path=BeadPath(time_s=time, position_m=pose[:, :3, 3], rotation=pose[:, :3, :3], flow_m3_per_s=flow),
        q=angles,
        qd=speeds,
        planned_s=tau,
        rate=rate,
        slow_down=float(time[-1] / (path.time_s[-1] - path.time_s[0])),
    )
