"""Tau-Jerk motion of poses against scipy's rotations and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import transform
from seal_gym.planning.tau_jerk import RateLimitsCfg
from seal_gym.planning.tau_jerk_pose import plan_pose, rotation_matrix, rotation_vector

LINEAR = RateLimitsCfg(speed=0.25, acceleration=1.2, jerk=10.0)
ANGULAR = RateLimitsCfg(speed=1.0, acceleration=4.0, jerk=30.0)
N = 20


def poses(seed):
    rng = np.random.default_rng(seed)
    return transform(Rotation.random(N, rng=rng).as_matrix(), rng.uniform(-0.5, 0.5, (N, 3)))


@pytest.fixture(scope="module")
def motion():
    return plan_pose(poses(0), poses(1), LINEAR, ANGULAR, ratio=0.8)


def test_it_starts_and_ends_at_its_poses(motion):
    ends = np.stack((np.zeros(N), motion.duration_s), axis=-1)
    sampled = motion.sample(ends)
    np.testing.assert_allclose(sampled.pose[:, 0], poses(0), atol=1e-12)
    np.testing.assert_allclose(sampled.pose[:, 1], poses(1), atol=1e-12)
    np.testing.assert_array_equal(sampled.twist, 0.0)
    np.testing.assert_array_equal(sampled.acceleration, 0.0)


def test_rates_are_finite_differences(motion):
    h = 1e-4
    t = motion.duration_s[:, None] * np.linspace(0.05, 0.95, 19)
    before, now, after = (motion.sample(t + dt) for dt in (-h, 0.0, h))
    linear = (after.pose[..., :3, 3] - before.pose[..., :3, 3]) / (2 * h)
    turned = after.pose[..., :3, :3] @ np.swapaxes(before.pose[..., :3, :3], -1, -2)
    angular = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(N, 19, 3) / (2 * h)
    np.testing.assert_allclose(now.twist, np.concatenate((linear, angular), axis=-1), atol=1e-6)
    np.testing.assert_allclose(now.acceleration, (after.twist - before.twist) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(now.jerk, (after.acceleration - before.acceleration) / (2 * h), atol=1e-4)


def test_it_keeps_to_both_limits_and_touches_one(motion):
    t = motion.duration_s[:, None] * np.linspace(0.0, 1.0, 4001)
    used = []
    for rate, name in zip(motion.sample(t)[1:], ("speed", "acceleration", "jerk"), strict=True):
        for part, limits in ((rate[..., :3], LINEAR), (rate[..., 3:], ANGULAR)):
            used.append(np.linalg.norm(part, axis=-1).max(axis=1) / getattr(limits, name))
    largest = np.max(used, axis=0)
    assert largest.max() < 1 + 1e-9
    assert largest.min() > 1 - 1e-5


def test_the_coupled_turn_is_ahead_and_follows_eq_26(motion):
    t = motion.duration_s[:, None] * np.linspace(0.1, 0.9, 9)
    sampled, goal = motion.sample(t).pose, poses(1)[:, None]
    distance = np.linalg.norm(goal[..., :3, 3] - sampled[..., :3, 3], axis=-1)
    left = np.swapaxes(sampled[..., :3, :3], -1, -2) @ goal[..., :3, :3]
    angle = Rotation.from_matrix(left.reshape(-1, 3, 3)).magnitude().reshape(N, 9)
    first = np.linalg.norm(poses(1)[:, :3, 3] - poses(0)[:, :3, 3], axis=-1)[:, None]
    turn = np.swapaxes(poses(0)[:, :3, :3], -1, -2) @ poses(1)[:, :3, :3]
    whole = Rotation.from_matrix(turn).magnitude()[:, None]
    np.testing.assert_allclose(angle / whole, (distance / first) ** (1 / 0.8), atol=1e-7)


def test_a_turn_on_the_spot_and_a_shift_without_one():
    here = poses(0)[0]
    there = here.copy()
    there[:3, 3] += 0.1
    shift = plan_pose(here, there, LINEAR, ANGULAR)
    np.testing.assert_allclose(shift.sample(0.1).pose[0, :3, :3], here[:3, :3], atol=1e-15)
    turned = transform(here[:3, :3] @ Rotation.from_euler("x", 180, degrees=True).as_matrix(), here[:3, 3])
    turn = plan_pose(here, turned, LINEAR, ANGULAR)
    np.testing.assert_allclose(turn.sample(0.3).pose[0, :3, 3], here[:3, 3])
    np.testing.assert_allclose(turn.sample(turn.duration_s).pose[0], turned, atol=1e-12)


def test_logarithm_and_exponential():
    vectors = np.random.default_rng(3).normal(size=(4, 5, 3))
    np.testing.assert_allclose(
        rotation_matrix(vectors).reshape(-1, 3, 3),
        Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix(),
        atol=1e-14,
    )
    small = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True) * 3.0
    np.testing.assert_allclose(rotation_vector(rotation_matrix(small)), small, atol=1e-12)
    np.testing.assert_array_equal(rotation_matrix(np.zeros(3)), np.eye(3))


def test_a_coupling_that_leaves_the_turn_rough_is_refused():
    with pytest.raises(ConfigError, match="jerk is unbounded"):
        plan_pose(poses(0), poses(1), LINEAR, ANGULAR, ratio=1.5)
