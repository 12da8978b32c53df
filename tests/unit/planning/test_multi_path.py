"""Cubics against closed forms and quadrature; ways round obstacles against geometry."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.integrate import quad

from seal_gym.core.errors import ConfigError
from seal_gym.planning import multi_path
from seal_gym.planning.multi_path import MultiPathCfg

UP = np.array([0.0, 0.0, 1.0])


def _on(coefficients, low, high):
    """A polynomial of plain coefficients, as the module keeps them."""
    return Polynomial(coefficients).convert(domain=[low, high], window=[-1, 1], kind=Polynomial)


def test_a_cubic_is_found_again_from_its_points():
    x = np.linspace(0.4, 1.1, 30)
    found = multi_path.fit_cubic(x, 2.0 - x + 3.0 * x**2 - 0.5 * x**3)
    np.testing.assert_allclose(found.convert().coef, [2.0, -1.0, 3.0, -0.5], rtol=1e-9)


def test_noisy_points_give_the_solution_of_the_normal_equations():
    """Eq. 50 with its last right-hand entry mended, solved in extended precision."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 2.0, 40), rng.normal(size=40)
    powers = np.vander(x, 4, increasing=True).astype(np.longdouble)
    normal, right = (powers.T @ powers).astype(float), (powers.T @ y).astype(float)
    np.testing.assert_allclose(
        multi_path.fit_cubic(x, y).convert().coef, np.linalg.solve(normal, right), rtol=1e-8
    )


def test_a_pinned_cubic_keeps_its_ends_and_is_found_again():
    x = np.linspace(0.0, 0.3, 20)
    y = x * (0.3 - x) * (1.5 - 4.0 * x)
    found = multi_path.fit_pinned(x, y)
    np.testing.assert_allclose(found(x), y, atol=1e-15)
    noisy = multi_path.fit_pinned(x, y + np.random.default_rng(0).normal(size=20))
    assert abs(noisy(0.0)) < 1e-15 and abs(noisy(0.3)) < 1e-15


def test_a_pinned_fit_is_the_best_of_its_kind():
    x = np.linspace(-1.0, 1.0, 15)
    y = np.random.default_rng(1).normal(size=15)
    found = multi_path.fit_pinned(x, y)
    least = np.sum((found(x) - y) ** 2)
    for change in ([1e-3, 0], [-1e-3, 0], [0, 1e-3], [0, -1e-3]):
        other = found + Polynomial([1, 0, -1]) * Polynomial(change)
        assert np.sum((other(x) - y) ** 2) > least


def test_too_few_points_are_refused():
    with pytest.raises(ConfigError, match="4 different"):
        multi_path.fit_cubic(np.array([0.0, 0.0, 1.0, 2.0]), np.zeros(4))


def test_extrema_of_a_cubic():
    """y = x^3 - 3 x: a maximum of 2 at -1, a minimum of -2 at 1, an inflection at 0."""
    cubic = _on([0.0, -3.0, 0.0, 1.0], -1.5, 2.5)
    found = multi_path.extrema(cubic)
    np.testing.assert_allclose(found.x, [-1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(found.y, [2.0, -2.0], atol=1e-12)
    assert found.is_maximum.tolist() == [True, False]
    np.testing.assert_allclose(multi_path.inflections(cubic), [0.0], atol=1e-12)


def test_what_lies_outside_the_way_does_not_count():
    cubic = _on([0.0, -3.0, 0.0, 1.0], 0.5, 2.5)
    np.testing.assert_allclose(multi_path.extrema(cubic).x, [1.0], atol=1e-12)
    assert len(multi_path.inflections(cubic)) == 0


def test_a_rising_cubic_has_no_extrema():
    assert len(multi_path.extrema(_on([0.0, 1.0, 0.0, 1.0], -2.0, 2.0)).x) == 0


def test_parabola_and_line():
    parabola = _on([1.0, -2.0, 1.0], 0.0, 3.0)
    found = multi_path.extrema(parabola)
    np.testing.assert_allclose((found.x[0], found.y[0]), (1.0, 0.0), atol=1e-12)
    assert not found.is_maximum[0] and len(multi_path.inflections(parabola)) == 0
    line = _on([1.0, 2.0], 0.0, 3.0)
    assert len(multi_path.extrema(line).x) == len(multi_path.inflections(line)) == 0


def test_length_of_a_parabola_in_closed_form():
    """y = x^2 / 2 on 0..1: (sqrt 2 + asinh 1) / 2."""
    assert multi_path.length(_on([0, 0, 0.5], 0.0, 1.0)) == pytest.approx((np.sqrt(2) + np.arcsinh(1)) / 2)


def test_length_of_a_curve_in_space():
    y, z = _on([0.0, 0.3, -0.4, 0.2], 0.0, 1.0), _on([0.0, -0.1, 0.0, 0.5], 0.0, 1.0)
    expected, _ = quad(lambda x: np.sqrt(1 + y.deriv()(x) ** 2 + z.deriv()(x) ** 2), 0.0, 1.0)
    assert multi_path.length(y, z) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("goal", [[0.3, 0.1, 0.0], [0.0, 0.0, 0.2], [-0.1, 0.2, 0.5]])
def test_the_frame_of_a_way_is_a_rotation_along_it(goal):
    start, goal = np.array([0.1, -0.2, 0.05]), np.array(goal)
    frame = multi_path.way_frame(start, start + goal, UP)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    np.testing.assert_allclose(frame[:, 0] * np.linalg.norm(goal), goal, atol=1e-12)
    assert frame[2, 2] >= -1e-12


def test_points_are_equidistant():
    line = multi_path.straight(np.zeros(3), np.array([0.3, 0.0, 0.0]), UP)
    x = np.linspace(0.0, 0.3, 20)
    way = multi_path.CubicWay(
        start=line.start,
        goal=line.goal,
        frame=line.frame,
        y=multi_path.fit_pinned(x, 8.0 * x * (0.3 - x) * (0.1 - x)),
        z=multi_path.fit_pinned(x, 4.0 * x * (0.3 - x)),
    )
    points = way.equidistant(200)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=2e-3)
    assert steps.sum() == pytest.approx(way.length_m, rel=1e-4)
    np.testing.assert_allclose(points[[0, -1]], [line.start, line.goal], atol=1e-12)
    assert way.inflections == 1


def _outside_ball(centre, radius):
    return lambda points: np.linalg.norm(points - centre, axis=1) > radius


START, GOAL = np.array([0.0, 0.0, 0.1]), np.array([0.4, 0.0, 0.1])


def test_a_free_line_is_taken():
    (way,) = multi_path.ways(START, GOAL, _outside_ball([0.2, 0.0, 0.3], 0.1), UP)
    assert way.length_m == pytest.approx(0.4) and way.inflections == 0


def test_ways_go_round_a_ball_and_the_shortest_is_near_the_geodesic():
    """Round a ball of 50 mm on the line: two tangents of sqrt(d^2 - r^2) and an arc, exactly."""
    radius, half = 0.05, 0.2
    found = multi_path.ways(START, GOAL, _outside_ball([0.2, 0.0, 0.1], radius), UP)
    assert len(found) == len(multi_path.BOWS)
    reach = np.sqrt(half**2 - radius**2)
    shortest = 2 * reach + radius * (np.pi - 2 * np.arctan2(reach, radius))
    for way in found:
        fine = way.at(np.linspace(*way.y.domain, 4000))
        assert np.linalg.norm(fine - [0.2, 0.0, 0.1], axis=1).min() > radius - 1e-4
        np.testing.assert_allclose(fine[[0, -1]], [START, GOAL], atol=1e-12)
    best = multi_path.choose(found)
    assert shortest < best.length_m < 1.04 * shortest
    assert best.length_m == min(way.length_m for way in found)


def test_a_wall_on_one_side_is_passed_on_the_other():
    """A wall over the whole height for y > -20 mm: only the ways to the right (y < 0) get by."""

    def free(points):
        x, y, _ = points.T
        return ~((np.abs(x - 0.2) < 0.01) & (y > -0.02))

    found = multi_path.ways(START, GOAL, free, UP)
    assert found
    assert all(way.at(np.array([0.2]))[0, 1] <= -0.02 for way in found)


def test_no_way_out_of_a_cage_and_none_from_a_blocked_start():
    def caged(points):
        return np.abs(np.linalg.norm(points - START, axis=1) - 0.1) > 0.01

    assert multi_path.ways(START, GOAL, caged, UP) == []
    assert multi_path.ways(START, GOAL, _outside_ball(START, 0.05), UP) == []
    assert multi_path.choose([]) is None


def test_an_inflection_costs_what_it_is_said_to():
    x = np.linspace(0.0, 0.4, 20)
    line = multi_path.straight(START, GOAL, UP)

    def way(y):
        return multi_path.CubicWay(start=START, goal=GOAL, frame=line.frame, y=y, z=line.z)

    bent, arched = (
        way(multi_path.fit_pinned(x, x * (0.4 - x) * (0.2 - x))),
        way(multi_path.fit_pinned(x, x * (0.4 - x))),
    )
    assert bent.inflections == 1 and arched.inflections == 0
    assert bent.length_m < arched.length_m
    cheap, dear = MultiPathCfg(inflection_m=1e-6), MultiPathCfg(inflection_m=1.0)
    assert multi_path.choose([arched, bent], cheap) is bent
    assert multi_path.choose([arched, bent], dear) is arched


@pytest.mark.parametrize("name", ["points", "push_m", "pushes", "inflection_m", "checked_m"])
def test_wrong_settings_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        MultiPathCfg(**{name: -1})
