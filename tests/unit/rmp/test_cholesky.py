"""Metrics from and to Cholesky entries."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from seal_gym.core.errors import ActionError
from seal_gym.rmp import cholesky_metric, metric_size, metric_to_cholesky

entries = arrays(np.float64, 21, elements=st.floats(-10, 10, allow_subnormal=False))


def test_entries_fill_the_triangle_row_by_row():
    metric = cholesky_metric(np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(metric, [[1.0, 2.0], [2.0, 13.0]])


@given(entries)
@settings(deadline=None)
def test_any_entries_give_a_symmetric_semidefinite_metric(params):
    metric = cholesky_metric(params)
    np.testing.assert_array_equal(metric, metric.T)
    eigenvalues = np.linalg.eigvalsh(metric)
    assert eigenvalues[0] >= -1e-12 * max(eigenvalues[-1], 1e-300)


@given(arrays(np.float64, (3, 21), elements=st.floats(-2, 2)), st.floats(0.3, 3.0))
@settings(deadline=None)
def test_round_trip_from_entries_with_positive_diagonal(params, diagonal):
    params[:, [0, 2, 5, 9, 14, 20]] = diagonal
    assert np.all(np.linalg.eigvalsh(cholesky_metric(params)) > 0.0)
    np.testing.assert_allclose(metric_to_cholesky(cholesky_metric(params)), params, atol=1e-5)


def test_agrees_with_numpy_on_definite_metrics():
    root = np.random.default_rng(0).normal(size=(8, 6, 6))
    metric = root @ root.mT + 0.1 * np.eye(6)
    lower = np.linalg.cholesky(metric)
    rows, columns = np.tril_indices(6)
    np.testing.assert_allclose(metric_to_cholesky(metric), lower[:, rows, columns], atol=1e-10)


def test_semidefinite_metrics_survive():
    projector = np.diag([0.0, 2.0, 0.0])
    ones = np.ones((3, 3))
    metrics = np.array([projector, ones, np.zeros((3, 3))])
    np.testing.assert_allclose(cholesky_metric(metric_to_cholesky(metrics)), metrics, atol=1e-14)


@pytest.mark.parametrize(("count", "size"), [(1, 1), (6, 3), (21, 6), (28, 7)])
def test_sizes(count, size):
    assert metric_size(count) == size
    assert cholesky_metric(np.zeros((2, count))).shape == (2, size, size)


@pytest.mark.parametrize("count", [0, 2, 20, 22])
def test_wrong_counts_are_refused(count):
    with pytest.raises(ActionError, match=f"{count} Cholesky entries"):
        cholesky_metric(np.zeros(count))
