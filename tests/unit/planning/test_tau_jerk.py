"""Tau-Jerk profiles against hand calculations, finite differences, dense grids and Ruckig's limits."""

import math

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.planning.tau_jerk import (
    DEFAULT_K,
    RateLimitsCfg,
    TauJerk,
    couple,
    peaks,
    plan,
    shortest_duration,
    unit_gap,
)

LIMITS = RateLimitsCfg(speed=(3.15, 3.15, 3.2), acceleration=8.0, jerk=(60.0, 50.0, 40.0))
FREE = RateLimitsCfg(speed=math.inf, acceleration=math.inf, jerk=math.inf)
KS = (0.1, 0.2, DEFAULT_K, 0.3, 1 / 3)


def difference(f, s, h=1e-5):
    """Central difference of fourth order."""
    return (8 * (f(s + h) - f(s - h)) - (f(s + 2 * h) - f(s - 2 * h))) / (12 * h)


def motion(k=DEFAULT_K, way=1.0, duration=1.0):
    return TauJerk(start=np.zeros(1), goal=np.array([way]), duration_s=np.array(duration), k=np.array([k]))


@pytest.mark.parametrize("k", [*KS, 0.4, 0.5, 0.8])
def test_each_derivative_is_the_finite_difference_of_the_one_before(k):
    s = np.linspace(0.01, 0.99, 197)
    for order in range(3):
        expected = difference(lambda x, o=order: unit_gap(x, k)[o], s)
        np.testing.assert_allclose(unit_gap(s, k)[order + 1], expected, rtol=2e-6, atol=2e-6)


def test_polynomial_at_one_third():
    # n = 3: 1 - 3 s^3 + 3 s^6 - s^9, differentiated by hand.
    s = np.linspace(0.0, 1.0, 101)
    gap = unit_gap(s, 1 / 3)
    np.testing.assert_allclose(gap.position, 1 - 3 * s**3 + 3 * s**6 - s**9, atol=1e-14)
    np.testing.assert_allclose(gap.velocity, -9 * s**2 + 18 * s**5 - 9 * s**8, atol=1e-13)
    np.testing.assert_allclose(gap.acceleration, -18 * s + 90 * s**4 - 72 * s**7, atol=1e-12)
    np.testing.assert_allclose(gap.jerk, -18 + 360 * s**3 - 504 * s**6, atol=1e-11)


@pytest.mark.parametrize("k", KS)
def test_ends(k):
    first, last = (unit_gap(np.array(s), k) for s in (0.0, 1.0))
    # From rest, with the jerk's step of -6 n (formulas: -6 n x0/T^3); to rest.
    assert (first.position, first.velocity, first.acceleration) == (1.0, 0.0, 0.0)
    assert first.jerk == pytest.approx(-6.0 / k)
    assert (last.position, last.velocity, last.acceleration) == (0.0, 0.0, 0.0)
    assert last.jerk == pytest.approx(-162.0 if k == 1 / 3 else 0.0)


@pytest.mark.parametrize(
    ("k", "acceleration", "jerk"), [(0.4, 0.0, -np.inf), (0.5, 18.0, 108.0), (0.6, np.inf, np.inf)]
)
def test_above_one_third_the_end_is_rough(k, acceleration, jerk):
    last = unit_gap(np.array(1.0), k)
    assert last.velocity == 0.0
    assert last.acceleration == acceleration
    assert last.jerk == jerk


@pytest.mark.parametrize("k", [0.05, 0.15, 0.22, DEFAULT_K, 0.28, 0.32, 1 / 3])
def test_peaks_are_the_largest_on_a_dense_grid(k):
    gap = unit_gap(np.linspace(0.0, 1.0, 200_001), k)
    for found, values in zip(peaks(k), gap[1:], strict=True):
        assert found == pytest.approx(np.abs(values).max(), rel=1e-8)


def test_peak_speed_is_where_the_formulas_say():
    n = 1 / DEFAULT_K
    at = (2 / (3 * n - 1)) ** (1 / 3)
    assert peaks(DEFAULT_K).speed == pytest.approx(3 * n * at**2 * (1 - at**3) ** (n - 1))


def test_peaks_are_infinite_where_the_end_is_rough():
    found = peaks(np.array([0.25, 0.4, 0.5, 0.6]))
    np.testing.assert_array_equal(np.isinf(found.acceleration), [False, False, False, True])
    np.testing.assert_array_equal(np.isinf(found.jerk), [False, True, True, True])
    # k = 1/2: 1 - 2 s^3 + s^6, whose second derivative is largest at the end, 30 - 12.
    assert found.acceleration[2] == pytest.approx(18.0)


def test_the_default_k_has_almost_the_least_acceleration_and_a_smooth_end():
    least = peaks(np.linspace(0.05, 1 / 3, 2000)).acceleration.min()
    assert peaks(DEFAULT_K).acceleration < 1.001 * least
    assert unit_gap(np.array(1.0), DEFAULT_K).jerk == 0.0


def test_acceleration_is_continuous_over_the_ends_and_the_jerk_bounded():
    t = np.linspace(-0.5, 2.5, 300_001)
    a, j = (x[:, 0] for x in motion(way=0.7, duration=2.0).sample(t)[2:])
    # No step of the acceleration is larger than the jerk makes it in a sampling interval.
    assert np.abs(np.diff(a)).max() <= np.abs(j).max() * (t[1] - t[0]) * (1 + 1e-6)
    assert np.abs(j).max() == pytest.approx(float(peaks(DEFAULT_K).jerk) * 0.7 / 2.0**3, rel=1e-6)


def test_before_and_after_it_rests():
    m = motion(way=-0.4, duration=3.0).sample(np.array([-1.0, 3.5]))
    np.testing.assert_allclose(m.position[:, 0], [0.0, -0.4], atol=1e-16)
    for rate in m[1:]:
        np.testing.assert_array_equal(rate, 0.0)


def test_sampled_rates_scale_with_way_and_time():
    t = np.linspace(0.05, 2.95, 59)
    m = motion(way=-0.4, duration=3.0)
    for order in range(3):
        expected = difference(lambda x, o=order: m.sample(x)[o][:, 0], t)
        np.testing.assert_allclose(m.sample(t)[order + 1][:, 0], expected, atol=1e-8)


@pytest.mark.parametrize("scale", [1e-3, 0.1, 1.0, 30.0])
def test_a_plan_keeps_to_its_limits_and_touches_one(scale):
    rng = np.random.default_rng(0)
    start, goal = scale * rng.uniform(-1, 1, (2, 40, 3))
    m = plan(start, goal, LIMITS, k=np.array([0.25, 0.2, 0.3]))
    t = m.duration_s[:, None] * np.linspace(0.0, 1.0, 5001)
    used = [
        np.abs(x).max(axis=1) / limit for x, limit in zip(m.sample(t)[1:], vars(LIMITS).values(), strict=True)
    ]
    largest = np.max(used, axis=(0, 2))
    assert largest.max() < 1 + 1e-9
    assert largest.min() > 1 - 1e-5


def test_the_duration_by_hand():
    # k = 1/3, way 2: peaks 2 x 162 / T^3 = 60; the speed and the acceleration ask for less.
    limits = RateLimitsCfg(speed=10.0, acceleration=100.0, jerk=60.0)
    assert shortest_duration(np.array([2.0]), limits, 1 / 3) == pytest.approx((324 / 60) ** (1 / 3))


def test_without_limits_or_way_it_takes_no_time():
    assert shortest_duration(np.ones(3), FREE) == 0.0
    m = plan(np.ones(3), np.ones(3), LIMITS)
    assert m.duration_s == 0.0
    sampled = m.sample(np.array([0.0, 1.0]))
    np.testing.assert_array_equal(sampled.position, 1.0)
    np.testing.assert_array_equal(sampled.jerk, 0.0)


def test_an_axis_that_rests_may_have_a_rough_k():
    m = TauJerk(
        start=np.zeros(2), goal=np.array([1.0, 0.0]), duration_s=np.array(1.0), k=np.array([0.25, 0.6])
    )
    np.testing.assert_array_equal(m.sample(1.0).jerk, 0.0)


def test_batches_equal_singles():
    rng = np.random.default_rng(1)
    start, goal = rng.uniform(-1, 1, (2, 5, 4, 3))
    t = np.linspace(0.0, 1.0, 11)
    whole = plan(start, goal, LIMITS)
    assert whole.duration_s.shape == (5, 4)
    sampled = whole.sample(t)
    assert sampled.jerk.shape == (5, 4, 11, 3)
    one = plan(start[2, 3], goal[2, 3], LIMITS).sample(t)
    for a, b in zip(sampled, one, strict=True):
        np.testing.assert_array_equal(a[2, 3], b)


@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.0, 1.3])
def test_tau_of_a_coupled_gap_is_the_ratio_times_the_leader_s(ratio):
    s = np.linspace(0.05, 0.95, 91)
    leader, coupled = unit_gap(s, 0.25), unit_gap(s, couple(0.25, ratio))
    tau_p, tau_q = (gap.position / gap.velocity for gap in (leader, coupled))
    np.testing.assert_allclose(tau_q, ratio * tau_p, rtol=1e-12)
    # Eqs. 26-28: q = q0 (p/p0)^(1/k_qp).
    np.testing.assert_allclose(coupled.position, leader.position ** (1 / ratio), rtol=1e-12)


def test_tau_of_a_gap_is_k_times_the_intrinsic_one_s():
    # Eq. 31: tau of T^3 - t^3 is (t - T^3/t^2)/3.
    s = np.linspace(0.05, 0.95, 91)
    gap = unit_gap(s, 0.3)
    np.testing.assert_allclose(gap.position / gap.velocity, 0.3 * (s - 1 / s**2) / 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: unit_gap(np.zeros(1), 0.0), "must be in"),
        (lambda: unit_gap(np.zeros(1), 1.0), "must be in"),
        (lambda: couple(0.25, 4.0), "smaller ratio"),
        (lambda: couple(0.25, -1.0), "must be positive"),
        (lambda: RateLimitsCfg(speed=0.0, acceleration=1.0, jerk=1.0), "speed = 0.0"),
        (lambda: RateLimitsCfg(speed=1.0, acceleration=(1.0, math.nan), jerk=1.0), "acceleration"),
        (lambda: LIMITS.scaled(1.5), "share = 1.5"),
        (lambda: plan(np.zeros(3), np.ones(3), LIMITS, k=0.4), "jerk is unbounded"),
        (
            lambda: plan(np.zeros(1), np.ones(1), RateLimitsCfg(speed=1, acceleration=1, jerk=math.inf), 0.6),
            "acceleration is unbounded",
        ),
        (lambda: motion(duration=0.0), "must be positive where"),
        (lambda: motion(duration=np.nan), "must be finite"),
        (
            lambda: TauJerk(start=np.zeros(2), goal=np.zeros(3), duration_s=np.ones(()), k=np.full(2, 0.25)),
            "must be",
        ),
        (
            lambda: TauJerk(start=np.zeros(2), goal=np.ones(2), duration_s=np.ones(()), k=np.full(3, 0.25)),
            "one number an axis",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_scaled_limits():
    half = LIMITS.scaled(0.5)
    assert half == RateLimitsCfg(speed=(1.575, 1.575, 1.6), acceleration=4.0, jerk=(30.0, 25.0, 20.0))


def test_ruckig_is_faster_under_the_same_limits():
    # Ruckig is time-optimal: no motion that keeps to the limits can beat it.
    ruckig = pytest.importorskip("ruckig")
    rng = np.random.default_rng(2)
    for start, goal in rng.uniform(-2, 2, (20, 2, 3)):
        given = ruckig.InputParameter(3)
        given.current_position, given.target_position = start.tolist(), goal.tolist()
        given.max_velocity, given.max_acceleration = list(LIMITS.speed), [LIMITS.acceleration] * 3
        given.max_jerk = list(LIMITS.jerk)
        best = ruckig.Trajectory(3)
        ruckig.Ruckig(3).calculate(given, best)
        assert best.duration <= plan(start, goal, LIMITS).duration_s <= 2.0 * best.duration
