"""The motions that tau-Jerk is compared with: against finite differences, grids and hand calculations."""

import numpy as np
import pytest

from experiments import point_to_point as p2p
from experiments.point_to_point import Limits

LIMITS = Limits(3.15, 15.0, 150.0)
MAKERS = [p2p.tau_jerk_profile, p2p.quintic, p2p.trapezoidal, p2p.time_optimal]


@pytest.fixture(params=MAKERS, ids=lambda make: make.__name__)
def make(request):
    if request.param is p2p.time_optimal:
        pytest.importorskip("ruckig")
    return request.param


@pytest.mark.parametrize("way", [0.05, 0.5, 3.0])
def test_profiles_go_their_way_from_rest_to_rest_within_limits(make, way):
    profile = make(way, LIMITS)
    t = np.linspace(0.0, profile.duration_s, 40_001)
    motion = profile.sample(t)
    np.testing.assert_allclose(motion.position[[0, -1]], [0.0, way], atol=1e-9)
    np.testing.assert_allclose(motion.velocity[[0, -1]], 0.0, atol=1e-9)
    assert (np.diff(motion.position) > -1e-12).all()
    rates = motion[1:3] if make is p2p.trapezoidal else motion[1:]
    for values, peak, limit in zip(rates, profile.peaks, LIMITS, strict=False):
        assert np.abs(values).max() == pytest.approx(peak, rel=1e-3)
        assert peak <= limit * (1 + 1e-9)
    if make is not p2p.trapezoidal:
        np.testing.assert_allclose(motion.jerk[[0, -1]], profile.end_jerk, atol=1e-6)


@pytest.mark.parametrize("way", [0.05, 0.5, 3.0])
def test_rates_are_finite_differences(make, way):
    profile = make(way, LIMITS)
    h = 1e-5
    t = np.linspace(2 * h, profile.duration_s - 2 * h, 5000)
    before, now, after = (profile.sample(t + dt) for dt in (-h, 0.0, h))
    for order in (0, 1, 2):
        if order == 2 and make is p2p.trapezoidal:
            continue
        slope = (after[order] - before[order]) / (2 * h)
        # Where phases meet a difference sees both.
        assert np.quantile(np.abs(slope - now[order + 1]), 0.99) < 2e-3 * max(1.0, np.abs(slope).max())


def test_trapezoid_by_hand():
    # 1 rad at 2 rad/s and 4 rad/s^2: ramps of 0.5 s, no plateau; at 1 rad/s 0.25 s up, 0.75 s, 0.25 s down.
    assert p2p.trapezoidal(1.0, Limits(2.0, 4.0, 1.0)).duration_s == pytest.approx(1.0)
    assert p2p.trapezoidal(1.0, Limits(1.0, 4.0, 1.0)).duration_s == pytest.approx(1.25)


def test_without_ruckig_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(p2p, "ruckig", None)
    with pytest.raises(p2p.ConfigError, match=r"seal-gym\[planning\]"):
        p2p.fastest_s(np.ones(2), LIMITS)
