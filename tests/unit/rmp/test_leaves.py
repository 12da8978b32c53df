"""Leaf values against hand calculations."""

from dataclasses import replace

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.rmp import (
    AttractionCfg,
    DampingCfg,
    ForwardSpeedCfg,
    HeadingCfg,
    LeanCfg,
    RegularisationCfg,
    attraction_front,
    attraction_side,
    blend,
    damping,
    forward_speed,
    heading_front,
    heading_side,
    lean,
    on_tip,
    regularisation,
    saturate,
    sigma,
)

PLAIN = AttractionCfg(omega_n=10.0, zeta=0.5, floor=1.0, weight=2.0, damping_weight=1.0, max_rate=1e6)
SERVOS = [
    (attraction_front, 0, 1),
    (attraction_side, 2, 1),
    (heading_side, 3, 1),
    (lean, 4, 1),
    (heading_front, 5, -1),
]


def one(value):
    return np.array([float(value)])


def test_sigma_by_hand_and_of_the_magnitude():
    np.testing.assert_allclose(
        sigma(np.array([0.0, 2.0, -2.0]), 1.0, 3.0), 1 / (1 + np.exp([3.0, -3.0, -3.0]))
    )
    assert sigma(one(1.0), 1.0, 7.0) == 0.5


def test_sigma_neither_overflows_nor_warns():
    values = sigma(np.array([0.0, 1e300, -1e300, np.inf]), 1e3, 1e5)
    np.testing.assert_array_equal(values, [0.0, 1.0, 1.0, 1.0])


def test_saturation_is_linear_at_zero_and_bounded():
    np.testing.assert_allclose(saturate(one(1e-6), 1.0), 1e-6)
    np.testing.assert_array_equal(saturate(np.array([-1e9, 1e9]), 2.0), [-2.0, 2.0])


@pytest.mark.parametrize(("leaf", "axis", "sign"), SERVOS)
def test_servo_leaves_by_hand(leaf, axis, sign):
    # k = omega^2 (1 + b / w) = 100 * 1.5; c = 2 zeta omega = 10; a = 150 e - 10 v
    policy = leaf(one(0.01), one(0.02), PLAIN)
    expected = np.zeros((1, 6))
    expected[0, axis] = sign * 1.5 - 0.2
    np.testing.assert_allclose(policy.accel, expected, rtol=1e-9)
    projector = np.zeros((6, 6))
    projector[axis, axis] = 2.0
    np.testing.assert_array_equal(policy.metric, projector[None])


@pytest.mark.parametrize("cfg", [AttractionCfg(), HeadingCfg(), LeanCfg()])
def test_metric_grows_with_the_magnitude_from_its_floor(cfg):
    errors = np.array([0.0, cfg.threshold, -cfg.threshold, 1e3])
    weights = attraction_front(errors, np.zeros(4), cfg).metric[:, 0, 0]
    at_zero = cfg.floor + (1 - cfg.floor) / (1 + np.exp(cfg.slope * cfg.threshold))
    middle = (1 + cfg.floor) / 2
    np.testing.assert_allclose(weights / cfg.weight, [at_zero, middle, middle, 1.0])


@pytest.mark.parametrize(("leaf", "axis", "sign"), SERVOS)
def test_large_errors_ask_for_no_more_than_the_approach_speed(leaf, axis, sign):
    cfg = AttractionCfg(max_rate=0.02)
    far = leaf(one(100.0), one(0.0), cfg).accel[0, axis]
    np.testing.assert_allclose(far, sign * cfg.damping_s * 0.02)
    at_speed = leaf(one(100.0), one(sign * 0.02), cfg).accel[0, axis]
    np.testing.assert_allclose(at_speed, 0.0, atol=1e-12)


def test_forward_speed_by_hand():
    policy = forward_speed(one(0.008), 0.01, ForwardSpeedCfg(gain_s=10.0, weight=3.0, max_accel_m_s2=1e6))
    np.testing.assert_allclose(policy.accel, [[0, 0.02, 0, 0, 0, 0]], atol=1e-12)
    np.testing.assert_array_equal(policy.metric[0], np.diag([0, 3.0, 0, 0, 0, 0]))
    assert forward_speed(one(0.0), 1e3).accel[0, 1] == ForwardSpeedCfg().max_accel_m_s2


def test_damping_acts_on_all_six_against_the_reference():
    cfg = DampingCfg(damping_s=10.0, weight=0.4, floor=0.25)
    twist, reference = np.arange(6.0)[None], np.ones((1, 6))
    error = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, -1.0]])
    policy = damping(twist, reference, error, cfg)
    np.testing.assert_allclose(policy.accel, 10.0 * (reference - twist))
    near = 0.4 * (1 - 0.75 / (1 + np.exp(4.0)))
    near_turn = 0.4 * (1 - 0.75 / (1 + np.exp(115.0 * 0.035)))
    expected = np.diag([near, near, 0.1, near_turn, near_turn, 0.1])
    np.testing.assert_allclose(policy.metric[0], expected)


def test_regularisation_is_a_unit_metric_towards_the_last_acceleration():
    previous = np.arange(12.0).reshape(2, 6)
    policy = regularisation(previous, RegularisationCfg(weight=0.3))
    np.testing.assert_array_equal(policy.accel, previous)
    np.testing.assert_array_equal(policy.metric, np.broadcast_to(0.3 * np.eye(6), (2, 6, 6)))


def test_on_tip_wraps_without_copying():
    policy = lean(one(0.1), one(0.0))
    jacobian, drift = np.ones((1, 6, 6)), np.zeros((1, 6))
    leaf = on_tip(*policy, jacobian, drift)
    assert leaf.jacobian is jacobian
    assert leaf.drift is drift
    assert leaf.accel is policy.accel
    assert leaf.metric is policy.metric


def test_blend_is_the_weighted_mean_and_zero_on_open_axes():
    fast = attraction_front(one(0.01), one(0.0), PLAIN)
    slow = attraction_front(one(0.01), one(0.0), replace(PLAIN, weight=6.0))
    mixed = blend([fast, slow])
    expected = (2 * fast.accel[0, 0] + 6 * slow.accel[0, 0]) / 8
    np.testing.assert_allclose(mixed.accel, [[expected, 0, 0, 0, 0, 0]], rtol=1e-9)
    assert mixed.metric[0, 0, 0] == 8.0


@pytest.mark.parametrize(
    ("make", "field", "values"),
    [
        (AttractionCfg, "omega_n", (0.0, -1.0, np.nan)),
        (HeadingCfg, "max_rate", (0.0, np.inf)),
        (LeanCfg, "floor", (0.0, 1.1)),
        (DampingCfg, "floor", (0.0, 2.0)),
        (DampingCfg, "damping_s", (0.0,)),
        (DampingCfg, "slope_per_rad", (-1.0,)),
        (ForwardSpeedCfg, "gain_s", (0.0,)),
        (RegularisationCfg, "weight", (0.0, -0.1)),
    ],
)
def test_bad_configurations_are_refused(make, field, values):
    for value in values:
        with pytest.raises(ConfigError, match=rf"{make.__name__}\.{field} is"):
            make(**{field: value})
