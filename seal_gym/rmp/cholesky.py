"""A positive semi-definite metric as the entries of its Cholesky factor, the form a network emits.

Zhou et al., 2.3, let the network emit half of the metric's elements. That allows indefinite metrics, with
which the sum is no longer associative; the factor ``A = L L^T`` makes every output a valid metric.
"""

from functools import cache

import numpy as np

from seal_gym.core.errors import ActionError, require
from seal_gym.rmp.algebra import Array

_SEMIDEFINITE_RTOL = 1e-12
"""Pivots below this share of the largest diagonal entry count as zero."""


def cholesky_metric(params: Array) -> Array:
    """Metric ``A = L L^T`` from the entries of the lower triangle L, row by row.

    Args:
        params: L00, L10, L11, L20, ...; n (n + 1) / 2 of them (21 for n = 6). Any finite numbers.
            Shape (..., n (n + 1) / 2).

    Returns:
        Symmetric positive semi-definite; definite if no diagonal entry is zero. Shape (..., n, n).
    """
    size = metric_size(params.shape[-1])
    lower = np.zeros((*params.shape[:-1], size, size))
    rows, columns = _triangle(size)
    lower[..., rows, columns] = params
    product: Array = np.matmul(lower, lower.mT)
    return product


def metric_to_cholesky(metric: Array) -> Array:
    """Entries of the lower Cholesky factor of a metric: the inverse of ``cholesky_metric``.

    Unlike ``np.linalg.cholesky`` it accepts semi-definite metrics (projectors): a pivot of zero gives a zero
    column. Signs are such that the diagonal is not negative.

    Args:
        metric: Symmetric positive semi-definite. Shape (..., n, n).

    Returns:
        Row by row. Shape (..., n (n + 1) / 2).
    """
    size = metric.shape[-1]
    lower = np.zeros_like(metric)
    rest = np.array(metric, dtype=np.float64)
    smallest = _SEMIDEFINITE_RTOL * np.max(np.diagonal(metric, axis1=-2, axis2=-1), axis=-1)
    for k in range(size):
        pivot = rest[..., k, k]
        positive = pivot > smallest
        root = np.sqrt(np.where(positive, pivot, 1.0))
        column = np.where(positive[..., None], rest[..., :, k] / root[..., None], 0.0)
        column[..., :k] = 0.0
        lower[..., :, k] = column
        rest -= column[..., :, None] * column[..., None, :]
    rows, columns = _triangle(size)
    entries: Array = lower[..., rows, columns]
    return entries


@cache
def metric_size(count: int) -> int:
    """Size n of the metric that ``count = n (n + 1) / 2`` Cholesky entries describe.

    Args:
        count: Number of entries: 1, 3, 6, 10, 15, 21, ...

    Returns:
        n.

    Raises:
        ActionError: If no n has that many entries.
    """
    size = int((np.sqrt(8 * count + 1) - 1) / 2)
    valid = size > 0 and size * (size + 1) // 2 == count
    message = f"{count} Cholesky entries fit no metric; give n (n + 1) / 2: 6 for 3x3, 21 for 6x6"
    require(valid, message, ActionError)
    return size


@cache
def _triangle(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column indices of the lower triangle, row by row."""
    return np.tril_indices(size)
