"""Edge curves against known curves and the properties of Bezier curves."""

import numpy as np
import pytest
from scipy.special import comb

from seal_gym.core.errors import SeamError
from seal_gym.planning.bead_curves import Curve, Edges, bezier, bezier_smooth, offset_polyline

CORNER = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.02]])


def distance_to_polyline(points, polyline):
    start, leg = polyline[:-1], np.diff(polyline, axis=0)
    to = points[:, None] - start
    along = np.clip(np.sum(to * leg, -1) / np.sum(leg**2, -1), 0.0, 1.0)
    return np.linalg.norm(to - along[..., None] * leg, axis=-1).min(axis=1)


@pytest.mark.parametrize("degree", [1, 3, 9])
def test_bezier_is_the_sum_of_bernstein_polynomials(degree):
    control = np.random.default_rng(0).normal(size=(degree + 1, 3))
    t = np.linspace(0.0, 1.0, 31)
    k = np.arange(degree + 1)
    weight = comb(degree, k) * t[:, None] ** k * (1 - t[:, None]) ** (degree - k)
    np.testing.assert_allclose(bezier(control, t), weight @ control, atol=1e-12)


def test_bezier_of_thousands_of_points_keeps_their_centre_and_linear_functions():
    control = np.linspace(0.0, 1.0, 5001)[:, None] * [1.0, -2.0, 0.5]
    t = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(bezier(control, t), t[:, None] * [1.0, -2.0, 0.5], atol=1e-12)


def test_smoothing_keeps_ends_and_end_directions():
    smooth = bezier_smooth(CORNER, 5e-3)
    np.testing.assert_allclose(smooth[[0, -1]], CORNER[[0, -1]], atol=1e-12)
    curve = Curve.through(smooth)
    ends = curve.tangent(np.array([0.0, curve.length_m]))
    legs = np.diff(CORNER, axis=0)
    np.testing.assert_allclose(ends, legs / np.linalg.norm(legs, axis=1, keepdims=True), atol=1e-6)


def test_smoothing_stays_in_the_hull_and_leaves_straights_straight():
    smooth = bezier_smooth(CORNER, 5e-3)
    # Barycentric coordinates in the triangle of the three points.
    share = np.linalg.lstsq(np.vstack((CORNER.T, np.ones(3))), np.vstack((smooth.T, np.ones(len(smooth)))))[0]
    assert share.min() > -1e-9
    straight = bezier_smooth(np.array([[0.0, 0, 0], [0.03, 0, 0], [0.2, 0, 0]]), 5e-3)
    np.testing.assert_allclose(straight[:, 1:], 0.0, atol=1e-15)


def test_the_smaller_the_spread_the_closer_the_curve():
    # At a right angle a Gaussian of deviation s cuts the corner by s / sqrt(pi).
    spreads = np.array([8e-3, 4e-3, 2e-3])
    corner = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0]])
    cut = [np.linalg.norm(bezier_smooth(corner, s) - corner[1], axis=1).min() for s in spreads]
    np.testing.assert_allclose(cut, spreads / np.sqrt(np.pi), rtol=0.02)
    for s in spreads:
        assert distance_to_polyline(bezier_smooth(corner, s), corner).max() < s / np.sqrt(np.pi)


def test_arc_length_of_a_helix():
    radius, pitch = 0.06, 0.03
    angle = np.linspace(0.0, 5.0, 400) + 0.3 * np.sin(np.linspace(0.0, 5.0, 400))  # unevenly sampled
    curve = Curve.through(np.column_stack((radius * np.cos(angle), radius * np.sin(angle), pitch * angle)))
    per_angle = np.hypot(radius, pitch)
    np.testing.assert_allclose(curve.length_m, per_angle * (angle[-1] - angle[0]), rtol=1e-8)
    s = np.linspace(0.0, curve.length_m, 57)
    at = angle[0] + s / per_angle
    wanted = np.column_stack((radius * np.cos(at), radius * np.sin(at), pitch * at))
    np.testing.assert_allclose(curve(s), wanted, atol=1e-8)
    tangent = (
        np.column_stack((-radius * np.sin(at), radius * np.cos(at), np.full_like(at, pitch))) / per_angle
    )
    np.testing.assert_allclose(curve.tangent(s), tangent, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(curve(s, 2), axis=1)[2:-2], radius / per_angle**2, rtol=1e-3)


def test_smoothed_corners_have_unit_speed():
    curve = Curve.smoothed(CORNER, 5e-3)
    s = np.linspace(0.0, curve.length_m, 3001)
    np.testing.assert_allclose(np.linalg.norm(curve(s, 1), axis=1), 1.0, atol=1e-6)


def test_offset_of_a_closed_square_is_a_square():
    square = np.array([(0, -1), (1, -1), (1, 1), (-1, 1), (-1, -1), (0, -1)], float)
    points = np.column_stack((square, np.zeros(6)))
    inner = offset_polyline(points, [0, 0, 1], 0.25, closed=True)
    np.testing.assert_allclose(inner, 0.75 * points, atol=1e-12)
    # An open one ends square to its end legs.
    bent = offset_polyline(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]), [0, 0, 1], -0.1)
    np.testing.assert_allclose(bent, [[0, -0.1, 0], [1.1, -0.1, 0], [1.1, 1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("points", "spread", "word"),
    [
        ([[0, 0, 0]], 1e-3, "n >= 2"),
        ([[0, 0], [1, 1]], 1e-3, "must be"),
        ([[0, 0, 0], [np.nan, 0, 0]], 1e-3, "finite"),
        ([[0, 0, 0], [1, 0, 0], [1, 0, 0]], 1e-3, "points 1 and 2"),
        ([[0, 0, 0], [1, 0, 0]], 0.0, "spread_m"),
        ([[0, 0, 0], [1, 0, 0]], 0.3, "quarter"),
    ],
)
def test_bad_points(points, spread, word):
    with pytest.raises(SeamError, match=word):
        bezier_smooth(points, spread)


def test_edges_that_touch_are_refused():
    left = np.array([[0.0, 0.01, 0], [0.2, -0.01, 0]])
    with pytest.raises(SeamError, match="apart"):
        Edges.smoothed(left, left * [1, -1, 1], 5e-3)


def test_a_polyline_that_turns_back_has_no_offset():
    with pytest.raises(SeamError, match="turns back"):
        offset_polyline([[0, 0, 0], [1, 0, 0], [0, 0, 0]], [0, 0, 1], 0.1)


def test_too_few_points_for_a_curve():
    with pytest.raises(SeamError, match="at least 6"):
        Curve.through([[0, 0, 0], [1, 0, 0]])
