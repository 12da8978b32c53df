"""Beads under a fan nozzle: volume, the closed form of the fan's projection, tilts, misses, layers."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import axis_angle
from seal_gym.sealant.fan import FanCfg, lay_path, settled
from seal_gym.sealant.pneumatics import get_sealant
from seal_gym.sealant.strip import Strip
from tests.unit.sealant.plates import plate

THETA = np.deg2rad(40.0)
DISTANCE, SPEED, FLOW = 20e-3, 0.4, 12.5e-6
X, Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def path(length=0.03, turn=None, samples=41, flow=FLOW, speed=SPEED, over=10e-3):
    """A straight pass over a plate along y at constant height and speed, from before it to behind it."""
    time = np.linspace(0.0, (length + 2 * over) / speed, samples)
    position = np.column_stack((0 * time, -over + speed * time, np.full(samples, DISTANCE)))
    rotation = np.broadcast_to(np.eye(3) if turn is None else turn, (samples, 3, 3))
    return time, position, rotation, np.full(samples, flow)


def closed_form(x, distance=DISTANCE):
    """Height at an offset x: the angle d phi covers d / (d^2 + x^2) of an offset."""
    return FLOW / THETA * distance / (distance**2 + x**2) / SPEED


def section(strip, laid, rows=20):
    """Mean height across, over whole rows in the middle."""
    middle = len(strip.arc) // 2
    return laid.height[middle - rows // 2 : middle + rows // 2].mean(axis=0)


def balance(laid):
    return laid.volume.sum() + laid.missed_m3


@pytest.mark.parametrize("tilt", [0.0, 0.25, -0.4])
def test_a_plane_gets_the_projection_of_the_fan_whatever_the_tilt(tilt):
    strip = plate(length=0.03, half=18e-3, spacing=0.5e-3)
    laid = lay_path(strip, *path(turn=axis_angle(Y, tilt)))
    middle = laid.height[20:40]
    # The axis -z of the tip meets the plate at -d tan(tilt); the borders are half the fan to either side.
    left, right = (DISTANCE * np.tan(-tilt + side * THETA / 2) for side in (-1, 1))
    inside = (strip.across > left + 1e-3) & (strip.across < right - 1e-3)
    wanted = np.tile(closed_form(strip.across[inside]), (20, 1))
    np.testing.assert_allclose(middle[:, inside], wanted, rtol=0.01)
    outside = (strip.across < left - 1e-3) | (strip.across > right + 1e-3)
    assert middle[:, outside].max() == 0.0
    # Half the closed form's height at the borders.
    height = section(strip, laid)
    near = strip.across < left + 2e-3
    at_left = np.interp(0.5 * closed_form(left), height[near], strip.across[near])
    assert at_left == pytest.approx(left, abs=0.2e-3)


def test_the_error_shrinks_with_the_columns():
    errors = []
    for spacing in (2e-3, 1e-3, 0.5e-3):
        strip = plate(length=0.032, half=16e-3, spacing=spacing)
        laid = lay_path(strip, *path(0.032), FanCfg(rays=512))
        height = section(strip, laid, rows=int(8e-3 / spacing))
        inside = np.abs(strip.across) < DISTANCE * np.tan(THETA / 2)
        wanted = np.where(inside, closed_form(strip.across), 0.0)
        errors.append(np.abs(height - wanted).sum() * spacing / (FLOW / SPEED))
    # The border of the fan lies anywhere between two columns: first order at best.
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]
    assert errors[2] < 0.02


@pytest.mark.parametrize(("spacing", "rays"), [(1e-3, 16), (0.5e-3, 256), (0.25e-3, 256)])
def test_volume_is_kept(spacing, rays):
    laid = lay_path(plate(length=0.03, half=12e-3, spacing=spacing), *path(), FanCfg(rays=rays))
    assert laid.sprayed_m3 == pytest.approx(FLOW * 0.05 / SPEED, rel=1e-12)
    assert balance(laid) == pytest.approx(laid.sprayed_m3, rel=1e-12)
    # 10 mm before and behind the plate; its border columns reach half a column out.
    assert laid.missed_m3 / laid.sprayed_m3 == pytest.approx(1 - (0.03 + spacing) / 0.05, abs=1e-3)


def test_a_nozzle_that_leans_ahead_lays_behind():
    strip = plate(length=0.06, half=12e-3)
    drag = 0.3
    time, position, rotation, flow = path(length=0.04, over=0.0, turn=axis_angle(X, -drag))
    laid = lay_path(strip, time, position + 0.01 * Y, rotation, flow)
    along = laid.volume.sum(axis=1)
    # From y = 10 mm to 50 mm; the axis meets the plate d tan(drag) behind the mouth.
    centre = (along * strip.arc).sum() / along.sum()
    assert centre == pytest.approx(0.03 - DISTANCE * np.tan(drag), abs=0.3e-3)


def test_flow_and_time_may_change_if_the_volume_along_the_way_does_not():
    strip = plate(length=0.03, half=12e-3)
    time, position, rotation, flow = path()
    once = lay_path(strip, time, position, rotation, flow)
    slowly = lay_path(strip, 3.0 * time, position, rotation, flow / 3.0)
    np.testing.assert_allclose(slowly.height, once.height, rtol=1e-9, atol=1e-15)


def test_the_flow_follows_its_table():
    strip = plate(length=0.06, half=12e-3)
    time, position, rotation, flow = path(0.06)
    ramp = flow * np.linspace(0.0, 2.0, len(flow))
    laid = lay_path(strip, time, position, rotation, ramp)
    middle = laid.height[10:-10, np.abs(strip.across) < 5e-3]
    share = (strip.arc[10:-10] + 10e-3) / 40e-3
    x = strip.across[np.abs(strip.across) < 5e-3]
    np.testing.assert_allclose(middle, share[:, None] * closed_form(x), rtol=0.015)
    assert balance(laid) == pytest.approx(FLOW * time[-1], rel=1e-12)


def test_rays_beside_the_strip_and_through_gaps_miss():
    time, position, rotation, flow = path(length=0.04, over=0.0)
    position = position + 0.01 * Y
    narrow = plate(length=0.06, half=4e-3)
    laid = lay_path(narrow, time, position, rotation, flow)
    beyond = 1 - 2 * np.arctan(4.25e-3 / DISTANCE) / THETA
    assert laid.missed_m3 / laid.sprayed_m3 == pytest.approx(beyond, abs=2e-3)
    assert balance(laid) == pytest.approx(laid.sprayed_m3, rel=1e-12)
    split = plate(length=0.06, half=12e-3)
    area = np.where(np.abs(split.across) < 0.9e-3, 0.0, split.area)  # 3 columns of 0.5 mm
    laid = lay_path(split._replace(area=area), time, position, rotation, flow)
    through = 2 * np.arctan(0.75e-3 / DISTANCE) / THETA
    assert laid.missed_m3 / laid.sprayed_m3 == pytest.approx(through, abs=2e-3)
    assert laid.height[:, np.abs(split.across) < 0.9e-3].max() == 0.0
    assert balance(laid) == pytest.approx(laid.sprayed_m3, rel=1e-12)
    upwards = lay_path(split, time, position, rotation @ np.diag([-1.0, 1.0, -1.0]), flow)
    assert upwards.missed_m3 == pytest.approx(upwards.sprayed_m3, rel=1e-12)


def test_a_second_layer_lands_on_the_first():
    strip = plate(length=0.04, half=12e-3, spacing=0.25e-3)
    time, position, rotation, flow = path(0.04)
    there = lay_path(strip, time, position, rotation, flow)
    back = time[-1] + time[1:]
    both = lay_path(
        strip,
        np.concatenate((time, back)),
        np.concatenate((position, position[-2::-1])),
        np.concatenate((rotation, rotation[1:])),
        np.concatenate((flow, flow[1:])),
    )
    first, second = section(strip, there), section(strip, both) - section(strip, there)
    # Its rays end on the first layer, about as high as that is at its border, and so does its border.
    level = closed_form(DISTANCE * np.tan(THETA / 2))
    assert level > 1e-3
    border = (DISTANCE - level) * np.tan(THETA / 2)
    right = strip.across > 4e-3
    middle = np.interp(-0.5 * second[np.isclose(strip.across, 5e-3)], -second[right], strip.across[right])
    assert middle == pytest.approx(border, abs=0.25e-3)
    # At the middle it is as much higher as it is nearer.
    at = np.isclose(strip.across, 0.0)
    assert second[at] / first[at] == pytest.approx(DISTANCE / (DISTANCE - closed_form(0.0)), rel=0.01)


@pytest.mark.parametrize("radius", [40e-3, -60e-3])
def test_a_bend_gets_what_a_plane_gets(radius):
    # Along a cylinder, columns outward (radius > 0) or inward; the nozzle keeps its distance and angle.
    angle = np.linspace(0.0, 1.2, round(1.2 * abs(radius) / 0.5e-3))
    spacing = angle[1] * abs(radius)
    across = 0.5e-3 * np.arange(-24, 25)
    up = np.column_stack((0 * angle, np.sin(angle), np.cos(angle)))
    along = np.column_stack((0 * angle, np.cos(angle), -np.sin(angle)))
    column = up if radius > 0 else -up
    flat = np.zeros((len(angle), len(across)))
    foot = abs(radius) * up
    strip = Strip.of(
        spacing * np.arange(len(angle)),
        across,
        (foot, along, column),
        flat,
        np.broadcast_to(column[:, None], (*flat.shape, 3)),
    )
    side = np.cross(along, column)
    rotation = np.stack((side, along, column), axis=-1)
    thin = 1e-2 * FLOW  # a thick bead fills the narrowing columns of a hollow higher
    time = np.linspace(0.0, abs(radius) * 1.2 / SPEED, len(angle))
    laid = lay_path(strip, time, foot + DISTANCE * column, rotation, np.full(len(angle), thin))
    inside = np.abs(across) < 6e-3
    rows = slice(len(angle) // 2 - 10, len(angle) // 2 + 10)
    np.testing.assert_allclose(
        laid.height[rows, inside] / 1e-2, np.tile(closed_form(across[inside]), (20, 1)), rtol=0.01
    )
    assert balance(laid) == pytest.approx(laid.sprayed_m3, rel=1e-12)


@pytest.mark.parametrize("turn_rad", [-0.7, 0.7])
def test_a_leaning_fan_lays_a_smooth_bead(turn_rad):
    # The fan's plane stands at 50 deg to the travel and leans in itself: all rays come in from behind over
    # what has just been laid, or all from ahead.
    strip = plate(length=0.06, half=20e-3)
    turn = axis_angle(np.array([0.0, 0.0, 1.0]), turn_rad) @ axis_angle(Y, 0.45)
    laid = lay_path(strip, *path(0.06, turn=turn))
    middle = laid.height[50:70]
    wet = np.flatnonzero(middle.mean(axis=0) > 1.5e-3)[1:-1]
    assert len(wet) > 10
    assert (np.ptp(middle[:, wet], axis=0) / middle[:, wet].mean(axis=0)).max() < 0.02


def test_a_stiff_bead_stays_and_a_runny_one_spreads():
    strip = plate(length=0.02, half=15e-3)
    laid = lay_path(strip, *path(0.02, flow=2 * FLOW))
    stiff = settled(strip, laid, get_sealant("neutral_silicone"), 1.0)
    np.testing.assert_array_equal(stiff.height, laid.height)
    runny = settled(strip, laid, get_sealant("self_levelling"), 1.0)
    assert runny.height.max() < laid.height.max()
    assert (section(strip, runny) > 0).sum() > (section(strip, laid) > 0).sum()
    assert balance(runny) == pytest.approx(laid.sprayed_m3, rel=1e-12)


@pytest.mark.parametrize("bad", [{"angle_rad": 40.0}, {"angle_rad": 0.0}, {"rays": 8}, {"rays": 16.5}])
def test_a_nozzle_out_of_range_is_refused(bad):
    with pytest.raises(ConfigError, match=f"FanCfg.{next(iter(bad))}"):
        FanCfg(**bad)


def broken(which, value):
    parts = list(path())
    parts[which] = value(np.array(parts[which]))
    return parts


@pytest.mark.parametrize(
    ("parts", "word"),
    [
        (broken(0, lambda t: t[:-1]), "shapes"),
        (broken(1, lambda p: p[:, :2]), "shapes"),
        (broken(0, lambda t: t[::-1]), "rise"),
        (broken(1, lambda p: p * np.nan), "finite"),
        (broken(3, lambda f: -f), "negative"),
        (broken(2, lambda r: axis_angle(X, np.linspace(0, 30, len(r)))), "more finely"),
    ],
)
def test_a_broken_path_is_refused(parts, word):
    with pytest.raises(ConfigError, match=word):
        lay_path(plate(), *parts)


@pytest.mark.parametrize("duration", [-1.0, np.inf, True])
def test_settling_for_no_time_is_refused(duration):
    strip = plate()
    laid = lay_path(strip, *path())
    with pytest.raises(ConfigError, match="duration_s"):
        settled(strip, laid, get_sealant("self_levelling"), duration)
