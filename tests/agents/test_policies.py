import hashlib
import json
import pickle
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load as read_tensors
from safetensors.torch import save as write_tensors

from agents import policies
from agents.expert import RmpExpert
from agents.policies import KINDS, LearnedPolicy, PolicyCfg, PolicyFileError, group_inputs
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.envs.adapters import CHOLESKY_SCALE
from seal_gym.envs.sb3 import SealSb3VecEnv
from seal_gym.rmp import cholesky_metric

LARGEST = np.array(
    [100, 180, 1, 100, 180, 1, *[1e3] * 4, 180, *[5e3] * 3, *[2e3] * 3, *[50] * 3, *[500] * 3, *[10] * 12]
)


def observation(**values):
    """Features of a tip on the seam at nominal speed, with changes by index."""
    row = np.zeros(35, np.float32)
    row[[2, 5]] = 1.0
    row[12] = 10.0
    for name, value in values.items():
        row[int(name[1:])] = value
    return row


def observations(rng, n, seen=True):
    """From small to the bounds of the space."""
    size = 10.0 ** rng.uniform(-3, 0, (n, 1))
    rows = (LARGEST * size * rng.uniform(-1, 1, (n, 35))).astype(np.float32)
    rows[:, [2, 5]] = seen
    return rows


def wild(kind, seed, factor=30.0):
    """A network with weights that no training would give."""
    policy = LearnedPolicy.fresh(kind, seed)
    with torch.no_grad():
        for parameter in policy.net.parameters():
            parameter.mul_(factor).add_(torch.randn_like(parameter))
    return policy


def leading_minors(matrix):
    """Exact, of a matrix of Fractions; Sylvester: positive definite if and only if all are positive."""
    rows, minors, product = [list(r) for r in matrix], [], Fraction(1)
    for k in range(len(rows)):
        product *= rows[k][k]
        minors.append(product)
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return minors


def exact_metric(entries):
    lower, k = [[Fraction(0)] * 6 for _ in range(6)], 0
    for i in range(6):
        for j in range(i + 1):
            lower[i][j] = Fraction(float(entries[k])) * Fraction(CHOLESKY_SCALE)
            k += 1
    return [[sum(a * b for a, b in zip(p, q, strict=True)) for q in lower] for p in lower]


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_the_metric_is_positive_definite_for_any_weights_and_input(seed, seen):
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    actions, _ = wild("neural_rmp", seed).predict(observations(rng, 10, seen))
    for action in actions:
        assert np.isfinite(action).all()
        assert np.abs(action).max() <= 1.0
        assert action[[6, 8, 11, 15, 20, 26]].min() > 0  # the factor's diagonal: one factor for one metric
        exact = exact_metric(action[6:])
        assert min(leading_minors(exact)) > 0
        # ... and it is the matrix that the environment makes of the action.
        decoded = cholesky_metric(CHOLESKY_SCALE * action[6:].astype(float))
        np.testing.assert_allclose(
            decoded, [[float(x) for x in row] for row in exact], rtol=1e-12, atol=1e-15
        )


def test_the_ablation_has_the_identity_as_its_metric():
    torch.manual_seed(0)
    actions, _ = wild("neural_rmp_identity", 0).predict(observations(np.random.default_rng(0), 5))
    for action in actions:
        np.testing.assert_array_equal(cholesky_metric(CHOLESKY_SCALE * action[6:].astype(float)), np.eye(6))


def test_kinds_have_the_same_number_of_parameters_within_5_percent():
    counts = {kind: LearnedPolicy.fresh(kind, 0).parameters for kind in KINDS}
    # By hand for neural_rmp: extractors of 2, 2, 6 and 1 inputs; regressor 64-64-64-27; linear path 11 x 6.
    extractors = sum(n * 16 + 16 + 16 * 16 + 16 for n in (2, 2, 6, 1))
    assert counts["neural_rmp"] == extractors + 2 * (64 * 64 + 64) + 64 * 27 + 27 + 66
    for kind, count in counts.items():
        assert abs(count / counts["neural_rmp"] - 1.0) < 0.05, kind


def test_inputs_by_hand():
    row = observation(i0=1.0, i1=-5.0, i3=4.0, i4=2.5, i6=3.0, i7=-1.0, i8=8.0, i9=-20.0, i10=1.0)
    row[11:17] = 5.0, 14.0, -3.0, 18.0, 2.0, 20.0
    inputs = group_inputs(torch.from_numpy(row[None]), 0.010)[0].numpy()
    motion = [(5 - 3) / 10, (14 - 10) / 10, (-3 + 1) / 10, (18 - 8) / 20, 2 / 20, (20 + 20) / 20]
    np.testing.assert_allclose(inputs, [0.5, -1.0, 2.0, 0.5, *motion, 0.2], atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_where_the_part_stands_says_nothing(kind):
    torch.manual_seed(1)
    policy, row = wild(kind, 1, factor=1.0), observation(i0=1.0, i4=2.0)
    moved = row.copy()
    moved[17:] = np.random.default_rng(2).normal(size=18)
    np.testing.assert_array_equal(policy.predict(row)[0], policy.predict(moved)[0])


@pytest.mark.parametrize("kind", KINDS)
def test_single_and_batch_agree_to_the_bit(kind):
    torch.manual_seed(3)
    policy, rows = wild(kind, 3, factor=1.0), observations(np.random.default_rng(3), 33)
    rows[::4, 2] = 0.0
    batch, state = policy.predict(rows, state="kept")
    assert state == "kept"
    assert batch.dtype == np.float32
    for row, action in zip(rows, batch, strict=True):
        single, _ = policy.predict(row)
        assert single.shape == ((6,) if kind == "neural_control" else (27,))
        np.testing.assert_array_equal(single, action)
    np.testing.assert_array_equal(policy.predict({"features": rows})[0], batch)


def test_a_wrong_observation_is_refused():
    with pytest.raises(ConfigError, match=r"shape \(23,\): must be \(35,\)"):
        LearnedPolicy.fresh("neural_rmp", 0).predict(np.zeros(23, np.float32))


def test_the_seed_decides_the_weights_and_leaves_the_global_generator_alone():
    before = torch.random.get_rng_state()
    one, same, other = (LearnedPolicy.fresh("neural_rmp", seed) for seed in (5, 5, 6))
    assert torch.equal(before, torch.random.get_rng_state())
    for name, value in one.net.state_dict().items():
        assert torch.equal(value, same.net.state_dict()[name])
    assert not torch.equal(next(one.net.parameters()), next(other.net.parameters()))


def test_gradients_through_the_cholesky_factor_match_finite_differences():
    # d/db of <M, A>, where A = L L^T is the environment's own decoding, for each bias b of the last layer.
    rng, policy = np.random.default_rng(4), LearnedPolicy.fresh("neural_rmp", 4)
    net, weight = policy.net.double(), rng.normal(size=(6, 6))
    row = torch.from_numpy(observation(i0=1.5, i1=-3.0, i14=9.0)[None].astype(np.float64))
    bias = net.regressor[-1].bias
    rows, columns = np.tril_indices(6)
    lower = torch.zeros(6, 6, dtype=torch.float64)
    lower = lower.index_put(
        (torch.from_numpy(rows), torch.from_numpy(columns)), CHOLESKY_SCALE * net(row)[0, 6:]
    )
    (torch.from_numpy(weight) * (lower @ lower.T)).sum().backward()

    def value():
        with torch.no_grad():
            return float((weight * cholesky_metric(CHOLESKY_SCALE * net(row)[0, 6:].numpy())).sum())

    for k in range(27):
        values = []
        for step in (1e-6, -2e-6):
            with torch.no_grad():
                bias[k] += step
            values.append(value())
        with torch.no_grad():
            bias[k] += 1e-6
        assert (values[0] - values[1]) / 2e-6 == pytest.approx(float(bias.grad[k]), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_lost_view_stops_the_gun(kind):
    # Stale features of a seam far away: whoever believed them would chase it.
    torch.manual_seed(6)
    policy = wild(kind, 6, factor=1.0)
    env = SealSb3VecEnv(3, workpiece="cylinder", control=policy.control, perception="oracle")
    env.seed(0)
    seen, forward = env.reset(), np.zeros((3, 6), np.float32)
    forward[:, 1] = 0.1
    for _ in range(5):
        seen, *_ = env.step(forward if policy.control == "tip" else RmpExpert().predict(seen)[0])
    assert np.linalg.norm(seen[:, 11:14], axis=1).min() > 1.0
    speeds = []
    for k in range(60):
        stale = seen.copy()
        stale[:, :10] = [9.0, 20.0, k % 3 == 0, -9.0, 20.0, k % 3 == 1, 0.0, 0.0, 0.0, 0.0]
        seen, *_ = env.step(policy.predict(stale)[0])
        speeds.append(np.linalg.norm(seen[:, 11:14], axis=1).max())
    env.close()
    assert speeds[-1] < 0.05  # mm/s


def test_it_refuses_another_cell():
    cell = load_cell()
    other = replace(cell, limits=replace(cell.limits, linear_m_s2=2.0))
    policy = LearnedPolicy.fresh("neural_control", 0)
    policy.check_cell(cell)
    with pytest.raises(ConfigError, match=r"linear_m_s2 = 1.0, the cell has 2.0: train"):
        policy.check_cell(other)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "rmp"}, r"kind = 'rmp': must be one of \['neural_rmp'"),
        ({"kind": "neural_rmp", "hidden": 0}, r"hidden = 0: .*1\.\.1024"),
        ({"kind": "neural_rmp", "extracted": 2.5}, "extracted = 2.5"),
        ({"kind": "neural_rmp", "speed_m_s": float("nan")}, "speed_m_s = nan"),
    ],
)
def test_configurations_are_checked(values, message):
    with pytest.raises(ConfigError, match=message):
        PolicyCfg(**values)


# -- files ----------------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "policy.safetensors"
    policies.save(LearnedPolicy.fresh("neural_rmp", 7), path, {"seed": 7, "scores": {"reached": 1.0}})
    return path


def reseal(path, data):
    """Writes other weights with a card that vouches for them, as a forger would."""
    path.write_bytes(data)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(data).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_policy_comes_back_to_the_bit(kind, tmp_path):
    policy, path = LearnedPolicy.fresh(kind, 8), tmp_path / "deep" / "policy.safetensors"
    policies.save(policy, path, {"seed": 8, "command": "python -m agents.train_bc"})
    again = policies.load(path)
    assert again.cfg == policy.cfg
    assert again.control == policies.control_in(path) == policy.control
    assert (again.card["seed"], again.card["command"]) == (8, "python -m agents.train_bc")
    assert again.card["parameters"] == policy.parameters
    for name, value in policy.net.state_dict().items():
        assert torch.equal(value, again.net.state_dict()[name])
    rows = observations(np.random.default_rng(8), 9)
    np.testing.assert_array_equal(policy.predict(rows)[0], again.predict(rows)[0])
    assert sorted(p.name for p in path.parent.iterdir()) == ["policy.json", "policy.safetensors"]


@pytest.mark.parametrize("kept", [0, 4, 100, 0.5, -1])
def test_truncated_weights_are_refused(saved, kept):
    data = saved.read_bytes()
    part = data[: int(len(data) * kept)] if isinstance(kept, float) else data[:kept]
    saved.write_bytes(part)
    with pytest.raises(PolicyFileError, match=r"SHA-256 differs\): truncated"):
        policies.load(saved)
    reseal(saved, part)
    with pytest.raises(PolicyFileError, match="no safetensors file, or a damaged one"):
        policies.load(saved)


def test_one_flipped_bit_is_found(saved):
    data = bytearray(saved.read_bytes())
    data[-100] ^= 1
    saved.write_bytes(data)
    with pytest.raises(PolicyFileError, match="SHA-256"):
        policies.load(saved)


class _Bomb:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


@pytest.mark.parametrize("make", ["pickle", "torch"])
def test_a_foreign_file_is_refused_and_not_executed(saved, tmp_path, make):
    target = tmp_path / "executed"
    file = tmp_path / "bomb"
    if make == "pickle":
        file.write_bytes(pickle.dumps(_Bomb(target)))
    else:
        torch.save(_Bomb(target), file)
    reseal(saved, file.read_bytes())
    with pytest.raises(PolicyFileError, match="no safetensors file"):
        policies.load(saved)
    assert not target.exists()
    if make == "pickle":  # the bomb is live
        pickle.loads(file.read_bytes())
        assert target.exists()


def test_other_tensors_are_refused(saved):
    tensors = read_tensors(saved.read_bytes())
    name = "linear.weight"
    for change, message in (
        ({k: v for k, v in tensors.items() if k != name}, rf"\['{name}'\] are missing"),
        ({**tensors, "extra": torch.zeros(1)}, r"\['extra'\] are foreign"),
        ({**tensors, name: tensors[name][:, :5].contiguous()}, r"shape \(6, 5\), must be .* shape \(6, 11\)"),
        ({**tensors, name: tensors[name].double()}, r"float64 .* must be torch.float32"),
        ({**tensors, name: torch.full_like(tensors[name], float("nan"))}, "not finite"),
    ):
        reseal(saved, write_tensors(change))
        with pytest.raises(PolicyFileError, match=message):
            policies.load(saved)


def test_broken_cards_are_refused(saved):
    card = saved.with_suffix(".json")
    good = json.loads(card.read_text())
    for change, message in (
        ({"format": "another"}, "does not say format"),
        ({"version": 99}, "version 99: this release reads 1"),
        ({"config": None}, "config must have the entries"),
        ({"config": {**good["config"], "code": "x"}}, "config must have the entries"),
        ({"config": {**good["config"], "hidden": 10**9}}, "hidden = 1000000000"),
        ({"config": {**good["config"], "hidden": "64"}}, "hidden = '64'"),
        ({"config": {**good["config"], "kind": ["x"]}}, "kind = "),
        ({"config": {**good["config"], "hidden": 65}}, "must be torch.float32 of shape"),
    ):
        card.write_text(json.dumps({**good, **change}))
        with pytest.raises(PolicyFileError, match=message):
            policies.load(saved)
    for text in ("", "{", "[1]", "[" * 100_000, "\xff"):
        card.write_bytes(text.encode("latin-1"))
        with pytest.raises(PolicyFileError, match="no card of a policy"):
            policies.load(saved)
    card.unlink()
    with pytest.raises(PolicyFileError, match=r"cannot be read .*NAME.json"):
        policies.load(saved)


def test_missing_files_and_other_names_are_refused(saved):
    with pytest.raises(PolicyFileError, match="cannot be read"):
        policies.load(saved.with_name("other.safetensors"))
    with pytest.raises(ConfigError, match=r"NAME\.safetensors"):
        policies.load(saved.with_suffix(".pt"))


def test_what_is_not_finite_is_not_saved(tmp_path):
    policy = LearnedPolicy.fresh("neural_rmp", 0)
    with torch.no_grad():
        policy.net.linear.weight[0, 0] = float("inf")
    with pytest.raises(PolicyFileError, match=r"linear\.weight has values that are not finite"):
        policies.save(policy, tmp_path / "x.safetensors", {})
    assert not list(tmp_path.iterdir())


def test_the_largest_file_is_bounded(saved, monkeypatch):
    monkeypatch.setattr(policies, "_LONGEST_FILE", 1000)
    with pytest.raises(PolicyFileError, match="no policy of ours is so large"):
        policies.load(saved)
