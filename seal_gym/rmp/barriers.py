"""Leaves that keep away from something: joint limits and obstacles.

Both act on a distance: nothing at all beyond a margin, and inside it a metric that grows as the square of the
depth, a spring outward and a damper on approach only. Force and metric are continuous at the margin.
"""

from dataclasses import dataclass

import numpy as np

from seal_gym.rmp.algebra import Array, Leaf, identity
from seal_gym.rmp.checks import require_positive


@dataclass(frozen=True, kw_only=True)
class BarrierCfg:
    """A one-sided spring and damper below a distance.

    ``margin`` is in the unit of the distance: m for obstacles, rad for joints.
    """

    margin: float
    """Distance below which the leaf acts. [m] or [rad]."""
    omega_n: float = 12.0
    """Natural frequency of the spring on the depth [rad/s]."""
    zeta: float = 1.0
    """Damping ratio against approach; leaving is free."""
    weight: float = 100.0
    """Metric at distance zero; tip leaves have about 1."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "margin", "omega_n", "zeta", "weight")


@dataclass(frozen=True, kw_only=True)
class JointLimitCfg(BarrierCfg):
    """Joint limits: acts within 10 degrees of one."""

    margin: float = 0.17


@dataclass(frozen=True, kw_only=True)
class ObstacleCfg(BarrierCfg):
    """Obstacles: acts within 20 mm of one."""

    margin: float = 0.02


JOINT_LIMIT = JointLimitCfg()
OBSTACLE = ObstacleCfg()


def joint_limits(q: Array, qd: Array, lower: Array, upper: Array, cfg: JointLimitCfg = JOINT_LIMIT) -> Leaf:
    """Keeps joints off their limits. Its task space is the joint space.

    Args:
        q: Joint angles [rad]. Shape (..., n).
        qd: Joint velocities [rad/s]. Shape (..., n).
        lower: Lower limits, -inf for none [rad]. Shape (n,) or (..., n).
        upper: Upper limits, inf for none [rad]. Shape (n,) or (..., n).
        cfg: Margin and gains.

    Returns:
        Pushes inward and damps outward velocity near a limit; the diagonal metric is 0 away from limits.
    """
    accel_low, weight_low = barrier(q - lower, qd, cfg)
    accel_high, weight_high = barrier(upper - q, -qd, cfg)
    weight = weight_low + weight_high
    accel = (weight_low * accel_low - weight_high * accel_high) / np.where(weight > 0.0, weight, 1.0)
    unit = identity(q.shape[-1])
    jacobian = np.broadcast_to(unit, (*q.shape, q.shape[-1]))
    return Leaf(jacobian=jacobian, drift=np.zeros_like(q), accel=accel, metric=weight[..., None] * unit)


def obstacle(
    distance: Array, rate: Array, gradient: Array, drift: Array, cfg: ObstacleCfg = OBSTACLE
) -> Leaf:
    """Keeps a scalar distance positive.

    Args:
        distance: Distance to the obstacle, negative inside [m]. Shape (...).
        rate: Its time derivative, gradient . qdot plus the obstacle's own motion [m/s]. Shape (...).
        gradient: Of the distance with respect to the joints [m/rad]. Shape (..., n).
        drift: d/dt(gradient) . qdot; zero for a flat obstacle near a slow arm [m/s^2]. Shape (...).
        cfg: Margin and gains.

    Returns:
        A leaf on a one-dimensional task: Jacobian (..., 1, n), metric (..., 1, 1).
    """
    accel, weight = barrier(distance, rate, cfg)
    return Leaf(
        jacobian=gradient[..., None, :],
        drift=drift[..., None],
        accel=accel[..., None],
        metric=weight[..., None, None],
    )


def barrier(distance: Array, rate: Array, cfg: BarrierCfg) -> tuple[Array, Array]:
    """Acceleration away from zero distance, and its weight.

    Args:
        distance: [m] or [rad]. Shape (...).
        rate: Its time derivative [m/s] or [rad/s]. Shape (...).
        cfg: Margin and gains.

    Returns:
        Acceleration and metric, the latter zero beyond the margin. Shape (...) each.
    """
    depth = np.maximum(1.0 - distance / cfg.margin, 0.0)
    spring = cfg.omega_n**2 * cfg.margin * depth
    accel = spring - 2.0 * cfg.zeta * cfg.omega_n * np.minimum(rate, 0.0)
    return accel, cfg.weight * depth**2
