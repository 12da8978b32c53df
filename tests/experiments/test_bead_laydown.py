"""Surfaces of the bead cases, heights at their edges, and what the optimal path gains in the fast tier."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import bead_laydown
from experiments.bead_laydown import Settling, compare, heights_at, lay, on_strip, places, strip_of
from seal_gym.planning import bead_cases
from seal_gym.planning.bead_config import BeadCfg
from seal_gym.planning.bead_path import FINER, naive_path, timed_path
from seal_gym.planning.bead_solver import solve

CFG = BeadCfg()
THETA = CFG.nozzle.fan_angle_rad


def feet_at(strip, spots):
    """Feet of the columns nearest to places on a strip."""
    k = np.argmin(np.abs(strip.arc[:, None] - spots[:, 0]), axis=0)
    j = np.argmin(np.abs(strip.across[:, None] - spots[:, 1]), axis=0)
    return strip.base[k, j]


@pytest.mark.parametrize("name", bead_cases.CASES)
def test_the_edges_lie_on_the_surface(name):
    case = bead_cases.get(name)
    edges = case.edges()
    strip = strip_of(case, edges)
    for edge in (edges.left, edges.right):
        points = edge(np.linspace(0.0, edge.length_m, 50))
        feet = feet_at(strip, on_strip(strip, points))
        # Half a column away along and across; on the wall of a fillet sqrt 2 of it.
        assert np.linalg.norm(feet - points, axis=1).max() < 1.05 * bead_laydown.SPACING_M / 2 * np.sqrt(3)


def test_a_fillet_has_a_wall_and_a_floor():
    case = bead_cases.get("corner_seam")
    strip = strip_of(case, case.edges())
    left, right = strip.across < 0, strip.across > 0
    np.testing.assert_allclose(strip.base[:, left, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(strip.base[:, right, 2], 0.0, atol=1e-12)
    assert strip.base[:, left, 2].min() >= 0.0
    assert strip.base[:, right, 1].max() <= 0.0
    np.testing.assert_allclose(strip.slant, np.sqrt(0.5), rtol=1e-9)


def test_the_gap_has_no_columns():
    case = bead_cases.get("half_circle")
    edges = case.edges()
    strip, whole = strip_of(case, edges), strip_of(replace(case, gap_m=0.0), edges)
    assert whole.there.all()
    # 2 mm wide, as long as the centre line, round at its ends.
    length = bead_laydown.centre_line(edges).length_m
    missing = whole.area.sum() - strip.area.sum()
    assert missing == pytest.approx(2e-3 * length + np.pi * 1e-6, rel=0.01)
    naive = naive_path(edges, case.duration_s, CFG, 801)
    laid = lay(strip, naive, THETA)
    distance = naive.position_m[0, 2]
    assert laid.missed_m3 / laid.sprayed_m3 == pytest.approx(2 * np.arctan(1e-3 / distance) / THETA, rel=0.02)
    assert laid.volume.sum() + laid.missed_m3 == pytest.approx(laid.sprayed_m3, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "corners"),
    [
        ("large_square", [(0.1, -0.1, 0.0), (0.1, 0.1, 0.0), (-0.1, 0.1, 0.0), (-0.1, -0.1, 0.0)]),
        ("over_corner", [(0.12, 0.0, 0.0)]),
        ("corner_seam", []),
    ],
)
def test_corners_are_where_the_line_bends(name, corners):
    case = bead_cases.get(name)
    edges = case.edges()
    at, line = places(edges, strip_of(case, edges)), bead_laydown.centre_line(edges)
    where = line(at.along_m[at.corner])
    assert all(np.linalg.norm(where - c, axis=1).min() < 5e-3 for c in corners)
    assert all(min(np.linalg.norm(p - np.array(c)) for c in corners) < 12e-3 for p in where)


def test_heights_are_means_over_a_patch():
    case = bead_cases.get("zig_zag")
    edges = case.edges()
    strip = strip_of(case, edges)
    laid = lay(strip, naive_path(edges, case.duration_s, CFG, 201), THETA)
    plane = 1e-3 + 0.01 * strip.base[..., 0] + 0.02 * strip.base[..., 1]
    at = places(edges, strip)
    found = heights_at(strip, laid._replace(height=plane), at.left)
    expected = edges.left(at.along_m / bead_laydown.centre_line(edges).length_m * edges.left.length_m)
    # The patch is a disc about a place 2 mm inside the edge.
    assert np.abs(found - (1e-3 + 0.01 * expected[:, 0] + 0.02 * expected[:, 1])).max() < 0.0225 * 2.5e-3
    outside = np.array([[strip.arc[-1] + 1.0, 0.0]])
    assert np.isnan(heights_at(strip, laid, outside)).all()


@pytest.mark.parametrize(
    "name",
    [
        "zig_zag",
        pytest.param("half_circle", marks=pytest.mark.slow),
        pytest.param("large_square", marks=pytest.mark.slow),
    ],
)
def test_the_optimal_path_evens_out_the_edges(name):
    case = bead_cases.get(name)
    edges = case.edges()
    found = solve(edges, case.duration_s, CFG)
    optimal = timed_path(edges, found.nodes.finer(FINER), CFG)
    naive = naive_path(edges, case.duration_s, CFG, 1201)
    beads = compare(case, edges, {"naive": naive, "ipopt": optimal, "robot": optimal}, THETA, Settling())
    row = beads.row()
    assert row["ipopt_reduction"] >= 5.0
    assert row["ipopt_laid_corner_worst_mm"] < row["naive_laid_corner_worst_mm"] / 5.0
    assert row["reduction_word"] == ""
    for who in ("naive", "ipopt"):
        laid = beads.laid[who]
        assert laid.volume.sum() + laid.missed_m3 == pytest.approx(
            CFG.nozzle.flow_m3_per_s * case.duration_s, rel=1e-9
        )


@pytest.mark.parametrize("name", ["over_corner", "corner_seam"])
def test_edges_of_equal_length_have_nothing_to_even_out(name):
    case = bead_cases.get(name)
    edges = case.edges()
    row = compare(
        case, edges, {"naive": naive_path(edges, case.duration_s, CFG, 801)}, THETA, Settling()
    ).row()
    assert row["reduction_word"] == "naive equal already"
    assert row["ipopt_reduction"] is None
    assert row["ipopt_laid_min_mm"] is None
    assert row["naive_laid_difference_mm"] < 0.02


def test_a_runny_bead_settles():
    case = bead_cases.get("corner_seam")
    edges = case.edges()
    strip = strip_of(case, edges, 1e-3)
    naive = naive_path(edges, case.duration_s, CFG, 201)
    fresh = lay(strip, naive, THETA)
    rested = lay(strip, naive, THETA, Settling(sealant="self_levelling", duration_s=1.0))
    assert rested.volume.sum() == pytest.approx(fresh.volume.sum(), rel=1e-12)
    # Out of the wall into the corner and over the floor.
    wall = strip.across < -3e-3
    assert rested.volume[:, wall].sum() < 0.9 * fresh.volume[:, wall].sum()
