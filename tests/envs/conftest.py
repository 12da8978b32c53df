"""Environments that close themselves, and whole episodes of the expert, one for each id."""

import types

import gymnasium as gym
import numpy as np
import pytest

import seal_gym
from agents.expert import RmpExpert


@pytest.fixture
def make():
    """``gym.make``, closing what it made."""
    made = []

    def build(env_id="SealGym/Flat-v0", **kwargs):
        made.append(gym.make(env_id, **kwargs))
        return made[-1]

    yield build
    for env in made:
        env.close()


def _tip_in_part(core):
    part, tip = core.arm.part_pose[0], core.tip.pose[0]
    return np.linalg.inv(part) @ tip


def _episode(env_id, seed):
    env, expert = gym.make(env_id, control="rmp", perception="oracle"), RmpExpert()
    core = env.unwrapped.core
    observation, info = env.reset(seed=seed)
    out = types.SimpleNamespace(
        observations=[observation], infos=[info], tips=[_tip_in_part(core)], actions=[], rewards=[], q=[]
    )
    done = False
    while not done:
        action, _ = expert.predict(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        out.observations.append(observation)
        out.infos.append(info)
        out.tips.append(_tip_in_part(core))
        out.actions.append(action)
        out.rewards.append(reward)
    out.tips, out.observations = np.array(out.tips), np.array(out.observations, np.float64)
    out.terminated, out.truncated, out.metrics = terminated, truncated, info["episode_metrics"]
    env.close()
    return out


@pytest.fixture(scope="session", params=seal_gym.ENV_IDS)
def episode(request):
    """The expert's whole episode on an id, on the oracle's features, recorded."""
    out = _episode(request.param, 500_000)
    out.env_id = request.param
    return out


@pytest.fixture(scope="session")
def flat_episode():
    return _episode("SealGym/Flat-v0", 500_001)
