"""Everything far beyond its default: every episode ends in a named outcome, with finite numbers."""

import numpy as np
import pytest

import seal_gym
from agents.expert import RmpExpert
from seal_gym.envs.sb3 import make_sb3_vec
from seal_gym.wrappers.catalogue import KINDS

OUTCOMES = {"reached", "collision", "lost", "timeout"}


def episodes(env_id, disturbances, count, rows, perception, seed=500_000):
    """Ends of the expert's episodes, all rows checked in every frame."""
    venv = make_sb3_vec(env_id, rows, control="rmp", perception=perception, disturbances=disturbances)
    venv.seed(seed)
    observation, policy, out = venv.reset(), RmpExpert(), []
    while len(out) < count:
        action, _ = policy.predict(observation)
        observation, reward, done, infos = venv.step(action)
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        for i in np.flatnonzero(done):
            metrics = infos[i]["episode_metrics"]
            assert metrics["outcome"] in OUTCOMES
            numbers = [v for v in metrics.values() if isinstance(v, float)]
            assert np.isfinite(numbers).all()
            out.append(metrics)
    venv.close()
    return out


@pytest.mark.parametrize("name", KINDS)
def test_severity_4(name):
    env_id = "SealGym/Cylinder-v0"
    outcomes = episodes(env_id, [{"name": name, "severity": 4.0}], 4, 4, "oracle")
    assert len(outcomes) == 4


def test_everything_at_once():
    everything = [{"name": name, "severity": 4.0} for name in KINDS]
    assert len(episodes("SealGym/Rectangular-v0", everything, 4, 4, "vision")) == 4


@pytest.mark.slow
@pytest.mark.parametrize("env_id", seal_gym.ENV_IDS[:3])
@pytest.mark.parametrize("name", KINDS)
def test_severity_4_for_200_episodes(name, env_id):
    """By vision, on each part; 67 episodes a part make the 200."""
    assert len(episodes(env_id, [{"name": name, "severity": 4.0}], 67, 16, "vision")) >= 67
