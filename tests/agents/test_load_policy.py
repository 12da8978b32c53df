import base64
import io
import json
import pickle
import shutil
import subprocess
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import policies, sb3_policies
from agents.policies import LearnedPolicy, PolicyFileError
from agents.sb3_policies import NetCfg
from seal_gym.core.errors import ConfigError
from seal_gym.envs import vector as vector_face
from seal_gym.envs.sb3 import make_sb3_vec

KINDS = ("neural_rmp", "neural_rmp_identity", "neural_control")
DAGGER = ("neural_rmp_dagger", "neural_control_dagger")
NEURAL = (*KINDS, *DAGGER)


def make(control="tip"):
    return gym.make("SealGym/Flat-v0", control=control, perception="oracle")


@pytest.mark.parametrize("module", ["agents", "agents.backend", "experiments.backend"])
def test_mujoco_is_imported_after_its_backend_can_be_chosen(module):
    """``python -m agents.enjoy`` imports the package first, and MuJoCo reads ``MUJOCO_GL`` once."""
    code = f"import sys, {module}; print([m for m in ('mujoco', 'torch') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """The folder of shipped weights, with a policy of each kind."""
    for name in NEURAL:
        kind = name.removesuffix("_dagger")
        policies.save(LearnedPolicy.fresh(kind, len(name)), tmp_path / f"{name}.safetensors", {"seed": 1})
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
    kind = name.removesuffix("_dagger")
    rounds = " --dagger 3 --dagger-episodes 50 --dagger-epochs 6" if name in DAGGER else ""
    with pytest.raises(ConfigError, match=rf"agents\.train_bc --policy {kind} --seed 0{rounds} --data") as e:
        agents.load_policy(name)
    assert f"there as {name}.safetensors" in str(e.value)
    assert agents.control_of(name) == ("tip" if kind == "neural_control" else "rmp")


@pytest.mark.parametrize("name", NEURAL)
def test_weights_of_another_kind_are_refused(name, weights):
    other = "neural_control" if "rmp" in name else "neural_rmp"
    for suffix in (".safetensors", ".json"):
        shutil.copy(weights / f"{other}{suffix}", weights / f"{name}{suffix}")
    with pytest.raises(
        PolicyFileError, match=rf"of kind '{other}': must be '{name.removesuffix('_dagger')}'"
    ):
        agents.load_policy(name)


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


def test_a_policy_that_senses_is_mounted_in_its_environment():
    single, vector = make(), make_sb3_vec("SealGym/Flat-v0", 2, control="tip", perception="oracle")
    assert agents.control_of("adaptive") == "tip"
    vector.seed(12)
    observation = vector.reset()
    actions, state = agents.load_policy("adaptive", vector).predict(observation, None, np.ones(2, np.bool_))
    action, _ = agents.load_policy("adaptive", single).predict(single.reset(seed=12)[0])
    np.testing.assert_array_equal(action, actions[0])
    assert actions.shape == (2, 6)
    assert len(state) == 2
    assert single.action_space.contains(action)
    # It goes by its own sensor: without the cameras' features (rows 0-9) it does the same.
    dark = np.where(np.arange(35) < 10, 0.0, observation).astype(np.float32)
    blindfold, _ = agents.load_policy("adaptive", vector).predict(dark)
    np.testing.assert_array_equal(blindfold, actions)
    vector.close()


def test_a_policy_that_senses_is_mounted_in_gymnasiums_vector(monkeypatch):
    if gym.__version__.startswith("0."):  # users are refused there, though the numbers are the same
        monkeypatch.setattr(vector_face, "require_gymnasium_1", lambda: None)
        monkeypatch.setattr(gym.vector.VectorEnv, "viewer", None, raising=False)
    venv, single = vector_face.SealVectorEnv(2, control="tip", perception="oracle"), make()
    actions, _ = agents.load_policy("adaptive", venv).predict(venv.reset(seed=12)[0])
    action, _ = agents.load_policy("adaptive", single).predict(single.reset(seed=12)[0])
    np.testing.assert_array_equal(actions[0], action)
    venv.close()


def test_a_policy_that_senses_needs_its_environment():
    with pytest.raises(ConfigError, match=r"load_policy\('adaptive', env\)"):
        agents.load_policy("adaptive")
    with pytest.raises(ConfigError, match="acts with control='tip', the environment has 'rmp'"):
        agents.load_policy("adaptive", make("rmp"))


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


def test_weights_of_train_sb3_can_be_loaded_by_their_path(tmp_path):
    cfg, path = NetCfg(algo="ppo", control="rmp", hidden=(8,)), tmp_path / "policy.safetensors"
    net = sb3_policies.build(cfg)
    sb3_policies.save(net, cfg, path, {})
    assert agents.control_of(str(path)) == "rmp"
    row = np.random.default_rng(0).normal(size=(2, 35)).astype(np.float32)
    action, _ = agents.load_policy(str(path), make("rmp")).predict(row)
    np.testing.assert_array_equal(action, net.predict(row, deterministic=True)[0])


# -- models that Stable-Baselines3 saved --------------------------------------------------------------------


@pytest.mark.parametrize("trust", [False, True])
@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
def test_a_model_of_sb3_gives_its_own_actions(algorithm, trust, tmp_path):
    env = make_sb3_vec("SealGym/Flat-v0", 2, control="tip", perception="oracle")
    model = algorithm("MlpPolicy", env, seed=3, device="cpu")
    path = tmp_path / "model.zip"
    model.save(path)
    assert agents.control_of(str(path)) == "tip"
    policy = agents.load_policy(str(path), env, trust_zip=trust)
    observation = env.reset()
    actions, _ = policy.predict(observation)
    np.testing.assert_array_equal(actions, model.predict(observation, deterministic=True)[0])
    assert np.abs(actions).max() > 1e-3  # two zeros would be equal too
    assert policy.predict(observation[0])[0].shape == (6,)
    env.close()


@pytest.mark.parametrize(
    "kwargs",
    [
        {"net_arch": [16]},
        {"net_arch": {"pi": [8, 8], "vf": [4]}, "activation_fn": torch.nn.ELU},
        {"activation_fn": torch.nn.ReLU, "log_std_init": -2.0, "ortho_init": False},
    ],
)
def test_any_plain_network_is_built_anew(kwargs, tmp_path):
    model, path = PPO("MlpPolicy", make(), seed=3, device="cpu", policy_kwargs=kwargs), tmp_path / "model.zip"
    model.save(path)
    rows = np.random.default_rng(0).normal(size=(5, 35)).astype(np.float32)
    actions, _ = agents.load_policy(str(path)).predict(rows)
    np.testing.assert_array_equal(actions, model.predict(rows, deterministic=True)[0])


class Squared(torch.nn.Module):
    """An activation of the user's own."""

    def forward(self, x):
        return x * x


@pytest.mark.parametrize(
    ("env_kwargs", "model_kwargs", "why"),
    [
        ({}, {"policy_kwargs": {"activation_fn": Squared}}, "its activation is .*Squared"),
        (
            {},
            {"policy_kwargs": {"squash_output": False, "full_std": True}},
            "policy_kwargs have 'squash",
        ),
        ({}, {"use_sde": True}, "gSDE"),
        ({"observation": "features+images"}, {"policy": "MultiInputPolicy"}, "is not PPO's MlpPolicy"),
    ],
)
def test_what_cannot_be_built_anew_asks_for_trust(env_kwargs, model_kwargs, why, tmp_path):
    env = gym.make("SealGym/Flat-v0", perception="oracle", **env_kwargs)
    path = tmp_path / "model.zip"
    PPO(**{"policy": "MlpPolicy", "env": env, "device": "cpu", "n_steps": 64, **model_kwargs}).save(path)
    with pytest.raises(PolicyFileError, match=rf"{why}.*agents\.train_sb3.*trust_zip=True"):
        agents.load_policy(str(path))
    assert agents.load_policy(str(path), trust_zip=True).control == "tip"


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return exec, (f"open({str(self.path)!r}, 'w').close()",)


def with_entries(path, **entries):
    """Rewrites entries of a zip."""
    with zipfile.ZipFile(path) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**held, **entries}.items():
            archive.writestr(name, data)


def bombed_description(path, bomb, *names):
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    charge = base64.b64encode(pickle.dumps(bomb)).decode()
    for name in names:
        entry = data[name] if isinstance(data[name], dict) else {":type:": "<class 'object'>"}
        data[name] = {**entry, ":serialized:": charge}
    return json.dumps(data).encode()


def test_nothing_in_a_malicious_zip_runs(tmp_path):
    path, mark = tmp_path / "model.zip", tmp_path / "it_ran"
    PPO("MlpPolicy", make(), device="cpu").save(path)
    with zipfile.ZipFile(path) as archive:
        names = json.loads(archive.read("data")).keys()
    spread = ("policy_class", "policy_kwargs", "observation_space", "action_space", "lr_schedule", "seed")
    assert set(spread) <= set(names)
    bomb = Bomb(mark)
    with_entries(path, data=bombed_description(path, bomb, *spread))
    agents.control_of(str(path))
    agents.load_policy(str(path), make())  # its parameters and its plain text are sound
    assert not mark.exists()

    for charge in (pickle.dumps(bomb), torch_file({"log_std": bomb}), torch_file(bomb)):
        with_entries(path, **{"policy.pth": charge, "pytorch_variables.pth": charge})
        with pytest.raises(PolicyFileError, match="its parameters are damaged, or hold more than tensors"):
            agents.load_policy(str(path), make())
        assert not mark.exists()

    pickle.loads(pickle.dumps(bomb))  # the bomb is no dud
    assert mark.exists()


def test_a_trusted_zip_is_stable_baselines3s_to_load(tmp_path):
    """What ``trust_zip`` warns of is true: the code in the file runs."""
    path, mark = tmp_path / "model.zip", tmp_path / "it_ran"
    PPO("MlpPolicy", make(), device="cpu").save(path)
    with_entries(path, data=bombed_description(path, Bomb(mark), "seed"))
    agents.load_policy(str(path), trust_zip=True)
    assert mark.exists()


def torch_file(content):
    data = io.BytesIO()
    torch.save(content, data)
    return data.getvalue()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "damaged"),
        (b"not a zip", "damaged"),
        (torch_file([torch.zeros(2)]), "no tensors by name"),
        (torch_file({"log_std": 3.0}), "no tensors by name"),
        (torch_file({"log_std": torch.zeros(6)}), "are missing"),
    ],
)
def test_damaged_parameters_are_refused(content, message, tmp_path):
    path = tmp_path / "model.zip"
    PPO("MlpPolicy", make(), device="cpu").save(path)
    with_entries(path, **{"policy.pth": content})
    with pytest.raises(PolicyFileError, match=message):
        agents.load_policy(str(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("policy_kwargs", {"net_arch": "wide"}), "cannot be built|other tensors"),
        (("policy_kwargs", {"net_arch": [7]}), "must be torch|other tensors"),
        (("policy_kwargs", {"net_arch": [[[]]]}), "cannot be built"),
        (("policy_class", None), "is not PPO's MlpPolicy"),
        (("observation_space", {"_shape": [36]}), "does not take the 35 features alone"),
        (("action_space", {"_shape": [6], "low": "[-2. -2.]", "high": "[2. 2.]"}), "its actions end at"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused(change, message, tmp_path):
    path = tmp_path / "model.zip"
    PPO("MlpPolicy", make(), device="cpu").save(path)
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    data[change[0]] = change[1]
    with_entries(path, data=json.dumps(data))
    with pytest.raises(PolicyFileError, match=message):
        agents.load_policy(str(path))


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
