"""Optimal bead paths: constraints re-evaluated without the solver, two solvers, and cases without a path."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError, SeamError
from seal_gym.planning import bead_cases, bead_projection, bead_solver
from seal_gym.planning.bead_config import BeadCfg, BeadNodes, PlanningError
from seal_gym.planning.bead_curves import Edges, offset_polyline
from seal_gym.planning.bead_geometry import ratio_of_tilt
from seal_gym.planning.bead_path import cost, naive_path, quantities, timed_path
from seal_gym.planning.bead_reach import least_tilt, reachable_ends
from seal_gym.planning.bead_slsqp import solve_slsqp
from seal_gym.planning.bead_solver import BeadSolution, Infeasibility, first_nodes, solve

CFG = BeadCfg()
THETA = CFG.nozzle.fan_angle_rad


@pytest.fixture(scope="module")
def bend():
    """A quick case: one bend of 60 deg, 15 mm wide."""
    points = np.array([[0.0, 0, 0], [0.06, 0, 0], [0.09, 0.052, 0]])
    left, right = (offset_polyline(points, [0, 0, 1], side * 7.5e-3) for side in (1, -1))
    return Edges.smoothed(left, right, 8e-3)


@pytest.fixture(scope="module")
def solution(bend):
    found = solve(bend, 0.4)
    assert isinstance(found, BeadSolution)
    return found


@pytest.mark.parametrize("name", [n for n in bead_cases.CASES if bead_cases.get(n).feasible])
def test_every_feasible_case_is_solved_within_the_limits(name):
    case = bead_cases.get(name)
    edges = case.edges()
    found = solve(edges, case.duration_s)
    assert isinstance(found, BeadSolution)
    nodes = found.nodes
    # The nodes obey the printed recursions, here summed afresh.
    dt = np.diff(nodes.time_s)
    for arc, speed, length in (
        (nodes.u_m, nodes.u_dot, edges.left.length_m),
        (nodes.w_m, nodes.w_dot, edges.right.length_m),
    ):
        np.testing.assert_allclose(np.diff(arc), (speed[1:] + speed[:-1]) / 2 * dt, atol=1e-8)
        np.testing.assert_allclose(arc[[0, -1]], [0.0, length], atol=1e-9)
        assert speed.min() > 0.1 - 1e-6
        assert speed.max() < 1.0 + 1e-6
    assert nodes.time_s[-1] == pytest.approx(case.duration_s, rel=1e-6)
    np.testing.assert_allclose(nodes.drag_rad[[0, -1]], 0.0, atol=1e-9)
    assert np.abs(nodes.drag_rad).max() < CFG.drag_rad + 1e-6
    # Ten times finer, from the nozzle's poses alone: b, c, tilt and the ends of the fan.
    fine = nodes.finer(10)
    path = timed_path(edges, fine, CFG)
    to_left, to_right = edges.left(fine.u_m) - path.position_m, edges.right(fine.w_m) - path.position_m
    for to in (to_left, to_right):
        distance = np.linalg.norm(to, axis=1)
        assert distance.min() > 0.01 * (1 - 2e-3)
        assert distance.max() < 0.1 * (1 + 2e-3)
    chord = edges.right(fine.w_m) - edges.left(fine.u_m)
    axis, across = path.rotation[..., 2], chord / np.linalg.norm(chord, axis=1, keepdims=True)
    assert np.rad2deg(np.abs(np.arcsin(np.sum(axis * across, axis=1)))).max() < 30.1
    foot = bead_projection.footprint(path, edges, THETA)
    assert foot.spread < 0.02
    assert max(foot.left_miss_m.max(), foot.right_miss_m.max()) < 1e-5


def test_heights_agree_between_closed_form_and_rays(bend, solution):
    fine = solution.nodes.finer(10)
    q = quantities(bend, fine, CFG)
    foot = bead_projection.footprint(timed_path(bend, fine, CFG), bend, THETA)
    np.testing.assert_allclose(foot.left_height_m, q.g_m, rtol=2e-3)
    np.testing.assert_allclose(foot.right_height_m, q.h_m, rtol=2e-3)
    assert np.abs(q.g_m - q.g_m.mean()).max() < CFG.height_tolerance_m
    np.testing.assert_allclose(q.beta_rad + q.gamma_rad, np.pi - THETA, rtol=1e-12)
    np.testing.assert_allclose(q.b_m * np.sin(q.gamma_rad), q.c_m * np.sin(q.beta_rad), rtol=1e-12)


def test_the_optimum_is_better_than_the_naive_path(bend, solution):
    optimal = timed_path(bend, solution.nodes.finer(10), CFG)
    naive = naive_path(bend, 0.4, CFG)
    assert bead_projection.footprint(optimal, bend, THETA).spread < 0.01
    assert bead_projection.footprint(naive, bend, THETA).spread > 0.3
    assert naive.time_s[-1] == pytest.approx(optimal.time_s[-1])
    np.testing.assert_allclose(naive.flow_m3_per_s.mean(), optimal.flow_m3_per_s.mean())


def test_slsqp_and_ipopt_agree_on_the_cost(bend, solution):
    other = solve_slsqp(bend, 0.4, CFG, 30)
    assert other.cost == pytest.approx(solution.cost, rel=5e-4)
    near = other.nodes.at(solution.nodes.time_s)
    np.testing.assert_allclose(near.u_dot, solution.nodes.u_dot, atol=0.01)
    # SLSQP holds the height at its own nodes.
    q = quantities(bend, other.nodes, CFG)
    np.testing.assert_allclose(q.g_m, q.g_m[0], atol=CFG.height_tolerance_m)


def test_no_perturbation_of_a_straight_bead_costs_less():
    # Moves that keep the heights equal and constant, built by hand on a straight bead.
    straight = np.linspace(0.0, 0.1, 2)[:, None] * [1.0, 0.0, 0.0]
    aside = np.array([0.0, 7.5e-3, 0.0])
    edges = Edges.smoothed(straight + aside, straight - aside, 8e-3)
    found = solve(edges, 0.3)
    assert isinstance(found, BeadSolution)
    s = found.nodes.time_s / 0.3
    for size in (0.02, 0.1):
        ratio = np.exp(size * np.sin(2 * np.pi * s))  # udot wdot constant, their ratio not
        raw = [
            np.concatenate(([0.0], np.cumsum((r[1:] + r[:-1]) / 2 * np.diff(s)))) for r in (ratio, 1 / ratio)
        ]
        other = BeadNodes(
            time_s=found.nodes.time_s,
            u_m=0.1 * raw[0] / raw[0][-1],
            w_m=0.1 * raw[1] / raw[1][-1],
            u_dot=0.1 / 0.3 * ratio / raw[0][-1],
            w_dot=0.1 / 0.3 / ratio / raw[1][-1],
            drag_rad=found.nodes.drag_rad,
        )
        assert cost(edges, other, CFG) > found.cost


def test_finer_nodes_are_the_same_path(solution):
    nodes, fine = solution.nodes, solution.nodes.finer(7)
    for name in ("time_s", "u_m", "w_m", "u_dot", "w_dot", "drag_rad"):
        np.testing.assert_allclose(getattr(fine, name)[::7], getattr(nodes, name), atol=1e-9)
    np.testing.assert_allclose(np.gradient(fine.u_m, fine.time_s)[1:-1], fine.u_dot[1:-1], rtol=2e-2)


def test_the_small_square_is_proven_infeasible_and_says_why():
    case = bead_cases.get("small_square")
    edges = case.edges()
    found = solve(edges, case.duration_s)
    assert isinstance(found, Infeasibility)
    assert found.proven
    assert found.constraint == "tilt"
    assert found.limit == pytest.approx(30.0)
    assert abs(found.value) > 30.5
    assert 0.0 <= found.stretch_m[0] <= found.u_m <= found.stretch_m[1] <= edges.left.length_m
    assert "mu_m^2 = 2.347" in found.hint
    assert "no path within the limits: tilt" in str(found)


def test_more_tilt_than_the_proof_asks_for_makes_the_small_square_feasible():
    case = bead_cases.get("small_square")
    edges = case.edges()
    needed = least_tilt(edges, THETA, CFG.tilt_rad)
    assert needed is not None
    assert np.rad2deg(needed) == pytest.approx(30.9, abs=0.3)
    found = solve(edges, case.duration_s, replace(CFG, tilt_rad=needed + np.deg2rad(3.0)))
    assert isinstance(found, BeadSolution)


def test_with_sharper_corners_the_small_square_has_a_path_just_as_the_proof_allows():
    # The proof's bound is sharp: edges that it calls reachable by 0.3 % of their length have a path.
    case = bead_cases.get("small_square")
    edges = Edges.smoothed(case.left, case.right, 2e-3)
    _, high = reachable_ends(edges, THETA, np.array([CFG.tilt_rad]))
    assert 1.0 < high[0] / edges.right.length_m < 1.005
    found = solve(edges, case.duration_s)
    assert isinstance(found, BeadSolution)
    tilt = np.rad2deg(np.abs(quantities(edges, found.nodes, CFG).tilt_rad))
    assert np.median(tilt) > 29.0
    assert tilt.max() < 30.01


def test_reachable_ends_of_parallel_edges_by_hand():
    straight = np.linspace(0.0, 0.1, 2)[:, None] * [1.0, 0.0, 0.0]
    aside = np.array([0.0, 0.05, 0.0])
    edges = Edges.smoothed(straight + aside, straight - aside, 8e-3)
    tilt = np.deg2rad([0.5, 1.0])  # high ends count to a twentieth past the edge's end
    low, high = reachable_ends(edges, THETA, tilt)
    mu2 = np.array([ratio_of_tilt(t, THETA) ** 2 for t in tilt])
    # Parallel edges: both sines are equal wherever the line across goes.
    np.testing.assert_allclose(low, 0.1 / mu2, rtol=1e-6)
    np.testing.assert_allclose(high, 0.1 * mu2, rtol=1e-6)
    assert least_tilt(edges, THETA, CFG.tilt_rad) is None


@pytest.mark.parametrize(
    ("duration", "values", "constraint", "proven"),
    [
        (0.05, {}, "speed", True),
        (5.0, {}, "speed", True),
        (0.4, {"distance_m": (0.01, 0.018)}, "distance", False),
        (0.4, {"distance_m": (0.05, 0.1)}, "distance", False),
    ],
)
def test_other_limits_that_cannot_be_met(bend, duration, values, constraint, proven):
    found = solve(bend, duration, replace(CFG, **values))
    assert isinstance(found, Infeasibility)
    assert found.constraint.startswith(constraint)
    assert found.proven is proven
    assert found.hint


def test_slsqp_says_that_it_found_no_path(bend):
    with pytest.raises(PlanningError, match="SLSQP ended after"):
        solve_slsqp(bend, 0.05, CFG, 10)


def test_first_nodes_are_denser_in_the_bend(bend):
    nodes = first_nodes(bend, 0.4, 60)
    step = np.diff(nodes.u_m)
    assert step.min() < 0.4 * step.max()
    assert np.argmin(step) in range(15, 45)
    np.testing.assert_allclose(nodes.u_m[[0, -1]], [0.0, bend.left.length_m])


@pytest.mark.parametrize(
    "values",
    [
        {"distance_m": (0.1, 0.01)},
        {"speed_m_per_s": (0.0, 1.0)},
        {"tilt_rad": 30.0},
        {"drag_rad": -0.1},
        {"weights": (1.0, 2.0)},
        {"smoothing": -1.0},
        {"height_tolerance_m": 0.0},
        {"cost_intervals": 1.5},
    ],
)
def test_bad_configs(values):
    with pytest.raises(ConfigError, match=f"BeadCfg.{next(iter(values))}"):
        BeadCfg(**values)


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan, None])
def test_bad_durations(bend, duration):
    for plan in (solve, solve_slsqp, naive_path):
        with pytest.raises(ConfigError, match="duration_s"):
            plan(bend, duration)


def test_an_unknown_case_lists_the_known_ones():
    with pytest.raises(SeamError, match="zig_zag"):
        bead_cases.get("circle")


def test_without_casadi_the_error_says_how_to_install_it(bend, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(PlanningError, match=r'pip install "seal-gym\[planning\]"'):
        solve(bend, 0.4)


def test_a_solver_that_gives_up_is_an_error(bend, monkeypatch):
    def stuck(*args, **kwargs):
        return replace(real(*args, **kwargs), status="Maximum_Iterations_Exceeded")

    real = bead_solver.solve_program
    monkeypatch.setattr(bead_solver, "solve_program", stuck)
    with pytest.raises(PlanningError, match="neither a path nor a limit"):
        solve(bend, 0.4)


def test_nodes_are_added_until_heights_hold_between_them(bend, monkeypatch):
    monkeypatch.setattr(bead_solver, "_FIRST_INTERVALS", 12)
    found = solve(bend, 0.4)
    assert isinstance(found, BeadSolution)
    assert found.rounds > 1
    assert len(found.nodes.time_s) > 13
    q = quantities(bend, found.nodes.finer(10), CFG)
    heights = np.concatenate((q.g_m, q.h_m))
    assert np.abs(heights - heights.mean()).max() < CFG.height_tolerance_m
    monkeypatch.setattr(bead_solver, "_ROUNDS", 1)
    with pytest.raises(PlanningError, match="between the nodes after 1 refinements"):
        solve(bend, 0.4)
