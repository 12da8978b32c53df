import json
import sys
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from agents import policies, rollouts, train_bc
from agents.expert import RmpExpert
from agents.policies import KINDS, PolicyFileError
from agents.rollouts import Episode, Labeller
from agents.train_bc import DaggerCfg, TrainCfg, Trainer, loss, split, train
from seal_gym.core.errors import ConfigError
from seal_gym.envs.sb3 import SealSb3VecEnv

ORACLE = DaggerCfg(rounds=1, episodes=1, epochs=2, perception="oracle")


@pytest.fixture(scope="module")
def episodes():
    """The expert's own, cut short: two on each part."""
    rolled = [
        e
        for part in ("flat", "cylinder")
        for e in rollouts.roll(RmpExpert(), workpiece=part, seed=7, episodes=2, perception="oracle")
    ]
    return [Episode(*(rows[:250] for rows in e)) for e in rolled]


def cfg(kind="neural_rmp", **values):
    return TrainCfg(**{"kind": kind, "epochs": 6, "batch": 128, **values})


def weights(policy):
    return policy.net.state_dict()


def assert_same(one, other):
    for name, value in weights(one).items():
        assert torch.equal(value, weights(other)[name]), name


# -- labels ---------------------------------------------------------------------------------------------


def test_both_labels_move_the_gun_alike():
    # The simulator is the judge: the tip label in one environment, the rmp label in another.
    envs = {c: SealSb3VecEnv(2, workpiece="cylinder", control=c, perception="oracle") for c in ("tip", "rmp")}
    seen, label = {}, {c: Labeller(env.core) for c, env in envs.items()}
    for control, env in envs.items():
        env.seed(3)
        seen[control] = env.reset()
    for _ in range(40):
        for k, control in enumerate(("tip", "rmp")):
            seen[control], *_ = envs[control].step(label[control](seen[control])[k])
        np.testing.assert_allclose(seen["tip"], seen["rmp"], rtol=1e-3, atol=2e-3)
    assert np.abs(seen["rmp"][:, 11:14]).max() > 5.0  # mm/s: something did move
    for env in envs.values():
        env.close()


def test_labels_are_the_experts_at_each_state(episodes):
    for episode in episodes:
        assert len(episode.observations) == len(episode.tip) == len(episode.rmp)
        np.testing.assert_array_equal(RmpExpert().predict(episode.observations)[0], episode.rmp)


def test_a_roll_repeats_and_follows_the_seed(episodes):
    again = rollouts.roll(RmpExpert(), workpiece="flat", seed=7, episodes=1, perception="oracle")[0]
    np.testing.assert_array_equal(again.observations[:250], episodes[0].observations)
    # The whole seam of 300 mm at 10 mm/s and 30 frames/s takes about 900.
    assert 850 < len(again.tip) < 1000


def test_the_expert_takes_its_share_of_the_frames():
    still = SimpleNamespace(control="rmp", predict=lambda o, **_: (np.zeros((len(o), 27), np.float32), None))
    arguments = {"workpiece": "flat", "seed": 7, "episodes": 1, "perception": "oracle"}
    expert = rollouts.roll(RmpExpert(), **arguments)[0]
    all_its_own = rollouts.roll(still, **arguments, expert_share=1.0)[0]
    np.testing.assert_array_equal(all_its_own.observations, expert.observations)


def test_scores_of_the_expert_and_of_one_that_does_nothing():
    good = rollouts.score(RmpExpert(), workpiece="cylinder", trials=2, perception="oracle")
    assert (good["trials"], good["reached"], good["collision"], good["timeout"]) == (2, 2, 0, 0)
    assert good["rmse_mm"] < 0.05
    still = SimpleNamespace(control="tip", predict=lambda o: (np.zeros((len(o), 6), np.float32), None))
    bad = rollouts.score(still, workpiece="cylinder", trials=1, perception="oracle")
    assert (bad["reached"], bad["timeout"], bad["rmse_mm"]) == (0, 1, None)


def test_joint_policies_cannot_be_labelled():
    joint = SimpleNamespace(control="joint")
    with pytest.raises(ConfigError, match="must be 'tip' or 'rmp'"):
        rollouts.roll(joint, workpiece="flat", seed=0, episodes=1)


# -- loss and split -------------------------------------------------------------------------------------


def test_the_loss_by_hand():
    prediction = torch.tensor([[0.5, 3.0, -3.0, 3.0]])
    label = torch.tensor([[0.1, 1.0, -1.0, -1.0]])
    # Beyond a clipped label nothing is wrong; short of it or on the other side it is.
    assert float(loss(prediction, label)) == pytest.approx((0.4**2 + 4.0**2) / 4)
    assert float(loss(torch.tensor([[0.8]]), torch.tensor([[1.0]]))) == pytest.approx(0.04)
    assert float(loss(prediction, label, 2)) == pytest.approx(0.4**2 / 2)  # the first two entries only


def numbered(n):
    return [
        Episode(
            np.full((3, 35), k, np.float32), np.full((3, 6), k, np.float32), np.full((3, 27), k, np.float32)
        )
        for k in range(n)
    ]


@pytest.mark.parametrize(("n", "out"), [(2, 1), (9, 1), (10, 1), (29, 2), (60, 6)])
def test_one_episode_in_ten_is_held_out_whole(n, out):
    for control, width in (("tip", 6), ("rmp", 27)):
        data = split(numbered(n), control)
        train_on, held = (set(part[1][:, 0].int().tolist()) for part in (data.train, data.held_out))
        assert len(held) == out
        assert train_on | held == set(range(n))
        assert not train_on & held
        assert data.train[1].shape == (3 * (n - out), width)
        for observations, actions in (data.train, data.held_out):
            assert torch.equal(observations[:, 0], actions[:, 0])


def test_what_is_held_out_stays_so_and_is_the_same_for_every_kind():
    def held(n, control):
        return set(split(numbered(n), control).held_out[1][:, 0].int().tolist())

    assert held(30, "tip") == held(30, "rmp")
    assert held(20, "tip") < held(35, "tip")


def test_data_are_checked():
    with pytest.raises(ConfigError, match="1 episodes: at least 2"):
        split(numbered(1), "tip")
    broken = numbered(3)
    broken[1].tip[0, 0] = np.nan
    split(broken, "rmp")
    with pytest.raises(ConfigError, match="not finite"):
        split(broken, "tip")


# -- training -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_training_reduces_the_loss(kind, episodes, tmp_path):
    trainer = Trainer(cfg(kind), split(episodes, cfg(kind).control), tmp_path)
    before = trainer._validate()
    policy = trainer.run(progress=False)
    assert len(trainer.history) == 6
    assert trainer.history[-1][1] < 0.2 * before
    assert trainer._validate() == min(held for _, held in trainer.history)  # the best epoch's weights
    error = policy.predict(episodes[0].observations)[0] - getattr(episodes[0], cfg(kind).control)
    assert np.sqrt(np.mean(error[:, :6] ** 2)) < 0.05
    assert list(tmp_path.glob("tensorboard/events*"))


@pytest.mark.parametrize("kind", ["neural_rmp", "neural_control"])
def test_a_killed_run_goes_on_to_the_same_bits(kind, episodes, tmp_path):
    data = split(episodes, cfg(kind).control)
    whole = Trainer(cfg(kind), data, tmp_path / "whole")
    whole.run(progress=False)
    for epochs in (2, 3):  # killed twice; the first time half-way through a write as well
        killed = Trainer(cfg(kind), data, tmp_path / "killed")
        for _ in range(epochs - len(killed.history)):
            killed.epoch()
        (tmp_path / "killed" / "checkpoint.safetensors.partial").write_bytes(b"half")
    resumed = Trainer(cfg(kind), data, tmp_path / "killed")
    assert len(resumed.history) == 3
    resumed.run(progress=False)
    assert resumed.history == whole.history
    assert_same(resumed.policy, whole.policy)
    again = Trainer(cfg(kind), data, tmp_path / "killed")
    assert again.done
    assert_same(again.run(progress=False), whole.policy)


def test_seeds_differ_and_repeat(episodes, tmp_path):
    data = split(episodes, "rmp")
    one, same, other = (
        Trainer(cfg(epochs=1, seed=seed), data, tmp_path / name).run(progress=False)
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    assert_same(one, same)
    assert not torch.equal(weights(one)["linear.weight"], weights(other)["linear.weight"])


def test_a_checkpoint_of_another_run_is_refused(episodes, tmp_path):
    data = split(episodes, "rmp")
    Trainer(cfg(), data, tmp_path).epoch()
    for other, seen in ((cfg(seed=1), data), (cfg(batch=64), data), (cfg(), split(episodes[:3], "rmp"))):
        with pytest.raises(ConfigError, match="is of another run"):
            Trainer(other, seen, tmp_path)


def test_a_damaged_checkpoint_is_refused(episodes, tmp_path):
    data, path = split(episodes, "rmp"), tmp_path / "checkpoint.safetensors"
    Trainer(cfg(), data, tmp_path).epoch()
    whole = path.read_bytes()
    for part in (b"", whole[:100], whole[:-1], b"\x80\x04" + whole[2:]):
        path.write_bytes(part)
        with pytest.raises(PolicyFileError, match="damaged"):
            Trainer(cfg(), data, tmp_path)


def test_the_rule_of_early_stopping(episodes, tmp_path):
    history = [(0.0, held) for held in (1.0, 0.995, 0.98, 0.985, 0.975, 0.971, 0.970)]
    assert train_bc._last_progress(history[:2]) == 1  # half a percent is none
    assert train_bc._last_progress(history[:4]) == 3
    assert train_bc._last_progress(history) == 7  # 0.970 is 1 % below the 0.98 of epoch 3
    trainer = Trainer(cfg(epochs=50, patience=4), split(episodes, "rmp"), tmp_path)
    trainer.history = [(0.0, held) for held in (1.0, 0.5, 0.6, 0.6, 0.6)]
    assert not trainer.done
    trainer.history.append((0.0, 0.499))
    assert trainer.done


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "rmp"}, "kind = 'rmp'"),
        ({"epochs": 0}, "epochs = 0: .*>= 1"),
        ({"seed": -1}, "seed = -1"),
        ({"learning_rate": 0.0}, "learning_rate = 0.0"),
    ],
)
def test_options_are_checked(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(cfg(), **change)
    with pytest.raises(ConfigError, match="rounds = 10"):
        DaggerCfg(rounds=10)
    with pytest.raises(ConfigError, match="perception = 'eyes'"):
        DaggerCfg(perception="eyes")


# -- DAgger ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["neural_rmp", "neural_control"])
def test_dagger_learns_from_what_the_policy_meets(kind, episodes, tmp_path, monkeypatch):
    rolled = []
    inner = rollouts.roll

    def roll(policy, **kwargs):
        new = inner(policy, **kwargs)
        rolled.append((policy.control, kwargs["workpiece"], kwargs["seed"]))
        return [Episode(*(rows[:100] for rows in e)) for e in new]

    monkeypatch.setattr(rollouts, "roll", roll)
    policy, card = train(cfg(kind), episodes, tmp_path / "a", ORACLE, progress=False)
    assert [r[:2] for r in rolled] == [(policy.control, "flat"), (policy.control, "cylinder")]
    seeds = {r[2] for r in rolled}
    assert len(seeds) == 2
    assert max(seeds) < 500_000  # protocol.md: training seeds
    # Run again: nothing is rolled twice, and the same weights come out.
    again, same = train(cfg(kind), episodes, tmp_path / "a", ORACLE, progress=False)
    assert len(rolled) == 2
    assert_same(policy, again)
    assert card == same
    first = Trainer(cfg(kind), split(episodes, policy.control), tmp_path / "a" / "round-0").run(False)
    assert not torch.equal(weights(first)["linear.weight"], weights(policy)["linear.weight"])
    with pytest.raises(ConfigError, match="is of another run"):
        train(cfg(kind), episodes, tmp_path / "a", replace(ORACLE, episodes=2), progress=False)


# -- the command ----------------------------------------------------------------------------------------


def test_the_command_writes_a_policy_that_loads(episodes, tmp_path, monkeypatch, capsys):
    lengths = np.cumsum([0] + [len(e.tip) for e in episodes])
    stacked = Episode(*(np.concatenate(rows) for rows in zip(*episodes, strict=True)))
    data = SimpleNamespace(
        observations=stacked.observations,
        actions=lambda control: getattr(stacked, control),
        episodes=list(pairwise(lengths)),
    )
    monkeypatch.setitem(sys.modules, "agents.demos", SimpleNamespace(load=lambda _: data))
    options = [
        "--policy",
        "neural_control",
        "--seed",
        "4",
        "--data",
        "D",
        "--out",
        str(tmp_path),
        "--epochs",
        "2",
    ]
    train_bc.main([*options, "--validate", "1", "--perception", "oracle"])
    path = tmp_path / "neural_control-seed4.safetensors"
    assert str(path) in capsys.readouterr().out
    policy = policies.load(path)
    assert policy.control == "tip"
    card = policy.card
    assert card["command"].startswith("python -m agents.train_bc --policy neural_control --seed 4")
    assert (card["seed"], card["data"], card["train"]["epochs"]) == (4, "D", 2)
    assert (
        card["stack"]["torch"] == torch.__version__.split("+")[0]
        or card["stack"]["torch"] == torch.__version__
    )
    assert set(card["validation"]) == {"flat", "cylinder"}  # the rectangular part has no say
    assert card["validation"]["flat"]["trials"] == 1
    json.dumps(card)
