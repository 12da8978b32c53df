"""Resolve: from the root's natural form to joint accelerations, damped near singularities."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from seal_gym.rmp.algebra import Array, Leaf, Rmp, gather, identity, solve
from seal_gym.rmp.checks import require_positive

_LENGTH_ROWS = 3
"""Rows of a tip Jacobian that are lengths; the rows after them are rotations."""


@dataclass(frozen=True, kw_only=True)
class ResolveCfg:
    """How to resolve near and at singularities.

    The damping grows from zero at ``sigma_min = epsilon`` to ``damping`` at ``sigma_min = 0`` (Nakamura and
    Hanafusa 1986; Chiaverini 1994).
    """

    damping: float = 0.05
    """lambda_0, the damping at a singularity, relative to the root of the mean eigenvalue of A_q."""
    epsilon: float = 0.05
    """Smallest singular value below which damping acts. [m]. The cell's start postures have 0.10-0.14."""
    length_m: float = 0.25
    """Length that makes a rotation comparable with a translation: one radian counts as this many metres.
    0.25 m is the distance from the flange to the nozzle mouth, so a singular value is the speed of the mouth
    that a unit joint velocity causes, by shift or by swing about the wrist."""
    floor: float = 1e-12
    """Added to the diagonal, relative to its mean and absolutely: lets metrics that leave directions open
    (all zero, or a policy's singular A alone) be solved; far below what changes a regular solution."""

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require_positive(self, "damping", "epsilon", "length_m", "floor")


DEFAULT_RESOLVE = ResolveCfg()


def damping_squared(jacobian: Array, cfg: ResolveCfg = DEFAULT_RESOLVE) -> Array:
    """Damping lambda^2 for a unit metric: ``lambda0^2 (1 - (sigma_min / epsilon)^2)`` below epsilon, else 0.

    Args:
        jacobian: Shape (..., m, n); rows 0-2 are lengths [m/rad], later rows rotations [rad/rad].
        cfg: Damping, threshold and the length that scales the rotation rows.

    Returns:
        lambda^2, continuous in the Jacobian. Shape (...).
    """
    scaled = jacobian * _row_lengths(jacobian.shape[-2], cfg.length_m)
    smallest = np.linalg.svd(scaled, compute_uv=False)[..., -1]
    ratio = smallest / cfg.epsilon
    squared: Array = cfg.damping**2 * np.maximum(1.0 - ratio * ratio, 0.0)
    return squared


def resolve(policy: Rmp | Sequence[Leaf], jacobian: Array, cfg: ResolveCfg = DEFAULT_RESOLVE) -> Array:
    """Joint accelerations ``(A_q + (lambda^2 + floor) a I)^-1 F_q`` of a summed policy.

    Zhou et al., Eq. 21, whose plain pseudo-inverse jumps and explodes at the UR5's wrist singularity. The
    scale ``a = trace(A_q) / n`` makes the damping relative to the root's metric: multiplying every metric by
    a number changes nothing.

    Args:
        policy: The root's natural form, (..., n) and (..., n, n), or the leaves to pull back and sum.
        jacobian: The tip Jacobian whose singularities call for damping. Shape (..., m, n).
        cfg: Damping and floor.

    Returns:
        qddot [rad/s^2]. Shape (..., n).
    """
    force, metric = policy if isinstance(policy, Rmp) else gather(policy)
    size = metric.shape[-1]
    scale = np.trace(metric, axis1=-2, axis2=-1) / size
    added = (damping_squared(jacobian, cfg) + cfg.floor) * scale + cfg.floor
    return solve(metric + added[..., None, None] * identity(size), force)


@cache
def _row_lengths(rows: int, length_m: float) -> Array:
    """Factor of each row of a tip Jacobian: 1 for lengths, ``length_m`` for rotations. Shape (rows, 1)."""
    return np.where(np.arange(rows) < _LENGTH_ROWS, 1.0, length_m)[:, None]
