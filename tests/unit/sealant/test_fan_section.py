"""The fast tier's section against closed forms: areas, widths, lean, turns, steps."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.sealant.fan_section import (
    FAN_ANGLE_RAD,
    fan_sections,
    filled,
    ideal_area_m2,
    poses,
    surface_m,
    swept_thickness_m,
    thickness_m,
)
from seal_gym.sealant.laydown import sections
from seal_gym.sealant.laydown.config import THESIS_FLOW_M3S as FLOW
from seal_gym.sealant.laydown.config import LaydownCfg
from seal_gym.sealant.laydown.jet import landings
from seal_gym.sealant.laydown.paths import TRAINING, tip_path

X = (np.arange(41) - 20) * 1e-3
NONE = np.zeros((1, 3))


def still(vy, vx=0.0):
    return np.array([[vx, vy, 0.0]])


def plane(height_m, slope=0.0):
    """Heights over a plane that rises to the right."""
    return (height_m - slope * X)[None]


@pytest.mark.parametrize("height_m", [20e-3, 30e-3, 40e-3])
@pytest.mark.parametrize("speed", [0.2, 0.5])
def test_a_straight_pass_over_a_plane_holds_flow_over_speed(height_m, speed):
    image = fan_sections(still(speed), NONE, plane(height_m))
    assert sections.area_m2(image)[0] == pytest.approx(FLOW / speed, rel=1e-12)
    assert ideal_area_m2(still(speed), NONE, plane(height_m))[0] == pytest.approx(FLOW / speed, rel=1e-12)


def test_a_fan_that_travels_askew_lays_flow_over_the_speed_across_itself():
    image = fan_sections(still(0.25, vx=0.3), NONE, plane(30e-3))
    assert sections.area_m2(image)[0] == pytest.approx(FLOW / 0.25, rel=1e-12)


def test_the_bead_is_as_wide_as_the_fan():
    # 2 h tan 20 deg = 21.84 mm: ten columns to each side are wet throughout, the eleventh in part
    thick = thickness_m(still(0.3), NONE, plane(30e-3))[0]
    half = 30e-3 * np.tan(np.radians(20.0))
    assert 10e-3 < half < 11e-3
    assert np.flatnonzero(thick).tolist() == list(range(9, 31))
    whole = FLOW / FAN_ANGLE_RAD / 0.3 / 1e-3 * (np.arctan(10 / 30) - np.arctan(9 / 30))
    assert thick[29] == pytest.approx(whole, rel=1e-12)
    part = FLOW / FAN_ANGLE_RAD / 0.3 / 1e-3 * (np.radians(20.0) - np.arctan(10 / 30))
    assert thick[30] == pytest.approx(part, rel=1e-12)


def test_a_lean_is_the_plane_s_slope_and_shears_the_bead():
    lean = np.radians(20.0)
    leaning = thickness_m(still(0.3), NONE, plane(30e-3, np.tan(lean)))[0]
    # the right ray, at 20 deg, meets z = -h + x tan(lean) at x = h tan a / (1 + tan a tan lean)
    right = 30e-3 * np.tan(np.radians(20)) / (1 + np.tan(np.radians(20)) * np.tan(lean))
    left = 30e-3 * np.tan(np.radians(20)) / (1 - np.tan(np.radians(20)) * np.tan(lean))
    wet = np.flatnonzero(leaning)
    assert wet[0] == 20 - int(np.ceil(1e3 * left))
    assert wet[-1] == 19 + int(np.ceil(1e3 * right))
    assert leaning.sum() * 1e-3 == pytest.approx(FLOW / 0.3, rel=1e-12)
    image = fan_sections(still(0.3), NONE, plane(30e-3, np.tan(lean)))[0]
    assert image[:8, 20:].sum() == pytest.approx(0.0)  # the surface rises to the right: nothing below it
    assert image[:8, :20].sum() > 0.0


def test_a_turn_about_the_nozzle_thickens_the_side_that_lags():
    turn = np.array([[0.0, 0.0, 8.0]])  # anticlockwise: the right side runs ahead
    straight, turning = (thickness_m(still(0.3), w, plane(30e-3))[0] for w in (NONE, turn))
    x = (np.arange(40) - 19.5) * 1e-3
    wet = straight > 0
    np.testing.assert_allclose(turning[wet] / straight[wet], 0.3 / (0.3 + 8.0 * x[wet]), rtol=1e-12)


def test_a_swing_about_the_x_axis_adds_to_the_speed():
    swing = np.array([[2.0, 0.0, 0.0]])
    image = fan_sections(still(0.3), swing, plane(30e-3))
    assert sections.area_m2(image)[0] == pytest.approx(FLOW / (0.3 + 2.0 * 30e-3), rel=1e-12)


def test_nothing_lands_behind_a_step():
    heights = np.where(X < 4.5e-3, 26e-3, 34e-3)[None]  # the ground falls away to the right
    thick = thickness_m(still(0.3), NONE, heights)[0]
    # the edge is seen at atan(4 / 26): on the lower floor that is x = 34 * 4 / 26 = 5.2 mm
    assert thick[24] == pytest.approx(0.0)
    assert thick[25] > 0
    first = FLOW / FAN_ANGLE_RAD / 0.3 / 1e-3 * (np.arctan(6 / 34) - np.arctan(4 / 26))
    assert thick[25] == pytest.approx(first, rel=1e-12)
    # nothing of the left half lands to the right, so that the area is complete
    assert thick.sum() * 1e-3 == pytest.approx(FLOW / 0.3, rel=1e-12)


def test_the_window_is_cut_where_the_reference_cuts_it():
    assert surface_m(plane(30e-3))[0].tolist() == pytest.approx([8e-3] * 40)
    share = filled(np.full((1, 40), 2.25e-3))[0]
    assert share[:, 0] == pytest.approx([1.0, 1.0, 0.25] + [0.0] * 17)


def test_it_agrees_with_the_flown_jet_of_a_simulation():
    # one straight pass with lean, drag and spin: parcels that come down close to a station's plane
    draws = np.tile([30e-3, 0.3, 0.3, 0.15, 0.5], (4, 1))
    cfg = LaydownCfg(path=tip_path(TRAINING[0], draws), gravity_mps2=(0.0, 0.0, 0.0))
    at = sections.stations(cfg)
    n = len(at.arcs_m) // 2
    jet, _, place = landings(cfg)
    local = (place - at.hits[n]) @ at.tips[n]
    slab = 2e-3
    near = np.abs(local[:, 1]) < slab / 2
    counts, _ = np.histogram(local[near, 0], np.arange(-20, 21) * 1e-3, weights=jet.volumes_m3[near])
    thick = thickness_m(at.linear_mps, at.angular_radps, at.heights_m)[n]
    np.testing.assert_allclose(counts.sum() / slab, thick.sum() * 1e-3, rtol=0.03)
    # centroid and spread of the landed volume, within a tenth of a column
    x = (np.arange(40) - 19.5) * 1e-3
    for weights in (counts, thick):
        assert weights.min() >= 0.0
    centre = [w @ x / w.sum() for w in (counts, thick)]
    spread = [np.sqrt(w @ (x - c) ** 2 / w.sum()) for w, c in zip((counts, thick), centre, strict=True)]
    np.testing.assert_allclose(centre[0], centre[1], atol=1e-4)
    np.testing.assert_allclose(spread[0], spread[1], atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heights_m": np.zeros((1, 41))}, "must be positive"),
        ({"heights_m": np.ones((1, 40))}, "must be \\(n, 41\\)"),
        ({"linear_mps": np.ones((2, 3))}, "must be \\(1, 3\\)"),
        ({"angular_radps": np.full((1, 3), np.nan)}, "must be finite"),
        ({"flow_m3s": -1.0}, "flow_m3s"),
        ({"fan_angle_rad": 40.0}, "check the unit"),
    ],
)
def test_bad_inputs_are_refused(change, message):
    good = {"linear_mps": still(0.3), "angular_radps": NONE, "heights_m": plane(30e-3)}
    with pytest.raises(ConfigError, match=message):
        fan_sections(**(good | change))


def swept(vx=0.0, vy=0.3, turn=0.0, n=61, height_m=30e-3):
    arcs = 1e-3 * np.arange(n)
    linear = np.tile([vx, vy, 0.0], (n, 1))
    angular = np.tile([0.0, 0.0, turn], (n, 1))
    return swept_thickness_m(arcs, linear, angular, np.full((n, 41), height_m), planes_m=(0.0, 10e-3))


@pytest.mark.parametrize(("vx", "vy"), [(0.0, 0.3), (0.2, 0.2), (-0.3, 0.15)])
def test_along_a_straight_path_the_swept_fan_is_the_station_s(vx, vy):
    thick = swept(vx, vy)[30, 0]
    alone = thickness_m(still(vy, vx), NONE, plane(30e-3))[0]
    assert thick.sum() == pytest.approx(alone.sum(), rel=5e-3)
    np.testing.assert_allclose(thick, alone, atol=0.02 * alone.max())


def test_a_bead_begins_and_ends():
    areas = swept().sum(-1) * 1e-3
    whole = FLOW / 0.3
    # the triangle of 6 mm to each side: half of it at the first station, all of it 6 mm on
    assert areas[0, 0] == pytest.approx(0.5 * whole, rel=0.01)
    assert areas[3, 0] == pytest.approx((1 - 0.5 * 0.5**2) * whole, rel=0.01)
    assert areas[6, 0] == pytest.approx(whole, rel=0.01)
    # the bead ends at 61 mm: the plane 10 mm ahead of the station at 57 mm is 6 mm beyond
    assert areas[57, 1] == pytest.approx(0.0, abs=1e-12)
    assert areas[41, 1] == pytest.approx(whole, rel=0.01)


def test_where_the_tip_turns_the_inner_side_is_thicker():
    # 0.3 m/s at 5 rad/s: the tip runs round a circle of 60 mm, its right side outside
    thick = swept(turn=5.0)[30, 0]
    x = (np.arange(40) - 19.5) * 1e-3
    alone = thickness_m(still(0.3), np.array([[0.0, 0.0, 5.0]]), plane(30e-3))[0]
    wet = np.abs(x) < 9e-3
    np.testing.assert_allclose(thick[wet], alone[wet], rtol=0.03)


def test_a_fan_that_turns_on_the_spot_lays_its_volume_round_it():
    # half a turn of 100 steps about the nozzle: what lies in a plane through the axis comes from all of them
    n, turn, duration = 101, 10.0, np.pi / 10.0
    arcs = 1e-4 * np.arange(n)  # hardly moves
    speed = arcs[-1] / duration
    linear = np.tile([0.0, 0.0, speed], (n, 1))
    angular = np.tile([0.0, 0.0, turn], (n, 1))
    heights = np.full((n, 41), 30e-3)
    thick = swept_thickness_m(arcs, linear, angular, heights)[n // 2, 0]
    # far from the axis a radius r is swept at r turn: the two arms pass each place once in half a turn
    x = (np.arange(40) - 19.5) * 1e-3
    density = FLOW / FAN_ANGLE_RAD * (30e-3 / (30e-3**2 + x**2)) / (np.abs(x) * turn)
    far = (np.abs(x) > 6e-3) & (np.abs(x) < 9e-3)
    np.testing.assert_allclose(thick[far], density[far], rtol=0.1)


def test_stations_stand_where_they_were_taken():
    draws = np.random.default_rng(0).normal(
        [30e-3, 0.3, 0.2, 0.1, 0.3], [2e-3, 0.02, 0.05, 0.05, 0.05], (4, 5)
    )
    cfg = LaydownCfg(path=tip_path(TRAINING[1], draws))
    at = sections.stations(cfg)
    dt, positions, rotations = poses(at.arcs_m, at.linear_mps, at.angular_radps)
    true, turned, _ = cfg.path.at(at.times_s)
    np.testing.assert_allclose(dt[:-1], np.diff(at.times_s), rtol=1e-2)
    np.testing.assert_allclose(positions[:-1], (true - true[0]) @ turned[0], atol=2e-4)
    np.testing.assert_allclose(rotations[:-1], turned[0].T @ turned, atol=0.02)


def test_a_path_of_one_station_is_refused():
    with pytest.raises(ConfigError, match="at least 2"):
        swept(n=1)
