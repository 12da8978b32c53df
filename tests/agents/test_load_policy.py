import zipfile

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, PPO, SAC, TD3

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import policies
from agents.policies import LearnedPolicy, PolicyFileError
from seal_gym.core.errors import ConfigError
from seal_gym.envs.sb3 import make_sb3_vec

NEURAL = ("neural_rmp", "neural_rmp_identity", "neural_control")


def make(control="tip"):
    return gym.make("SealGym/Flat-v0", control=control, perception="oracle")


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """The folder of shipped weights, with a policy of each kind."""
    for kind in NEURAL:
        policies.save(LearnedPolicy.fresh(kind, 1), tmp_path / f"{kind}.safetensors", {"seed": 1})
    monkeypatch.setattr(agents, "WEIGHTS", tmp_path)
    return tmp_path


def test_a_wrong_name_lists_the_right_ones():
    with pytest.raises(
        ConfigError, match=r"policy = 'nerual_rmp': must be one of .*neural_control.*\.zip"
    ) as e:
        agents.load_policy("nerual_rmp")
    assert all(name in str(e.value) for name in (*NEURAL, "rmp_expert"))


@pytest.mark.parametrize("name", NEURAL)
def test_without_weights_the_error_says_how_to_train(name, tmp_path, monkeypatch):
    monkeypatch.setattr(agents, "WEIGHTS", tmp_path)
    with pytest.raises(ConfigError, match=rf"python -m agents\.train_bc --policy {name} --seed 0"):
        agents.load_policy(name)
    assert agents.control_of(name) == ("tip" if name == "neural_control" else "rmp")


@pytest.mark.parametrize("name", NEURAL)
def test_it_acts_in_single_and_vectorised_environments(name, weights):
    control = agents.control_of(name)
    single, vector = make(control), make_sb3_vec("SealGym/Flat-v0", 3, control=control, perception="oracle")
    policy = agents.load_policy(name, single)
    assert policy.control == control
    observation, _ = single.reset(seed=11)
    action, _ = policy.predict(observation)
    assert single.action_space.contains(action)
    vector.seed(11)
    actions, _ = agents.load_policy(name, vector).predict(vector.reset())
    assert actions.shape == (3, *single.action_space.shape)
    np.testing.assert_array_equal(actions[0], action)
    vector.step(actions)
    vector.close()


def test_weights_can_be_loaded_by_their_path(weights):
    path = str(weights / "neural_control.safetensors")
    assert agents.control_of(path) == "tip"
    row = np.zeros(35, np.float32)
    by_path, by_name = (agents.load_policy(n, make()).predict(row)[0] for n in (path, "neural_control"))
    np.testing.assert_array_equal(by_path, by_name)
    with pytest.raises(PolicyFileError, match="cannot be read"):
        agents.load_policy(str(weights / "none.safetensors"))


def test_the_environment_must_fit(weights):
    with pytest.raises(ConfigError, match="acts with control='rmp', the environment has 'tip'"):
        agents.load_policy("neural_rmp", make("tip"))
    with pytest.raises(ConfigError, match="acts with control='tip', the environment has 'rmp'"):
        agents.load_policy(str(weights / "neural_control.safetensors"), make("rmp"))


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
def test_a_model_of_sb3_gives_its_own_actions(algorithm, tmp_path):
    env = make_sb3_vec("SealGym/Flat-v0", 2, control="tip", perception="oracle")
    model = algorithm("MlpPolicy", env, seed=3, device="cpu")
    path = tmp_path / "model.zip"
    model.save(path)
    assert agents.control_of(str(path)) == "tip"
    policy = agents.load_policy(str(path), env)
    observation = env.reset()
    np.testing.assert_array_equal(
        policy.predict(observation)[0], model.predict(observation, deterministic=True)[0]
    )
    assert policy.predict(observation[0])[0].shape == (6,)
    env.close()


def test_the_number_of_actions_or_a_card_says_what_an_sb3_model_controls(tmp_path):
    path = tmp_path / "model.zip"
    PPO("MlpPolicy", make("rmp"), device="cpu").save(path)
    assert agents.load_policy(str(path)).control == "rmp"
    PPO("MlpPolicy", make("joint"), device="cpu").save(path)
    card = tmp_path / "model.json"
    card.write_text('{"control": "joint"}')
    assert agents.load_policy(str(path), make("joint")).control == "joint"
    with pytest.raises(ConfigError, match="acts with control='joint', the environment has 'tip'"):
        agents.load_policy(str(path), make("tip"))
    for text in ("{", "[]", '{"control": "wheels"}'):
        card.write_text(text)
        with pytest.raises(PolicyFileError, match=r"model\.json"):
            agents.load_policy(str(path))


def test_damaged_or_foreign_zips_are_refused(tmp_path):
    path = tmp_path / "model.zip"
    with pytest.raises(PolicyFileError, match="cannot be read"):
        agents.load_policy(str(path))
    PPO("MlpPolicy", make(), device="cpu").save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(PolicyFileError, match=r"no model that Stable-Baselines3 saved, or a damaged one"):
        agents.load_policy(str(path))
    for content, message in ((b"[]", "no model"), (b"{}", "actions of shape None"), (b"\xff", "no model")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data", content)
        with pytest.raises(PolicyFileError, match=message):
            agents.load_policy(str(path))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", b'{"action_space": {"_shape": [6]}}')
    with pytest.raises(PolicyFileError, match="is of none of"):
        agents.load_policy(str(path))
