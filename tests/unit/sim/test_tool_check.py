"""Collisions of the upright tool, as MuJoCo finds them, against the palette's geometry."""

import numpy as np
import pytest

from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.palette_env import POSTURE, PaletteEnv
from seal_gym.sim.tool_check import ToolCheck

MARGIN = 0.003


def up(height):
    return np.array([0.0, 0.0, height])


@pytest.fixture(scope="module")
def env():
    env = PaletteEnv(perception="oracle")
    env.reset(seed=500_000)
    return env


@pytest.fixture(scope="module")
def check(env):
    return ToolCheck(env.scene, env.part_pose, POSTURE, MARGIN)


def test_postures_put_the_upright_tip_there(env, check):
    points = env.target_m + up(0.05)
    q = check.postures(points)
    pose = tip_kinematics(q, np.zeros_like(q)).pose
    np.testing.assert_allclose(pose[:, :3, 3], points, atol=1e-9)
    np.testing.assert_allclose(pose[:, :3, :3], np.broadcast_to(np.eye(3), (len(q), 3, 3)), atol=1e-9)


def test_over_a_tie_it_is_the_height_that_counts(env, check):
    """The pad over a tie's middle collides below the margin, and not above it."""
    for height, expected in ((0.002, False), (0.0045, True), (0.02, True)):
        assert (check.free(env.target_m + up(height)) == expected).all()


def test_beside_a_peg_it_is_the_distance_that_counts(env, check):
    """The pusher's 3.7 mm, the pad's 4 mm and the peg's 4 mm: 8 mm between the axes touch, and the margin."""
    foot = env.scene.layout.pegs[0]
    top = env.part_pose[:3, :3] @ foot + env.part_pose[:3, 3]
    angles = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    around = np.column_stack((np.cos(angles), np.sin(angles), np.zeros(12)))
    low = top - [0.0, 0.0, 0.01]
    assert not check.free(low + 0.0105 * around).any()
    others = np.linalg.norm(env.scene.layout.pegs[1:, :2] - foot[:2], axis=1)
    assert others.min() > 0.028  # nothing else as high stands near
    assert check.free(top + up(-0.002) + 0.0125 * around).all()
    assert check.free((top + up(0.0045))[None]).all()
    assert not check.free((top + up(0.002))[None]).any()


def test_out_of_reach_is_not_free(check):
    assert not check.free(np.array([[1.5, 0.0, 0.3]])).any()


def test_the_scene_is_left_alone(env, check):
    assert env.scene.model.geom_margin.max() == 0.0
    check.free(env.target_m)
    assert env.scene.model.geom_margin.max() == 0.0
