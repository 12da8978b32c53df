"""Environments that close themselves."""

import gymnasium as gym
import pytest

from seal_gym.envs.sb3 import make_sb3_vec


@pytest.fixture
def make():
    """``gym.make`` on the oracle's features with raw joint accelerations, closing what it made."""
    made = []

    def build(env_id="SealGym/Flat-v0", **kwargs):
        defaults = {"perception": "oracle", "control": "joint", "disable_env_checker": True}
        made.append(gym.make(env_id, **{**defaults, **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()


@pytest.fixture
def make_vec():
    """``make_sb3_vec`` likewise."""
    made = []

    def build(n, env_id="SealGym/Flat-v0", **kwargs):
        defaults = {"perception": "oracle", "control": "joint"}
        made.append(make_sb3_vec(env_id, n, **{**defaults, **kwargs}))
        return made[-1]

    yield build
    for env in made:
        env.close()
