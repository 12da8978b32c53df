import copy
import json
import pickle
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import policies, sb3_policies
from agents.policies import PolicyFileError
from agents.rollouts import play
from agents.sb3_policies import NetCfg, Scale, put_actor
from agents.train_sb3 import (
    PpoCfg,
    Run,
    SacCfg,
    TrainCfg,
    about_run,
    better,
    config,
    main,
    make_model,
    parse,
    read_about,
    summary,
    training_env,
)
from seal_gym.core.errors import ConfigError
from seal_gym.envs.adapters import CHOLESKY_SCALE
from seal_gym.envs.sb3 import make_sb3_vec
from seal_gym.rmp import cholesky_metric
from seal_gym.tasks.progress import SealTaskCfg

SHORT = SealTaskCfg(time_factor=0.02)


def tiny(algo="ppo", control="tip", **changes):
    return TrainCfg(
        **{
            "steps": 192,
            "round_steps": 64,
            "episodes": 2,
            "net": NetCfg(algo=algo, control=control, hidden=(16,)),
            "ppo": PpoCfg(n_envs=4, rollout=64, batch_size=32, n_epochs=2),
            "sac": SacCfg(n_envs=4, buffer_size=128, batch_size=16, gradient_steps=2, learning_starts=16),
            **changes,
        }
    )


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch):
    """Evaluations end soon: the tests look at what is written, not at how well it seals."""

    def short(env_id, n, **kwargs):
        return make_sb3_vec(env_id, n, **{"task": SHORT, **kwargs})

    monkeypatch.setattr("agents.train_sb3.make_sb3_vec", short)


# -- the network ----------------------------------------------------------------------------------------


def test_inputs_are_relative_to_the_seam_in_natural_units():
    row = torch.zeros(1, 35)
    row[0, 0], row[0, 4] = 1.5, -10.0  # mm, deg
    row[0, 6:10] = torch.tensor([2.0, 4.0, 1.0, 3.0])  # the seam's vx, vz, about x, about z
    row[0, 11:17] = torch.tensor([7.0, 15.0, 4.0, 6.0, 5.0, -2.0])  # the tip's twist
    row[0, 20] = 1e6
    row[0, 23:] = 9.0  # the joints are not looked at
    scaled = Scale()(row)[0]
    np.testing.assert_allclose(scaled[[0, 4]], [0.5, -2.0])
    # vx 7-2, vy 15-10 (nominal), vz 4-4, about x 6-1, about y 5, about z -2-3, all in tens
    np.testing.assert_allclose(scaled[11:17], [0.5, 0.5, 0.0, 0.5, 0.5, -0.5], atol=1e-6)
    assert scaled[20] == 10.0 and len(scaled) == 23


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_the_first_policy_hovers_and_has_a_round_metric(algo):
    cfg = tiny(algo, "rmp")
    model = make_model(cfg, training_env(cfg))
    observation = model.get_env().reset()
    action, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(action[:, :6], 0.0, atol=0.1)
    metric = cholesky_metric(CHOLESKY_SCALE * action[:, 6:].astype(float))
    np.testing.assert_allclose(metric, np.broadcast_to(0.36 * np.eye(6), (4, 6, 6)), atol=0.2)
    noisy = np.stack([model.predict(observation, deterministic=False)[0] for _ in range(200)])
    assert 0.03 < noisy.std(axis=0).mean() < 0.07  # exp(-3) = 0.05
    model.get_env().close()


# -- evaluation -----------------------------------------------------------------------------------------


def by_hand(env_id, seed, **kwargs):
    env = gym.make(env_id, control="rmp", **kwargs)
    policy = agents.load_policy("rmp_expert")
    observation, _ = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        action, _ = policy.predict(observation)
        observation, reward, terminated, truncated, info = env.step(action)
        total, done = total + reward, terminated or truncated
    return info["episode_metrics"], total


def test_an_evaluation_is_one_episode_a_seed_as_a_loop_by_hand_gives_it():
    kwargs = {"perception": "oracle", "task": SHORT}
    venv = make_sb3_vec("SealGym/Cylinder-v0", 3, control="rmp", **kwargs)
    policy = agents.load_policy("rmp_expert")
    for _ in range(2):  # a second evaluation sees the same seeds
        rows = play(policy, venv, 500_007)
        assert [row["seed"] for row in rows] == [500_007, 500_008, 500_009]
        for row in rows:
            metrics, total = by_hand("SealGym/Cylinder-v0", row["seed"], **kwargs)
            assert {k: row[k] for k in metrics} == metrics
            assert row["return"] == pytest.approx(total, abs=1e-5)


def episode(outcome, rmse, **changes):
    row = {name: outcome == name for name in ("reached", "collision", "timeout")}
    return {
        **row,
        "rmse_mm": rmse,
        "rmse_whole_mm": 2.0,
        "coverage_pct": 50.0,
        "time_s": 30.0,
        "return": 1.0,
    } | changes


def test_summary_counts_outcomes_and_averages_rmse_over_those_that_reached():
    rows = [
        episode("reached", 0.2, time_s=20.0),
        episode("reached", 0.4),
        episode("collision", 9.0, **{"return": -3.0}),
        episode("timeout", None),
    ]
    s = summary(rows)
    assert (s["reached_pct"], s["collision_pct"], s["timeout_pct"]) == (50.0, 25.0, 25.0)
    assert s["rmse_mm"] == pytest.approx(0.3) and s["time_s"] == 25.0 and s["return"] == 0.0
    assert summary(rows[2:])["rmse_mm"] is None


def test_the_kept_policy_is_the_surest_then_the_most_exact_then_the_best_paid():
    def row(reached, rmse, paid=0.0):
        return {"reached_pct": reached, "rmse_mm": rmse, "return": paid}

    order = [row(0.0, None, -9.0), row(0.0, None, -5.0), row(90.0, 0.1), row(95.0, 0.9), row(95.0, 0.2)]
    assert better(order[0], None)
    for worse, best in pairwise(order):
        assert better(best, worse) and not better(worse, best) and not better(best, best)


# -- training -------------------------------------------------------------------------------------------


def tensors(out):
    return sb3_policies.read_tensors(out / "checkpoint.safetensors")


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_stopped_run_goes_on_to_the_same_end_to_the_bit(algo, tmp_path, monkeypatch):
    cfg = tiny(algo)
    whole = Run(cfg=cfg, out=tmp_path / "whole", tensorboard=False).train()
    assert [row["step"] for row in whole] == [0, 64, 128, 192]

    calls = []

    def stopping(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return play(*arguments)

    stopped = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr("agents.train_sb3.play", stopping)
        with pytest.raises(KeyboardInterrupt):
            Run(cfg=cfg, out=stopped, tensorboard=False).train()
    assert len(read_about(stopped / "checkpoint.safetensors")["rows"]) == 2
    again = Run(cfg=cfg, out=stopped, tensorboard=False).train()
    clean = [[{k: v for k, v in row.items() if k != "learn_s"} for row in rows] for rows in (whole, again)]
    assert clean[0] == clean[1]
    a, b = tensors(tmp_path / "whole"), tensors(stopped)
    assert a.keys() == b.keys()
    for name, values in a.items():
        torch.testing.assert_close(b[name], values, rtol=0, atol=0)
    # and it did learn something
    first = make_model(cfg, training_env(cfg)).policy.state_dict()
    assert any(not torch.equal(values, a[f"policy/{name}"]) for name, values in first.items())
    lines = (stopped / "evaluations.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == again


def test_training_uses_training_seeds_only(tmp_path, monkeypatch):
    from seal_gym.envs.sb3 import SealSb3VecEnv

    seeds, seed = [], SealSb3VecEnv.seed

    def spy(self, value=None):
        seeds.append((self.num_envs, value))
        return seed(self, value)

    monkeypatch.setattr(SealSb3VecEnv, "seed", spy)
    Run(cfg=tiny(), out=tmp_path, tensorboard=False).train()
    learning = [value for n, value in seeds if n == 4]
    assert len(set(learning)) == 3 and all(value >= 0 and value + 4 <= 500_000 for value in learning)
    assert {value for n, value in seeds if n == 2} == {500_000}


def test_a_folder_with_another_run_is_refused(tmp_path):
    Run(cfg=tiny(steps=64), out=tmp_path, tensorboard=False).train()
    with pytest.raises(ConfigError, match=r"another run: seed = 0 there"):
        Run(cfg=tiny(steps=64, seed=1), out=tmp_path, tensorboard=False).train()


@pytest.mark.parametrize("damage", ["short", "foreign"])
def test_a_broken_checkpoint_is_refused(tmp_path, damage):
    cfg = tiny(steps=64)
    Run(cfg=cfg, out=tmp_path, tensorboard=False).train()
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:-50] if damage == "short" else b"PK\x03\x04")
    with pytest.raises(PolicyFileError, match=r"checkpoint\.safetensors"):
        Run(cfg=cfg, out=tmp_path, tensorboard=False).train()


def test_tensorboard_gets_the_evaluations(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    rows = Run(cfg=tiny(steps=64), out=tmp_path).train()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    seen = [(e.step, e.value) for e in events.Scalars("eval/return")]
    assert seen == [(row["step"], pytest.approx(row["return"])) for row in rows]
    assert "train/loss" in events.Tags()["scalars"]


def test_the_command_line_trains_and_names_what_is_wrong(tmp_path, capsys):
    short = ["--steps", "8192", "--round-steps", "8192", "--episodes", "2", "--no-tensorboard"]
    assert main([*short, "--control", "rmp", "--out", str(tmp_path / "run")]) == 0
    assert "8192 steps: reached 0 %" in capsys.readouterr().out
    policy = sb3_policies.load(tmp_path / "run" / "policy.safetensors")
    assert policy.control == "rmp" and policy.card["training"]["env"] == "SealGym/Flat-v0"
    assert main(["--seed", "500000", "--out", str(tmp_path / "no")]) == 2
    assert "seed = 500000" in capsys.readouterr().err
    cfg = config(parse(["--algo", "sac", "--n-envs", "8", "--out", "x"]))
    assert cfg.net.algo == "sac" and cfg.n_envs == 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "SealGym/Flat-v1"}, "env = 'SealGym/Flat-v1'"),
        ({"perception": "sonar"}, "perception = 'sonar'"),
        ({"steps": 0}, "steps = 0"),
        ({"ppo": PpoCfg(n_envs=3, rollout=64)}, "n_envs = 3"),
    ],
)
def test_wrong_values_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        tiny(**changes)


# -- starting from another network ----------------------------------------------------------------------


class StandIn(nn.Module):
    """As a cloned policy's network: from observations to actions."""

    def __init__(self, actions=6):
        super().__init__()
        self.out = nn.Linear(35, actions)

    def forward(self, observation):
        return 0.01 * self.out(observation)


def test_a_module_becomes_the_mean_of_the_policy():
    cfg = tiny()
    model, module = make_model(cfg, training_env(cfg)), StandIn()
    before = copy.deepcopy(module.state_dict())
    put_actor(model.policy, module)
    rows = np.random.default_rng(0).normal(size=(5, 35)).astype(np.float32)
    weight, bias = (before[f"out.{k}"].numpy() for k in ("weight", "bias"))
    action, _ = model.predict(rows, deterministic=True)
    np.testing.assert_allclose(action, np.clip(0.01 * (rows @ weight.T + bias), -1, 1), atol=1e-6)
    model.learn(64)
    assert not torch.equal(model.policy.actor.out.weight, before["out.weight"])  # it learns ...
    assert torch.equal(module.out.weight, before["out.weight"])  # ... in a copy


@pytest.mark.parametrize("module", [StandIn(27), nn.Linear(23, 6)])
def test_a_module_that_does_not_fit_is_refused(module):
    policy = sb3_policies.build(NetCfg(hidden=(16,)))
    actor = policy.actor
    with pytest.raises(ConfigError, match="the module"):
        put_actor(policy, module)
    assert policy.actor is actor


@pytest.fixture
def clone(tmp_path):
    path = tmp_path / "clone.safetensors"
    policies.save(policies.LearnedPolicy.fresh("neural_control", 0), path, {})
    return path


def test_fine_tuning_starts_at_the_clone_and_first_teaches_the_critic(clone, tmp_path, monkeypatch):
    weights, seen = policies.load(clone).net.state_dict(), []

    def watching(policy, venv, seed):
        seen.append(copy.deepcopy(policy._policy.actor.state_dict()))
        return play(policy, venv, seed)

    monkeypatch.setattr("agents.train_sb3.play", watching)
    cfg = tiny(init=str(clone))
    rows = Run(cfg=cfg, out=tmp_path / "run", tensorboard=False).train()
    for evaluation in (0, 1):  # the first round holds the actor still
        for name, values in weights.items():
            assert torch.equal(seen[evaluation][name], values)
    assert all(not torch.equal(seen[2][name], values) for name, values in weights.items())
    # what is written is a policy of the clone's kind, with the weights of the best evaluation
    tuned = policies.load(tmp_path / "run" / "policy.safetensors")
    best = [row["step"] for row in rows].index(tuned.card["scores"]["step"])
    assert tuned.control == "tip" and tuned.card["training"]["init"] == str(clone)
    for name, values in tuned.net.state_dict().items():
        assert torch.equal(seen[best][name], values)


def test_a_clone_that_cannot_be_the_start_is_refused(clone):
    cfg = tiny(control="rmp", init=str(clone))
    with pytest.raises(ConfigError, match="--control tip"):
        make_model(cfg, training_env(cfg))
    with pytest.raises(ConfigError, match="use --algo ppo"):
        tiny("sac", init=str(clone))


# -- files ----------------------------------------------------------------------------------------------


@pytest.fixture(params=["ppo", "sac"])
def stored(request, tmp_path):
    cfg = NetCfg(algo=request.param, control="rmp", hidden=(8, 8))
    policy = sb3_policies.build(cfg)
    path = tmp_path / "p.safetensors"
    sb3_policies.save(policy, cfg, path, {"control": "rmp", "note": 1})
    return policy, path


def test_a_policy_comes_back_to_the_bit_single_and_vectorised(stored):
    policy, path = stored
    loaded = sb3_policies.load(path)
    assert loaded.control == "rmp" and loaded.card["note"] == 1
    rows = np.random.default_rng(0).normal(size=(4, 35)).astype(np.float32)
    expected, _ = policy.predict(rows, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(rows)[0], expected)
    np.testing.assert_allclose(loaded.predict(rows[1])[0], expected[1], atol=1e-6)
    np.testing.assert_array_equal(loaded.predict({"features": rows})[0], expected)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("the file's code ran",))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-9]), "no safetensors file"),
        (lambda p: p.write_bytes(pickle.dumps(Bomb())), "no safetensors file"),
        (lambda p: p.unlink(), "cannot be read"),
        (lambda p: p.with_suffix(".json").unlink(), r"p\.json .* is missing"),
        (lambda p: p.with_suffix(".json").write_text("{"), "no card"),
        (lambda p: p.with_suffix(".json").write_text('{"format": "x", "net": {}}'), "no card"),
    ],
)
def test_broken_and_foreign_files_are_refused_unread(stored, damage, message):
    _, path = stored
    damage(path)
    with pytest.raises(PolicyFileError, match=message):
        sb3_policies.load(path)


def test_weights_of_another_network_or_not_finite_are_refused(stored):
    _, path = stored
    card = json.loads(path.with_suffix(".json").read_text())
    card["net"]["hidden"] = [9, 8]
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PolicyFileError, match="of shape"):
        sb3_policies.load(path)
    card["net"] = {"hidden": 3}
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(PolicyFileError, match="no description of a network"):
        sb3_policies.load(path)
    cfg = NetCfg(algo="ppo", hidden=(8,))
    other = sb3_policies.build(cfg)
    with torch.no_grad():
        other.log_std[0] = float("nan")
    sb3_policies.save(other, cfg, path, {})
    with pytest.raises(PolicyFileError, match="not finite"):
        sb3_policies.load(path)


def test_a_run_s_card_names_command_and_stack(monkeypatch):
    monkeypatch.setattr("sys.argv", ["train", "--seed", "3"])
    card = about_run(tiny())
    assert card["command"] == "python -m agents.train_sb3 --seed 3"
    assert "ppo" in card["training"] and "sac" not in card["training"]
    assert card["stack"]["gymnasium"] == gym.__version__
