"""The measured footprint against beads that are known by hand."""

import numpy as np
import pytest

from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_curves import Curve, Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_path import naive_path
from seal_gym.planning.bead_projection import footprint, height_spread

CFG = BeadCfg()
ASIDE = np.array([0.0, 0.008, 0.0])
THETA, FLOW = CFG.nozzle.fan_angle_rad, CFG.nozzle.flow_m3_per_s


def arc(radius, turn=2.0, n=800):
    angle = np.linspace(0.0, turn, n)
    return Curve.through(np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0 * angle)))


def height(width, speed):
    """Of a straight bead of the nozzle upright: flow per angle over area per angle."""
    offset = width / 2 / np.tan(THETA / 2)
    return FLOW / THETA / (offset / np.cos(THETA / 2) ** 2 * speed)


def test_a_straight_bead():
    points = np.linspace(0.0, 0.2, 30)[:, None] * [1.0, 0.0, 0.0]
    edges = Edges(Curve.through(points + ASIDE), Curve.through(points - ASIDE))
    found = footprint(naive_path(edges, 0.5, CFG, 101), edges, THETA)
    np.testing.assert_allclose(found.left_height_m, height(0.016, 0.4), rtol=1e-5)
    np.testing.assert_allclose(found.right_height_m, found.left_height_m, rtol=1e-9)
    assert max(found.left_miss_m.max(), found.right_miss_m.max()) < 1e-9
    assert found.spread < 1e-6


def test_on_an_arc_the_inner_edge_gets_more_in_proportion_to_the_radii():
    inner, outer, seconds = 0.05, 0.07, 1.0
    edges = Edges(arc(inner), arc(outer))  # counter-clockwise: the inner edge is the left one
    found = footprint(naive_path(edges, seconds, CFG, 2001), edges, THETA)
    middle = height(0.02, 0.06 * 2.0 / seconds)
    np.testing.assert_allclose(found.left_height_m, middle * 0.06 / inner, rtol=1e-4)
    np.testing.assert_allclose(found.right_height_m, middle * 0.06 / outer, rtol=1e-4)
    assert found.spread == pytest.approx(
        (0.06 / inner - 0.06 / outer) / (0.03 / inner + 0.03 / outer), rel=1e-3
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_over_a_cylinder_heights_follow_the_surface_not_the_nozzle(sign):
    # Along the circumference of a cylinder the surface passes at the edges' speed, whatever the nozzle's.
    radius, half = 0.06, 0.007
    angle = np.linspace(0.0, 1.5, 600)
    ring = np.column_stack((np.sin(angle), 0 * angle, sign * np.cos(angle)))
    edges = Edges(Curve.through(radius * ring + [0, half, 0]), Curve.through(radius * ring - [0, half, 0]))
    found = footprint(naive_path(edges, 1.0, CFG, 1001), edges, THETA)
    np.testing.assert_allclose(found.left_height_m, height(2 * half, radius * 1.5), rtol=1e-4)
    assert found.spread < 1e-4


def test_a_slow_down_that_the_flow_follows_changes_nothing():
    edges = Edges(arc(0.05), arc(0.07))
    path = naive_path(edges, 1.0, CFG, 801)
    rate = 0.3 + 0.2 * np.sin(7.0 * path.time_s)
    # Piecewise linear in the new time, so that the trapezoidal sums of volume are exact.
    time = np.concatenate(([0.0], np.cumsum(2 * np.diff(path.time_s) / (rate[1:] + rate[:-1]))))
    slow = BeadPath(
        time_s=time,
        position_m=path.position_m,
        rotation=path.rotation,
        flow_m3_per_s=path.flow_m3_per_s * rate,
    )
    before, after = footprint(path, edges, THETA), footprint(slow, edges, THETA)
    np.testing.assert_allclose(after.left_height_m, before.left_height_m, rtol=1e-9)
    # Without the flow's following the bead swells by the slow-down.
    swollen = footprint(
        BeadPath(
            time_s=time,
            position_m=path.position_m,
            rotation=path.rotation,
            flow_m3_per_s=path.flow_m3_per_s,
        ),
        edges,
        THETA,
    )
    np.testing.assert_allclose(
        swollen.left_height_m[5:-5] * rate[5:-5], before.left_height_m[5:-5], rtol=1e-2
    )


def test_spread_by_hand():
    assert height_spread(np.array([1.0, 2.0, 3.0])) == pytest.approx(1.0)
    assert height_spread(np.array([1.0, np.inf])) == np.inf
