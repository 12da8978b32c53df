"""Joint limits and obstacles."""

import numpy as np
import pytest

from seal_gym.core.errors import ConfigError
from seal_gym.rmp import JointLimitCfg, Leaf, ObstacleCfg, joint_limits, obstacle, resolve

LOWER, UPPER = -np.ones(6), np.ones(6)
CFG = JointLimitCfg(margin=0.2, omega_n=10.0, zeta=1.0, weight=50.0)


def limits_1d(q, qd=0.0, cfg=CFG):
    leaf = joint_limits(np.array([[q]]), np.array([[qd]]), LOWER[:1], UPPER[:1], cfg)
    return leaf.accel[0, 0], leaf.metric[0, 0, 0]


def test_nothing_happens_far_from_limits():
    leaf = joint_limits(np.zeros((2, 6)), np.ones((2, 6)), LOWER, UPPER)
    np.testing.assert_array_equal(leaf.metric, np.zeros((2, 6, 6)))
    np.testing.assert_array_equal(leaf.accel, np.zeros((2, 6)))
    np.testing.assert_array_equal(leaf.jacobian, np.broadcast_to(np.eye(6), (2, 6, 6)))
    np.testing.assert_array_equal(leaf.drift, np.zeros((2, 6)))


def test_values_by_hand_near_both_limits():
    # half the margin: weight 50 * 0.25; spring 100 * 0.2 * 0.5; damper 2 * 10 on outward velocity only
    np.testing.assert_allclose(limits_1d(0.9, 0.0), (-10.0, 12.5))
    np.testing.assert_allclose(limits_1d(0.9, 0.3), (-16.0, 12.5))
    np.testing.assert_allclose(limits_1d(0.9, -0.3), (-10.0, 12.5))
    np.testing.assert_allclose(limits_1d(-0.9, -0.3), (16.0, 12.5))
    np.testing.assert_allclose(limits_1d(-0.9, 0.3), (10.0, 12.5))


def test_metric_is_smooth_and_grows_towards_the_limit():
    q = np.linspace(0.0, 1.05, 2000)[:, None]
    leaf = joint_limits(q, np.full_like(q, 0.5), LOWER[:1], UPPER[:1], CFG)
    metric = leaf.metric[:, 0, 0]
    force = metric * leaf.accel[:, 0]
    assert np.all(np.diff(metric) >= 0.0)
    assert metric[-1] > CFG.weight
    for values in (metric, force):
        assert np.abs(np.diff(values, n=2)).max() < 1e-3 * np.abs(values).max()


def test_margins_that_overlap_cancel_in_the_middle():
    accel, metric = limits_1d(0.0, 0.0, JointLimitCfg(margin=3.0))
    assert accel == 0.0
    assert metric > 0.0


def test_infinite_limits_are_none():
    q = np.full((1, 2), 50.0)
    leaf = joint_limits(q, q, np.full(2, -np.inf), np.full(2, np.inf))
    assert not leaf.metric.any()


def test_limits_hold_against_a_leaf_that_pushes_outward():
    q, qd, dt = np.zeros((1, 6)), np.zeros((1, 6)), 1 / 30
    jacobian, drift = np.eye(6)[None], np.zeros((1, 6))
    for _ in range(300):
        push = Leaf(jacobian, drift, 0.5 * (2.0 - q) - 2.0 * qd, jacobian)
        qd = qd + dt * resolve([push, joint_limits(q, qd, LOWER, UPPER)], jacobian)
        q = q + dt * qd
        assert q.max() < 1.0
    assert q.min() > 0.83, "the leaf must not hold the joint far from its limit"


def test_obstacle_by_hand_on_a_one_dimensional_task():
    cfg = ObstacleCfg(margin=0.02, omega_n=10.0, zeta=0.5, weight=8.0)
    gradient = np.arange(12.0).reshape(2, 6)
    leaf = obstacle(np.array([0.01, 0.05]), np.array([-0.1, -0.1]), gradient, np.array([0.3, 0.4]), cfg)
    np.testing.assert_array_equal(leaf.jacobian, gradient[:, None])
    np.testing.assert_array_equal(leaf.drift, [[0.3], [0.4]])
    np.testing.assert_allclose(leaf.metric, [[[2.0]], [[0.0]]])
    np.testing.assert_allclose(leaf.accel[0], 100 * 0.01 + 10 * 0.1)


def test_an_obstacle_stops_the_approach_and_leaves_sliding_free():
    # a point at height h above a floor, driven down at 50 mm/s and along at 20 mm/s
    position, velocity, dt = np.array([[0.0, 0.04]]), np.array([[0.02, -0.05]]), 1 / 30
    plane, drift = np.eye(2)[None], np.zeros((1, 2))
    for _ in range(150):
        task = Leaf(plane, drift, 8.0 * (np.array([[0.02, -0.05]]) - velocity), plane)
        floor = obstacle(position[:, 1], velocity[:, 1], plane[:, 1], drift[:, 0])
        velocity = velocity + dt * resolve([task, floor], plane)
        position = position + dt * velocity
        assert position[0, 1] > 0.0
    np.testing.assert_allclose(velocity[0], [0.02, 0.0], atol=1e-4)


@pytest.mark.parametrize("make", [JointLimitCfg, ObstacleCfg])
@pytest.mark.parametrize("field", ["margin", "omega_n", "zeta", "weight"])
def test_bad_configurations_are_refused(make, field):
    with pytest.raises(ConfigError, match=rf"{make.__name__}\.{field} is 0.0"):
        make(**{field: 0.0})
