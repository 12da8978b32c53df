"""Data, split and training of surrogates, on beads that no simulation has made."""

import json

import numpy as np
import pytest
import torch

from agents import surrogate_data, train_surrogate
from agents.surrogate_data import OBSTACLE_COURSE, SurrogateDataError, prepared, read_beads, split
from agents.train_surrogate import (
    TrainCfg,
    fit_linear,
    fit_network,
    least_squares,
    mean_square_error,
    with_mirror,
)
from seal_gym.core.errors import ConfigError
from seal_gym.sealant.laydown.paths import TRAINING, VALIDATION
from seal_gym.sealant.surrogate import SurrogateCfg, load_surrogate
from tests.agents.surrogate_beads import bead, write

NETWORK = SurrogateCfg(kind="mlp_cnn", hidden=8, channels=4, on_fan=True)
LINEAR = SurrogateCfg(kind="linear")
ALL = [bead(p.name, draw, n=4) for p in TRAINING + VALIDATION for draw in range(3)]


@pytest.fixture(scope="module")
def sets():
    names = ("plane_s", "plane_left", "step_top")
    return prepared([bead(n) for n in names[:2]], 0), prepared([bead(names[2])], 0)


def test_least_squares_is_numpys():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(30, 4)), rng.normal(size=(30, 2))
    weights, bias = least_squares(x, y, 0.0)
    wanted = np.linalg.lstsq(np.column_stack((x, np.ones(30))), y, rcond=None)[0]
    np.testing.assert_allclose(np.column_stack((weights, bias)), wanted.T, atol=1e-12)


def test_a_ridge_solves_the_normal_equations():
    rng = np.random.default_rng(1)
    x, y, ridge = rng.normal(size=(30, 4)), rng.normal(size=(30, 2)), 0.3
    weights, bias = least_squares(x, y, ridge)
    error = x @ weights.T + bias - y
    # the gradients of |W x + b - y|^2 / n + ridge |W|^2
    np.testing.assert_allclose(error.T @ x / 30 + ridge * weights, 0.0, atol=1e-12)
    np.testing.assert_allclose(error.mean(0), 0.0, atol=1e-12)


def test_the_split_never_shares_a_centre_path():
    parts = split(ALL)
    names = [{b.path for b in part} for part in parts]
    assert not (names[0] & names[1] or names[0] & names[2] or names[1] & names[2])
    assert names[2] == set(OBSTACLE_COURSE)
    assert (len(names[0]), len(names[1])) == (20, 5)
    assert sum(map(len, parts)) == len(ALL)


def test_the_held_out_paths_stay_those_when_draws_are_added():
    one = split([b for b in ALL if b.draw == 0])
    assert {b.path for b in one[1]} == {b.path for b in split(ALL)[1]}
    with pytest.raises(ConfigError, match="at least 2 are needed"):
        split([b for b in ALL if b.path in (*OBSTACLE_COURSE, "plane_s")])


def test_beads_come_back_from_files(tmp_path):
    beads = [bead("plane_s", 0), bead("plane_s", 2), bead("box_side", 1)]
    write(tmp_path, beads)
    again = read_beads(tmp_path)
    assert [(b.path, b.draw) for b in again] == [("plane_s", 0), ("plane_s", 2), ("box_side", 1)]
    for a, b in zip(beads, again, strict=True):
        np.testing.assert_allclose(a.heights_m, b.heights_m, rtol=1e-6)
        np.testing.assert_allclose(a.images, b.images, atol=0.5 / 255 + 1e-9)


def test_a_file_that_is_being_written_is_read_again(tmp_path, monkeypatch):
    write(tmp_path, [bead("plane_s")])
    file = tmp_path / "plane_s.npz"
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    monkeypatch.setattr(surrogate_data.time, "sleep", lambda _: file.write_bytes(whole))
    assert len(read_beads(tmp_path)) == 1
    file.write_bytes(whole[:100])
    monkeypatch.setattr(surrogate_data.time, "sleep", lambda _: None)
    with pytest.raises(SurrogateDataError, match="make it anew"):
        read_beads(tmp_path)
    with pytest.raises(SurrogateDataError, match="holds no data"):
        read_beads(tmp_path / "nowhere")


def test_mirrored_sections_follow_the_sections(sets):
    inputs, images = with_mirror(sets[0])
    n = len(sets[0].images)
    np.testing.assert_array_equal(images[n:], images[:n, :, ::-1])
    np.testing.assert_array_equal(inputs.kinematic[n:, 0], -inputs.kinematic[:n, 0])


def test_the_linear_model_is_the_best_of_its_ridges(sets):
    trained = fit_linear(LINEAR, *sets, ridges=(1e-3, 10.0))
    assert trained.held_out == min(held for _, held in trained.history)
    assert trained.held_out == mean_square_error(trained.model, sets[1])
    constant = float(np.mean((sets[0].images - sets[0].images.mean(0)) ** 2))
    assert trained.history[0][0] < constant


@pytest.mark.parametrize("optimiser", ["sgd", "adamw"])
def test_a_network_learns_and_repeats_itself_to_the_bit(sets, optimiser):
    def train(seed):
        return fit_network(NETWORK, TrainCfg(optimiser=optimiser, epochs=6, batch=16, seed=seed), *sets)

    state = torch.get_rng_state()
    one, again, other = train(0), train(0), train(1)
    assert torch.equal(state, torch.get_rng_state())
    assert one.history == again.history
    for name, values in one.model.net.arrays().items():
        np.testing.assert_array_equal(values, again.model.net.arrays()[name])
    assert one.history != other.history
    assert one.history[-1][0] < 0.8 * one.history[0][0]
    assert one.held_out == min(held for _, held in one.history)
    # the weights kept are the best epoch's
    assert mean_square_error(one.model, sets[1]) == pytest.approx(one.held_out, rel=1e-6)


def test_each_epoch_sees_other_sections_and_mirrors():
    how = TrainCfg(every=2, batch=4)
    first, second = (torch.cat(list(train_surrogate._batches(20, how, e))).numpy() for e in (0, 1))
    assert set(first % 20) == set(range(0, 20, 2))
    assert set(second % 20) == set(range(1, 20, 2))
    assert 0 < np.sum(first >= 20) < 10


def test_the_command_writes_weights_with_a_card(tmp_path, capsys):
    write(tmp_path, [bead(p.name, n=24) for p in TRAINING[:3]])
    out = tmp_path / "weights" / "mine.safetensors"
    arguments = ["--data", str(tmp_path), "--out", str(out), "--kind", "linear", "--neighbours", "2"]
    assert train_surrogate.main(arguments) == 0
    assert "held-out mean square error" in capsys.readouterr().out
    model = load_surrogate(out)
    assert (model.cfg.kind, model.cfg.neighbours) == ("linear", 2)
    card = json.loads(out.with_suffix(".json").read_text())
    paths = [set(p.split("/")[0] for p in card["beads"][k]) for k in ("train", "held_out")]
    assert not paths[0] & paths[1]
    assert card["train"] is None
    assert train_surrogate.main(["--data", str(tmp_path / "nowhere"), "--out", str(out)]) == 2
    assert "holds no data" in capsys.readouterr().err
    network = ["--data", str(tmp_path), "--out", str(out), "--on-fan", "--epochs", "1", "--neighbours", "0"]
    assert train_surrogate.main(network) == 0
    assert load_surrogate(out).card["train"]["optimiser"] == "adamw"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"optimiser": "lion"}, "optimiser"),
        ({"epochs": 0}, "epochs"),
        ({"batch": 1}, "batch"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"weight_decay": 2.0}, "weight_decay"),
    ],
)
def test_bad_training_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        TrainCfg(**change)
