"""The truth every benchmark number rests on: seams against closed forms, and what is refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from seal_gym.core.errors import SeamError
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.seam import RUN_ON_M, Seam, build_seam, nearest_on_path
from seal_gym.workpieces.workpiece import Workpiece

Array = NDArray[np.float64]
R = np.sqrt(0.5)
UP = np.array([0.0, 0.0, 1.0])
RIGHT_OF_X = [0.0, -R, R]
STRAIGHT = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]
CORNER = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.0]]
CORNER_APPROACH = [[0.0, -R, R], [0.5, -0.5, R], [R, 0.0, R]]


def circle(radius: float, first: float, last: float, n: int) -> tuple[Array, Array]:
    """Points on a circle about z and approach directions that lean outward."""
    t = np.linspace(first, last, n)
    out = np.column_stack((np.cos(t), np.sin(t), 0 * t))
    return radius * out, R * (out + UP)


def helix(n: int = 181) -> tuple[Array, Array, float]:
    """A seam in space: half a turn at 60 mm radius that rises 20 mm, leaning 45 deg to the right."""
    t = np.linspace(0.0, np.pi, n)
    radius, pitch = 0.06, 0.02 / np.pi
    p = np.column_stack((radius * np.cos(t), radius * np.sin(t), 0.005 + pitch * t))
    tangent = np.column_stack((-radius * np.sin(t), radius * np.cos(t), 0 * t + pitch))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    right = np.column_stack((np.cos(t), np.sin(t), 0 * t))
    return p, R * (right + np.cross(right, tangent)), np.hypot(radius, pitch) * np.pi


def check_frame(seam: Seam) -> None:
    s = np.linspace(-RUN_ON_M, seam.length + RUN_ON_M, 2000)
    p, t, a = seam.at(s)
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(a, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(t * a, axis=1), 0.0, atol=2e-5)
    # The tangent is the derivative of the position, and both are continuous.
    ds = np.diff(s)[:, None]
    np.testing.assert_allclose(np.diff(p, axis=0) / ds, (t[1:] + t[:-1]) / 2, atol=8e-3)
    assert np.linalg.norm(np.diff(t, axis=0), axis=1).max() < 1.05 * np.diff(s).max() / 4e-3


SEAMS = {
    "flat": catalogue.flat().seam,
    "cylinder": catalogue.cylinder().seam,
    "rectangular": catalogue.rectangular().seam,
    "corner": build_seam(CORNER, CORNER_APPROACH, corner_radius=8e-3),
    "circle": build_seam(*circle(0.05, -1.0, 2.0, 60)),
    "closed": build_seam(*circle(0.05, -np.pi, np.pi, 73)),
    "helix": build_seam(*helix()[:2]),
}


@pytest.mark.parametrize("name", SEAMS)
def test_tangent_and_approach_are_orthonormal_and_continuous(name: str) -> None:
    check_frame(SEAMS[name])


def test_catalogue_lengths_in_closed_form() -> None:
    assert SEAMS["flat"].length == pytest.approx(0.3, abs=1e-12)
    assert SEAMS["cylinder"].length == pytest.approx(np.pi * 0.07, abs=1e-6)
    # Two corners of 5 mm, each replacing 2 x 5 mm of the sides by a quarter circle.
    assert SEAMS["rectangular"].length == pytest.approx(0.115 * 2 + 0.1543 - 20e-3 + np.pi * 5e-3, abs=1e-7)


def test_cylinder_against_the_circle() -> None:
    seam = SEAMS["cylinder"]
    s = np.linspace(-RUN_ON_M, seam.length + RUN_ON_M, 777)
    angle = -np.pi / 2 + s / 0.07
    radial = np.column_stack((np.cos(angle), np.sin(angle), 0 * s))
    p, t, a = seam.at(s)
    np.testing.assert_allclose(p, 0.07 * radial, atol=1.5e-6)
    np.testing.assert_allclose(t, np.cross([0, 0, 1], radial), atol=2e-5)
    np.testing.assert_allclose(a, R * (radial + UP), atol=2e-5)


def test_corner_arc_against_the_circle() -> None:
    seam = SEAMS["corner"]
    (first, last), radius = seam.corners[0], 8e-3
    assert last - first == pytest.approx(radius * np.pi / 2, rel=1e-5)
    assert first == pytest.approx(0.1 - radius, abs=1e-12)
    s = np.linspace(first, last, 101)
    angle = -np.pi / 2 + (s - first) / radius
    expected = np.column_stack((np.cos(angle), np.sin(angle), 0 * s)) * radius + [0.092, 0.008, 0.0]
    np.testing.assert_allclose(seam.at(s).position, expected, atol=1e-6)


def test_circle_given_as_points_keeps_their_radius() -> None:
    seam = SEAMS["circle"]
    position = seam.at(np.linspace(0, seam.length, 500)).position
    # The largest arcs that fit touch the chords' middles: the polyline's own sagitta, 59 steps of 2.9 deg.
    sagitta = 0.05 * (1 - np.cos(1.5 / 59))
    assert np.abs(np.linalg.norm(position, axis=1) - 0.05).max() < 1.1 * sagitta
    assert len(seam.corners) == 0


def test_corner_intervals_of_the_box() -> None:
    corners, quarter = SEAMS["rectangular"].corners, np.pi * 5e-3 / 2
    np.testing.assert_allclose(corners[:, 0], [0.11, 0.11 + quarter + 0.1443], atol=1e-6)
    np.testing.assert_allclose(np.diff(corners, axis=1)[:, 0], quarter, atol=1e-6)


@pytest.mark.parametrize("name", ["flat", "corner"])
def test_open_seams_run_on_straight_past_both_ends(name: str) -> None:
    seam = SEAMS[name]
    for s, sign in ((0.0, -1.0), (seam.length, 1.0)):
        end, beyond = seam.at(s), seam.at(s + sign * RUN_ON_M)
        np.testing.assert_allclose(beyond.position, end.position + sign * RUN_ON_M * end.tangent, atol=1e-12)
        np.testing.assert_allclose(beyond.approach, end.approach, atol=1e-12)


def test_arc_length_is_clipped_to_the_curve() -> None:
    seam = SEAMS["flat"]
    np.testing.assert_array_equal(seam.at(99.0).position, seam.position[-1])
    np.testing.assert_array_equal(seam.at(-99.0).position, seam.position[0])


def test_closed_polyline_runs_on_along_itself() -> None:
    seam = SEAMS["closed"]
    assert seam.closed
    assert not SEAMS["circle"].closed
    assert seam.length == pytest.approx(2 * np.pi * 0.05, rel=2e-3)
    for ds in (-0.02, -0.005, 0.0, 0.005, 0.02):
        here, again = seam.at(ds), seam.at(seam.length + ds)
        for a, b in zip(here, again, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


def test_closed_polyline_with_a_corner_at_its_seam() -> None:
    p = 0.05 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
    n = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * R
    seam = build_seam(p, np.column_stack((R * n, np.full(5, R))))
    assert seam.length == pytest.approx(0.4 - 4 * 10e-3 + 2 * np.pi * 5e-3, abs=1e-6)
    assert seam.closed
    check_frame(seam)


def test_seam_in_space() -> None:
    p, a, length = helix()
    seam = build_seam(p, a)
    assert seam.length == pytest.approx(length, rel=1e-4)
    middle = seam.at(seam.length / 2)
    np.testing.assert_allclose(middle.position, p[90], atol=2e-5)
    np.testing.assert_allclose(middle.approach, a[90], atol=1e-3)
    # The lean is measured from the floor, which rises with the seam: it is 45 deg all along.
    lean = np.arccos(np.sum(seam.approach * seam.up, axis=1))
    np.testing.assert_allclose(np.rad2deg(lean), 45.0, atol=0.1)


def test_lean_runs_linearly_between_points_and_round_corners() -> None:
    leans = np.deg2rad([41.0, 45.0, 49.0])
    out = np.array([[0, -1], [R, -R], [1, 0]])
    approach = np.column_stack((np.sin(leans)[:, None] * out, np.cos(leans)))
    seam = build_seam(CORNER, approach)
    lean = np.rad2deg(np.arccos(seam.at(np.linspace(0, seam.length, 301)).approach[:, 2]))
    assert np.all(np.diff(lean) > 0)
    np.testing.assert_allclose(lean[[0, 150, 300]], [41, 45, 49], atol=0.02)
    assert np.abs(np.diff(lean, n=2)).max() < 1e-3


def test_tip_path_is_the_seam_moved_along_the_approach() -> None:
    path = SEAMS["cylinder"].tip_path(3e-3)
    np.testing.assert_allclose(np.hypot(path[:, 0], path[:, 1]), 0.07 + 3e-3 * R, atol=1e-12)
    np.testing.assert_allclose(path[:, 2], 3e-3 * R, atol=1e-12)


@pytest.mark.parametrize("name", SEAMS)
def test_nearest_on_path_against_brute_force(name: str) -> None:
    seam, rng = SEAMS[name], np.random.default_rng(1)
    path = seam.tip_path(3e-3)
    # The arc is the seam's: brute force interpolates the path at the seam's arc lengths.
    s = np.linspace(seam.arc[0], seam.arc[-1], 200_001)
    dense = np.column_stack([np.interp(s, seam.arc, path[:, k]) for k in range(3)])
    for _ in range(20):
        point = dense[rng.integers(len(dense))] + rng.normal(0, 5e-3, 3)
        gap = np.linalg.norm(dense - point, axis=1)
        distance, at = nearest_on_path(path, seam.arc, point, seam.arc[0], seam.arc[-1])
        assert distance == pytest.approx(gap.min(), abs=1e-6)
        assert np.linalg.norm(dense[np.argmin(np.abs(s - at))] - point) == pytest.approx(distance, abs=5e-6)


def test_nearest_on_path_stays_in_its_window() -> None:
    seam = SEAMS["flat"]
    distance, s = nearest_on_path(seam.position, seam.arc, np.array([0.15, 0.0, 0.0]), 0.02, 0.05)
    assert s == pytest.approx(0.05)
    assert distance == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("points", "approach", "options", "message"),
    [
        ([0, 0, 0], RIGHT_OF_X, {}, r"points has shape \(3,\): must be \(n, 3\)"),
        ([[0, 0, 0]], RIGHT_OF_X, {}, r"points has shape \(1, 3\).*n >= 2"),
        ([[0, 0], [1, 1]], RIGHT_OF_X, {}, r"points has shape \(2, 2\)"),
        (STRAIGHT, [[0, -R, R]] * 3, {}, r"approach has shape \(3, 3\): must be \(2, 3\)"),
        ([[0, 0, 0], [np.nan, 0, 0]], RIGHT_OF_X, {}, r"points\[1\] = \[nan.* is not finite"),
        ([[0, 0, 0], [np.inf, 0, 0]], RIGHT_OF_X, {}, r"points\[1\] = \[inf.* is not finite"),
        (STRAIGHT, [0, np.nan, 1], {}, r"approach\[0\] = .* is not finite"),
        ([[0, 0, 0], [100, 0, 0]], RIGHT_OF_X, {}, r"points\[1\].*beyond 2 m; divide millimetres by 1000"),
        ([[0, 0, 0], [1e300, 0, 0]], RIGHT_OF_X, {}, r"points\[1\].*beyond 2 m"),
        (STRAIGHT, [0, -1, 1], {}, r"approach\[0\].*length 1.414: must be a unit vector"),
        (STRAIGHT, [0, 0, 0], {}, r"length 0: must be a unit vector"),
        (
            [[0, 0, 0], [0, 0, 0], [0.1, 0, 0]],
            RIGHT_OF_X,
            {},
            r"points 0 and 1 are 0 mm apart.*at least 0.1 mm",
        ),
        ([[0, 0, 0], [0.1, 0, 0], [0.1, 5e-5, 0]], RIGHT_OF_X, {}, r"points 1 and 2 are 0.05 mm apart"),
        ([[0, 0, 0], [0.1, 0, 0], [0.02, 0, 0]], RIGHT_OF_X, {}, r"turns back on itself at point 1"),
        (STRAIGHT, [1, 0, 0], {}, r"approach\[0\].*parallel to the seam.*across the seam"),
        (STRAIGHT, [[0, -R, R], [0, R, R]], {}, r"leans to the right of travel at first.*point 1.*one side"),
        (STRAIGHT, [[0, R, R], [0, -R, R]], {}, r"leans to the left of travel at first.*point 1"),
        ([[0, 0, 0], [0.05, 0, 0.06]], RIGHT_OF_X, {}, r"rises at 50 deg: at most 45 deg"),
        ([[0, 0, 0], [0, 0, 0.1]], RIGHT_OF_X, {}, r"rises at 90 deg"),
        (CORNER, CORNER_APPROACH, {"corner_radius": 0.0}, r"corner_radius = 0.0: must be a length in m > 0"),
        (CORNER, CORNER_APPROACH, {"corner_radius": -0.01}, r"corner_radius = -0.01: must be"),
        (CORNER, CORNER_APPROACH, {"corner_radius": np.nan}, r"corner_radius = nan: must be"),
        (CORNER, CORNER_APPROACH, {"corner_radius": 2e-3}, r"2 mm at point 1.*tighter.*at least 4 mm"),
        (
            CORNER,
            CORNER_APPROACH,
            {"corner_radius": 0.06},
            r"60 mm does not fit at point 1.*at most 50.00 mm",
        ),
        (*circle(3e-3, 0, 3, 60), {}, r"radius of 3.00 mm: tighter than the nozzle allows; keep it at 4 mm"),
        (
            STRAIGHT,
            [[0, -np.sin(0.7), np.cos(0.7)], [0, -np.sin(0.9), np.cos(0.9)]],
            {},
            r"turns about y.* by 11.5 deg in all.*at most 10 deg and 0.3 deg/mm",
        ),
        (
            [[0, 0, 0], [0.01, 0, 0]],
            [[0, -np.sin(0.7), np.cos(0.7)], [0, -np.sin(0.8), np.cos(0.8)]],
            {},
            r"by up to 0.57 deg/mm",
        ),
        (
            [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.05, -0.05, 0]],
            [0, 0, 1],
            {},
            r"segment 0 and segment 2 of the polyline cross",
        ),
        # The end touches the start's side from within: no crossing of the segments themselves.
        (
            [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.05, 0.1, 0], [0.05, 0.001, 0]],
            [0, 0, 1],
            {"run_on_m": 1e-4},
            r"segment 0 and segment 3.*within 2 mm",
        ),
        # The run-on past the end runs into the first side.
        (
            [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.05, 0.1, 0], [0.05, 0.02, 0]],
            [0, 0, 1],
            {},
            r"segment 0 and the run-on past the last point.*runs on straight for 30 mm",
        ),
    ],
)
def test_bad_polylines_are_refused(points: object, approach: object, options: dict, message: str) -> None:
    with pytest.raises(SeamError, match=message):
        build_seam(points, approach, **options)


def test_closed_polylines_must_not_cross_themselves() -> None:
    eight = np.array([[-1, -1, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * 0.05
    with pytest.raises(SeamError, match="segment 0 and segment 2 of the polyline cross"):
        build_seam(eight, [0.0, 0.0, 1.0])
    # Also where the crossing is with the last segment.
    late = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [0, -1.5, 0], [-1, -1, 0]]) * 0.05
    with pytest.raises(SeamError, match="segment 0 and segment 2"):
        build_seam(late, [0.0, 0.0, 1.0])


def test_arguments_are_not_changed_nor_kept() -> None:
    points, approach = np.array(STRAIGHT), np.array([RIGHT_OF_X] * 2)
    seam = build_seam(points, approach)
    points[:] = approach[:] = 7.0
    np.testing.assert_allclose(seam.at(0.0).position, 0.0, atol=1e-12)


@pytest.mark.parametrize("n", [50, 200, 400, 1000])
def test_a_smooth_curve_may_be_sampled_as_finely_as_one_likes(n: int) -> None:
    t = np.linspace(0.0, 1.0, n)
    points = np.column_stack((0.25 * t - 0.125, 0.02 * np.sin(2 * np.pi * t), 0 * t))
    seam = build_seam(points, [0.0, -R, R])
    bend = np.linalg.norm(np.diff(seam.tangent, axis=0), axis=1) / np.diff(seam.arc)
    # y'' = 0.02 (2 pi / 0.25)^2 at the crests, where the slope is zero.
    assert bend.max() == pytest.approx(0.02 * (2 * np.pi / 0.25) ** 2, rel=0.1)
    Workpiece.from_polyline(points, [0.0, -R, R])


def test_a_measured_line_is_not_taken_for_a_bend() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack((np.linspace(0, 0.2, 200), rng.normal(0, 1e-5, 200), np.zeros(200)))
    Workpiece.from_polyline(points, [0.0, -R, R])


def test_a_seam_too_short_for_the_descent_is_refused() -> None:
    with pytest.raises(SeamError, match=r"is 39\.0 mm long: at least 40 mm"):
        build_seam([[0, 0, 0], [0.039, 0, 0]], [0, 0, 1])


def test_a_floor_that_bends_up_sharply_is_refused() -> None:
    with pytest.raises(SeamError, match=r"pitches by 16\.7 deg at point 1 with a radius of 5\.0 mm.*20 mm"):
        build_seam([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.03]], [0, -R, R])
    build_seam([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0.03]], [0, -R, R], corner_radius=0.03)
