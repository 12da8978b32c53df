"""The RMP algebra: pull leaves back through their task maps and sum them (Zhou et al., Eqs. 18-24).

A leaf is a desired acceleration ``f`` in a task space and a metric ``A`` that says in which directions it
matters. Its natural form is ``(F, A)`` with ``F = A f``. Arrays carry any leading batch dimensions
(``...``), usually the N simulations; every product is one small matrix product per simulation, so a batch
gives the same bits as its members one by one.
"""

from collections.abc import Iterable, Sequence
from functools import cache, reduce
from operator import add
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Rmp(NamedTuple):
    """An RMP in natural form, in a space of n coordinates."""

    force: Array
    """A f. Shape (..., n)."""
    metric: Array
    """A, symmetric and positive semi-definite. Shape (..., n, n)."""


class Leaf(NamedTuple):
    """A policy in an m-dimensional task space, with the first and second order of its map from n joints.

    The task velocity is ``jacobian @ qdot``; the task acceleration is ``jacobian @ qddot + drift``.
    """

    jacobian: Array
    """J. Shape (..., m, n)."""
    drift: Array
    """Jdot qdot, the task acceleration at zero joint acceleration. Shape (..., m)."""
    accel: Array
    """f, the desired task acceleration. Shape (..., m)."""
    metric: Array
    """A, symmetric and positive semi-definite. Shape (..., m, m)."""


def apply(matrix: Array, vector: Array) -> Array:
    """Product of matrices (..., m, n) and vectors (..., n). Shape (..., m)."""
    product: Array = np.matmul(matrix, vector[..., None])[..., 0]
    return product


@cache
def identity(size: int) -> Array:
    """Unit matrix, read-only and shared. Shape (size, size)."""
    unit = np.eye(size)
    unit.flags.writeable = False
    return unit


def solve(matrix: Array, vector: Array) -> Array:
    """Solution x of ``matrix @ x = vector``, of shape (..., n), for (..., n, n) and (..., n)."""
    solution = np.linalg.solve(matrix, vector[..., None])[..., 0]
    return np.asarray(solution, dtype=np.float64)


def pullback(leaf: Leaf) -> Rmp:
    """Pulls a leaf back to its joint space: ``A_q = J^T A J``, ``F_q = J^T A (f - Jdot qdot)``.

    Zhou et al., Eqs. 20-21, which omit ``Jdot qdot``: without it the realised task acceleration is off by
    that term, and a damped arm gains energy.

    Args:
        leaf: Jacobian (..., m, n), drift (..., m), accel (..., m) and metric (..., m, m).

    Returns:
        The natural form in joint space, (..., n) and (..., n, n).
    """
    jacobian, drift, accel, metric = leaf
    transposed = jacobian.mT
    weighted = np.matmul(transposed, metric)
    return Rmp(force=apply(weighted, accel - drift), metric=np.matmul(weighted, jacobian))


def combine(rmps: Iterable[Rmp]) -> Rmp:
    """Sums RMPs of one space: forces and metrics add.

    Zhou et al., Eqs. 22-24. The text after Eq. 24 averages the metrics; the combined metric is their sum,
    and the combined acceleration ``A^-1 F`` is the metric-weighted mean.

    Args:
        rmps: At least one, all in the same space.

    Returns:
        The sum, in the same space.
    """
    forces, metrics = zip(*rmps, strict=True)
    return Rmp(force=_total(forces), metric=_total(metrics))


def gather(leaves: Iterable[Leaf]) -> Rmp:
    """Pulls leaves back and sums them; the same as ``combine(pullback(leaf) for leaf in leaves)``, faster.

    Leaves that share their Jacobian and drift (the same array objects) are summed in task space first and
    pulled back once: ``sum J^T A_i J = J^T (sum A_i) J``.

    Args:
        leaves: At least one; all map from the same joint space.

    Returns:
        The natural form in joint space, (..., n) and (..., n, n).
    """
    groups: dict[tuple[object, ...], list[Leaf]] = {}
    for leaf in leaves:
        key = (id(leaf.jacobian), id(leaf.drift), leaf.accel.shape, leaf.metric.shape)
        groups.setdefault(key, []).append(leaf)
    return combine(_pull_group(group) for group in groups.values())


def _pull_group(group: Sequence[Leaf]) -> Rmp:
    """Natural form in joint space of leaves that share Jacobian and drift."""
    jacobian, drift = group[0].jacobian, group[0].drift
    metrics = [leaf.metric for leaf in group]
    forces = apply(np.array(metrics), np.array([leaf.accel for leaf in group]))
    metric = _total(metrics)
    force = _total(forces) - apply(metric, drift)
    transposed = jacobian.mT
    return Rmp(force=apply(transposed, force), metric=np.matmul(np.matmul(transposed, metric), jacobian))


def _total(terms: Iterable[Array]) -> Array:
    """Sum of arrays in their order, whatever the batch (``np.sum`` may change it with the shape)."""
    total: Array = reduce(add, terms)
    return total
