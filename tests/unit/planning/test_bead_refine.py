"""Refinement of bead paths on evaluators whose optimum is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import ConfigError
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_refine import RefineCfg, basis, corrected, refine, shares

LENGTH, SPEED, N = 0.2, 0.25, 401
PLACES = np.linspace(0.05, 0.95, 120)


def straight():
    y = np.linspace(0.0, LENGTH, N)
    zero = np.zeros(N)
    return BeadPath(
        time_s=y / SPEED,
        position_m=np.column_stack((zero, y, zero + 0.03)),
        rotation=np.tile(np.eye(3), (N, 1, 1)),
        flow_m3_per_s=np.full(N, 12e-6),
    )


def one_channel(channel, value):
    out = np.zeros((N, 5))
    out[:, channel] = value
    return out


def test_splines_sum_to_one_and_are_local():
    splines = basis(np.linspace(0.0, 1.0, 201), 12)
    np.testing.assert_allclose(splines.sum(1), 1.0, atol=1e-12)
    assert ((splines > 0).sum(1) <= 4).all()


def test_a_faster_path_takes_less_time_on_the_same_way():
    path = straight()
    fast = corrected(path, one_channel(0, np.log(2.0)))
    assert fast.time_s[-1] == pytest.approx(LENGTH / SPEED / 2)
    np.testing.assert_array_equal(fast.position_m, path.position_m)


def test_shift_and_offset_run_along_the_tips_axes():
    path = straight()
    np.testing.assert_allclose(corrected(path, one_channel(1, 2e-3)).position_m[:, 0], 2e-3)
    np.testing.assert_allclose(corrected(path, one_channel(2, 2e-3)).position_m[:, 2], 0.032)


@pytest.mark.parametrize(("channel", "axis"), [(3, "y"), (4, "z")])
def test_tilt_and_spin_turn_about_the_tips_axes(channel, axis):
    turned = corrected(straight(), one_channel(channel, 0.2)).rotation
    np.testing.assert_allclose(turned[7], Rotation.from_euler(axis, 0.2).as_matrix(), atol=1e-12)


def analytic(paths):
    """Left and right heights of a bead that leans: flow / speed, more to the side that the nozzle tilts to.

    The substrate asks for a speed of exp(0.1 sin) and a tilt of 0.05 cos: with both the bead is even.
    """
    out = []
    for path in paths:
        at = shares(path)
        speed = np.linalg.norm(np.gradient(path.position_m, path.time_s, axis=0), axis=1)
        tilt = np.arctan2(path.rotation[:, 0, 2], path.rotation[:, 2, 2])
        level = 12e-6 / 0.02 / speed * np.exp(0.1 * np.sin(2 * np.pi * at))
        lean = 2.0 * (tilt - 0.05 * np.cos(2 * np.pi * at))
        heights = level * (1.0 - lean), level * (1.0 + lean)
        out.append([np.interp(PLACES, at, h) for h in heights])
    return np.array(out)


def test_the_known_optimum_is_found():
    path = straight()
    cfg = RefineCfg(spacing_m=10e-3, shift_m=0.0, offset_m=0.0, effort=1e-4, iterations=12)
    target = 12e-6 / 0.02 / SPEED
    found = refine(path, analytic, PLACES, cfg, target)
    at = shares(path)
    inside = (at > 0.1) & (at < 0.9)
    speed, tilt = found.corrections[:, 0], found.corrections[:, 3]
    np.testing.assert_allclose(speed[inside], 0.1 * np.sin(2 * np.pi * at[inside]), atol=2e-3)
    np.testing.assert_allclose(tilt[inside], 0.05 * np.cos(2 * np.pi * at[inside]), atol=1e-3)
    assert found.before_m.std() / target > 0.05
    assert found.after_m.std() / target < 2e-3
    np.testing.assert_array_equal(found.after_m, analytic([found.path])[0])


def test_bounds_hold():
    cfg = RefineCfg(speed=0.02, shift_m=0.0, offset_m=0.0, tilt_rad=np.deg2rad(1.0), effort=0.0)
    found = refine(straight(), analytic, PLACES, cfg)
    assert np.abs(found.corrections[:, 0]).max() == pytest.approx(0.02, rel=0.05)
    assert np.abs(found.corrections[:, 0]).max() <= 0.02 + 1e-12
    assert np.abs(found.corrections[:, 3]).max() <= np.deg2rad(1.0) + 1e-12
    assert not found.corrections[:, [1, 2, 4]].any()


def test_an_even_bead_is_left_alone():
    found = refine(straight(), lambda paths: np.full((len(paths), 2, len(PLACES)), 2e-3), PLACES)
    assert not found.corrections.any()


def test_wrong_heights_and_bounds_are_refused():
    with pytest.raises(ConfigError, match=r"must be \(1, 2, 120\) and finite"):
        refine(straight(), lambda paths: np.zeros((len(paths), 2, 3)), PLACES)
    with pytest.raises(ConfigError, match=r"RefineCfg\.speed = 3"):
        RefineCfg(speed=3)
    with pytest.raises(ConfigError, match="allow at least one"):
        RefineCfg(speed=0.0, shift_m=0.0, offset_m=0.0, tilt_rad=0.0)
