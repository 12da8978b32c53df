"""Environments that see by vision."""

import gymnasium as gym
import numpy as np
import pytest

from agents.expert import RmpExpert
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore


def roll(n, seeds, frames=25, observation="features"):
    core = SealCore(SealCfg(control="rmp", perception="vision", observation=observation), n)
    for i, seed in enumerate(seeds):
        core.reset(i, np.random.default_rng(seed))
    expert, out = RmpExpert(), []
    for _ in range(frames):
        seen = core.observe()
        out.append(seen if observation == "features" else seen["features"])
        core.step(expert.predict(out[-1])[0])
    return np.array(out), core


def test_one_and_eight_agree_to_the_bit():
    seeds = range(500_000, 500_008)
    many, _ = roll(8, seeds)
    for i in (0, 3, 7):
        one, _ = roll(1, [seeds[i]])
        np.testing.assert_array_equal(many[:, i], one[:, 0])
    np.testing.assert_array_equal(many, roll(8, seeds)[0])


def test_images_in_the_observation_change_nothing():
    with_images, core = roll(2, [1, 2], observation="features+images")
    np.testing.assert_array_equal(with_images, roll(2, [1, 2])[0])
    assert core.snr_db is not None and core.snr_db.shape == (2, 2)


@pytest.mark.parametrize("part", ["flat", "cylinder", "rectangular"])
def test_the_expert_seals_by_vision(part):
    env = gym.make("SealGym/Seal-v0", workpiece=part, control="rmp", perception="vision")
    expert, done = RmpExpert(), False
    observation, info = env.reset(seed=500_000)
    assert np.isfinite(info["snr_db"]).all()
    while not done:
        action, _ = expert.predict(observation)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    env.close()
    assert info["episode_metrics"]["outcome"] == "reached"
    assert info["episode_metrics"]["rmse_mm"] < 0.15


def test_the_oracle_without_images_measures_no_noise():
    env = gym.make("SealGym/Flat-v0", perception="oracle")
    assert "snr_db" not in env.reset(seed=0)[1]
    env.close()
