"""``SealSb3VecEnv``: the single environments' numbers with Stable-Baselines3's conventions."""

import gymnasium as gym
import numpy as np
import pytest

import seal_gym
from seal_gym.core.errors import ActionError, ConfigError
from seal_gym.envs.seal_env import SealEnv
from seal_gym.tasks.progress import SealTaskCfg

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize  # noqa: E402

from seal_gym.envs.sb3 import SealSb3VecEnv, make_sb3_vec  # noqa: E402  # needs stable_baselines3

IDS = seal_gym.ENV_IDS
SHORT = SealTaskCfg(time_factor=0.009)


def same(a, b):
    assert type(a) is type(b)
    if isinstance(b, dict):
        assert a.keys() == b.keys()
        for key in b:
            same(a[key], b[key])
    else:
        np.testing.assert_array_equal(a, b)


def row(x, i):
    return {k: v[i] for k, v in x.items()} if isinstance(x, dict) else x[i]


@pytest.mark.parametrize("observation", ["features", "features+images"])
@pytest.mark.parametrize("env_id", IDS)
def test_it_is_a_dummy_vec_env_of_monitored_singles_to_the_bit(env_id, observation):
    """Observations, float32 rewards, dones, infos with terminal observation, through same-step autoresets."""
    kwargs = {"observation": observation, "task": SHORT}
    n, steps = 3, 25 if observation == "features" else 12
    mine = make_sb3_vec(env_id, n, **kwargs)
    theirs = DummyVecEnv([lambda: Monitor(gym.make(env_id, **kwargs))] * n)
    assert mine.seed(11) == theirs.seed(11)
    first, expected = mine.reset(), theirs.reset()
    rng = np.random.default_rng(0)
    ends = 0
    for i in range(n):
        same(row(first, i), row(expected, i))
        same(mine.reset_infos[i], theirs.reset_infos[i])
    for _ in range(steps):
        actions = rng.uniform(-1, 1, (n, 6)).astype(np.float32) * np.array([[0.05], [1.0], [0.3]], np.float32)
        a, b = mine.step(actions), theirs.step(actions)
        for i in range(n):
            same(row(a[0], i), row(b[0], i))
            if "episode" in b[3][i]:
                ends += 1
                episode, other = a[3][i].pop("episode"), b[3][i].pop("episode")
                assert (episode["r"], episode["l"]) == (pytest.approx(other["r"], abs=2e-6), other["l"])
                assert episode["t"] >= 0
                same(mine.reset_infos[i], theirs.reset_infos[i])
            same(a[3][i], b[3][i])
        assert a[1].dtype == b[1].dtype == np.float32
        np.testing.assert_array_equal(a[1], b[1])
        np.testing.assert_array_equal(a[2], b[2])
    assert ends >= 3
    mine.close()
    theirs.close()


@pytest.mark.parametrize("control", ["rmp", "joint"])
def test_other_controls(control):
    env, single = make_sb3_vec("SealGym/Flat-v0", 2, control=control), SealEnv(control=control)
    env.seed(0)
    np.testing.assert_array_equal(env.reset()[0], single.reset(seed=0)[0])
    action = np.full((2, env.action_space.shape[0]), 0.01, np.float32)
    for _ in range(3):
        np.testing.assert_array_equal(env.step(action)[0][0], single.step(action[0])[0])


def test_a_truncated_end_is_marked_and_a_terminated_one_is_not():
    env = make_sb3_vec("SealGym/Flat-v0", 2, task=SHORT)
    env.reset()
    dones = np.zeros(2, np.bool_)
    while not dones.any():
        _, _, dones, infos = env.step(np.zeros((2, 6)))
    assert dones.all() and infos[0]["TimeLimit.truncated"] is True
    assert infos[0]["episode_metrics"]["outcome"] == "timeout" and infos[0]["is_success"] is False
    env = make_sb3_vec("SealGym/Flat-v0", 1)
    env.reset()
    dones = np.zeros(1, np.bool_)
    while not dones.any():
        _, _, dones, infos = env.step(np.array([[0, 0, -1.0, 0, 0, 0]]))
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["episode_metrics"]["outcome"] == "collision"


def test_evaluate_policy_uses_true_returns_and_the_expert_reaches():
    """No Monitor warning (an error here); SB3's evaluator runs our expert through a whole episode."""
    from agents.expert import RmpExpert

    env = make_sb3_vec("SealGym/Flat-v0", 2, control="rmp")
    env.seed(500_000)
    rewards, lengths = evaluate_policy(RmpExpert(), env, n_eval_episodes=2, return_episode_rewards=True)
    single, expert = SealEnv(control="rmp"), RmpExpert()
    observation, _ = single.reset(seed=500_000)
    total, steps, done = 0.0, 0, False
    while not done:
        observation, reward, terminated, truncated, _ = single.step(expert.predict(observation)[0])
        total, steps, done = total + reward, steps + 1, terminated or truncated
    k = lengths.index(steps)
    assert rewards[k] == pytest.approx(total, abs=1e-5)


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    [
        ("PPO", {"n_steps": 16, "batch_size": 16, "n_epochs": 1}),
        ("SAC", {"learning_starts": 8, "batch_size": 8}),
    ],
)
def test_algorithms_learn_a_few_steps(algorithm, kwargs):
    env = make_sb3_vec("SealGym/Flat-v0", 2, task=SHORT)
    model = getattr(sb3, algorithm)("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    model.learn(32)
    assert model.num_timesteps >= 32
    assert len(model.ep_info_buffer) >= 2
    assert {"r", "l", "t"} <= set(model.ep_info_buffer[0])


def test_ppo_learns_from_images():
    env = make_sb3_vec("SealGym/Flat-v0", 2, observation="features+images", task=SHORT)
    model = sb3.PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0)
    model.learn(16)
    assert model.num_timesteps == 16


def test_wrappers_of_sb3():
    with pytest.warns(UserWarning, match="already wrapped"):  # it counts episodes itself
        monitored = VecMonitor(SealSb3VecEnv(2, task=SHORT))
    env = VecNormalize(monitored)
    env.reset()
    for k in range(12):
        _, _, dones, infos = env.step(np.zeros((2, 6)))
        assert dones.all() == dones.any() == (k == 8)
        if dones.any():
            assert infos[0]["episode"]["l"] == 9
    assert env.get_attr("render_mode") == [None, None]


def test_attributes_and_methods_of_rows():
    env = make_sb3_vec("SealGym/Flat-v0", 3)
    env.reset()
    env.set_attr("level", 2, indices=[0, 2])
    env.set_attr("level", 5, indices=1)
    assert env.get_attr("level") == [2, 5, 2]
    assert env.get_attr("action_space", 1) == [env.action_space]
    assert env.get_attr("metadata")[0]["render_fps"] == 30
    assert len(set(map(id, env.get_attr("np_random")))) == 3
    with pytest.raises(AttributeError, match="np_random"):
        env.get_attr("nothing")
    env.step(np.zeros((3, 6)))
    assert env.env_method("seconds", indices=[1]) == [pytest.approx(1 / 30)]
    with pytest.raises(AttributeError, match="seconds"):
        env.env_method("fly")
    assert env.env_method("render") == [None] * 3
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.env_is_wrapped(gym.wrappers.TimeLimit, indices=0) == [False]


def test_leaves():
    env = make_sb3_vec("SealGym/Flat-v0", 3, control="rmp")
    env.env_method("add_leaf", print)
    assert env.core.adapter.leaves == [print]  # once, for all rows
    with pytest.raises(ActionError):
        make_sb3_vec("SealGym/Flat-v0").add_leaf(print)


def test_seed_is_used_once_and_reset_goes_on():
    env = make_sb3_vec("SealGym/Flat-v0", 2)
    env.seed(3)
    first, second = env.reset(), env.reset()
    assert (first != second).any(axis=1).all()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), second)


def test_errors():
    with pytest.raises(ConfigError, match=r"SealGym/Flat-v0"):
        make_sb3_vec("SealGym/Sphere-v0", 2)
    with pytest.raises(ConfigError, match=r"SealGym/Flat-v0"):
        make_sb3_vec("CartPole-v1", 2)
    with pytest.raises(ConfigError, match="num_envs"):
        make_sb3_vec("SealGym/Flat-v0", 0)
    with pytest.raises(ConfigError, match="colour"):
        make_sb3_vec("seal_gym:SealGym/Flat-v0", 1, colour="red")
    env = make_sb3_vec("SealGym/Flat-v0", 2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((2, 6)))
    env.set_options({"hover": 1})
    with pytest.raises(ConfigError, match="hover"):
        env.reset()
    env.set_options()
    env.reset()
    with pytest.raises(ActionError):
        env.step(np.zeros((2, 5)))


@pytest.mark.gl
def test_pictures():
    env = make_sb3_vec("SealGym/Flat-v0", 2, render_mode="rgb_array")
    env.reset()
    assert env.render().shape == (720, 1280, 3)
    env.close()
