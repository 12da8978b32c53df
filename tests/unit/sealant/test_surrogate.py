"""Surrogates: features by hand, blocks by hand, mirror symmetry, files."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import nn

from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array
from seal_gym.sealant.fan_section import fan_sections
from seal_gym.sealant.surrogate import (
    Surrogate,
    SurrogateCfg,
    SurrogateFileError,
    features,
    joined,
    load_surrogate,
    save_surrogate,
)
from seal_gym.sealant.surrogate_net import Residual, SectionNet, SqueezeExcitation, tensors

CFGS = [
    SurrogateCfg(kind="linear"),
    SurrogateCfg(kind="linear", neighbours=4, on_fan=True),
    SurrogateCfg(kind="mlp_cnn", hidden=8, channels=4),
    SurrogateCfg(kind="mlp_cnn", hidden=8, channels=4, neighbours=2, on_fan=True),
]


@dataclass(frozen=True)
class Track:
    arcs_m: Array
    linear_mps: Array
    angular_radps: Array
    gravity_mps2: Array
    heights_m: Array


def track(n=31, seed=0):
    rng = np.random.default_rng(seed)
    return Track(
        1e-3 * np.arange(n),
        np.array([0.1, 0.3, 0.0]) + rng.normal(0, 0.02, (n, 3)),
        rng.normal(0, 0.5, (n, 3)),
        np.array([0.0, 0.0, -9.81]) + rng.normal(0, 0.5, (n, 3)),
        30e-3 + rng.normal(0, 1e-3, (n, 41)).cumsum(1) * 0.2,
    )


def mirror(at):
    """What a mirror at x = 0 of the world makes of the tip's motion, written out."""
    return Track(
        at.arcs_m,
        at.linear_mps * [-1, 1, 1],
        at.angular_radps * [1, -1, -1],
        at.gravity_mps2 * [-1, 1, 1],
        at.heights_m[:, ::-1],
    )


def fresh(cfg, seed=0):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = SectionNet(cfg)
        for p in net.parameters():  # those that begin at zero too
            nn.init.normal_(p, 0.0, 0.1)
    return Surrogate(cfg, net)


def test_neighbours_stand_10_mm_before_and_after_and_ends_are_told():
    at = track()
    found = features(at, 4)
    own = np.concatenate((at.linear_mps, at.angular_radps, at.gravity_mps2), 1)
    row = 12
    wanted = np.concatenate((own[12], own[0], own[2], own[22], own[30], [0.0, 1.0, 1.0, 0.0]))
    np.testing.assert_allclose(
        found.kinematic[row], wanted
    )  # 20 mm before: the first stands in; after: 32 > 30
    heights = np.concatenate([at.heights_m[k] for k in (12, 0, 2, 22, 30)])
    np.testing.assert_allclose(found.spatial[row], heights)
    assert found.kinematic[10, -4:].tolist() == [0.0, 1.0, 1.0, 1.0]
    assert features(at).kinematic.shape == (31, 9)


def test_the_fast_tier_among_the_features_is_the_one_station_s_where_nothing_changes():
    n = 41
    at = Track(
        1e-3 * np.arange(n),
        np.tile([0.1, 0.25, 0.0], (n, 1)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        np.full((n, 41), 30e-3),
    )
    alone = fan_sections(at.linear_mps, at.angular_radps, at.heights_m)
    assert np.abs(features(at).fan()[20] - alone[20]).max() < 0.02
    # at the path's first station the fan has laid half of what is averaged there
    assert features(at).fan()[0].sum() == pytest.approx(0.5 * alone[0].sum(), rel=0.02)


def test_a_mirrored_path_has_mirrored_features():
    at = track()
    one, other = features(at, 2).mirrored(), features(mirror(at), 2)
    for a, b in zip(tensors(one), tensors(other), strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), atol=1e-6)


def test_joined_features_are_those_of_the_beads():
    parts = [features(track(seed=k)) for k in (0, 1)]
    both = joined(parts)
    assert len(both) == 62
    np.testing.assert_array_equal(both.rows(slice(31, 62)).laid, parts[1].laid)


@pytest.mark.parametrize("cfg", CFGS, ids=str)
def test_sections_are_shares_and_the_same_one_by_one(cfg):
    model, at = fresh(cfg), track()
    images = model.predict(at)
    assert images.shape == (31, 20, 40)
    assert images.min() >= 0.0
    assert images.max() <= 1.0
    assert images.std() > 0.0
    alone = model.sections(features(at, cfg.neighbours).rows(slice(7, 8)))
    np.testing.assert_allclose(alone[0], images[7], atol=1e-5)


@pytest.mark.parametrize("cfg", CFGS, ids=str)
def test_the_same_seed_draws_the_same_weights(cfg):
    one, again, other = (fresh(cfg, seed).net.arrays() for seed in (3, 3, 4))
    assert all(np.array_equal(one[k], again[k]) for k in one)
    assert any(not np.array_equal(one[k], other[k]) for k in one)


def test_the_linear_model_is_w_x_plus_b():
    cfg = CFGS[0]
    model, at = fresh(cfg), track()
    inputs = features(at)
    model.net.normalise(inputs)
    x = (inputs.flat() - inputs.flat().mean(0)) / inputs.flat().std(0)
    weights, bias = (p.detach().numpy() for p in (model.net.glass.weight, model.net.glass.bias))
    wanted = np.clip(x @ weights.T + bias, 0, 1).reshape(-1, 20, 40)
    np.testing.assert_allclose(model.sections(inputs), wanted, atol=1e-4)


def test_a_network_on_the_fast_tier_begins_as_the_fast_tier():
    at = track()
    cfg = SurrogateCfg(kind="mlp_cnn", hidden=8, channels=4, on_fan=True)
    inputs = features(at)
    np.testing.assert_allclose(Surrogate(cfg).sections(inputs), _above(inputs) * inputs.fan(), atol=1e-5)


def _above(inputs):
    """Share of each pixel above the surface."""
    rows = np.arange(20)[:, None]
    return 1.0 - np.clip(1e3 * inputs.surface[:, None] - rows, 0.0, 1.0)


def test_squeeze_excitation_by_hand():
    block = SqueezeExcitation(2)
    narrow = block.gate[0].out_features
    assert narrow == 2
    first = np.array([[1.0, -1.0], [0.5, 0.5]])
    second = np.array([[2.0, 0.0], [0.0, -1.0]])
    with torch.no_grad():
        block.gate[0].weight.copy_(torch.tensor(first))
        block.gate[0].bias.zero_()
        block.gate[2].weight.copy_(torch.tensor(second))
        block.gate[2].bias.zero_()
    images = torch.tensor([[[[1.0, 3.0]], [[4.0, 0.0]]]])  # channel means 2 and 2
    # hidden: relu(0), relu(2) = 0, 2; gate: sigmoid(0), sigmoid(-2)
    wanted = images.numpy() * np.array([0.5, 1 / (1 + math.exp(2.0))]).reshape(1, 2, 1, 1)
    np.testing.assert_allclose(block(images).detach().numpy(), wanted, rtol=1e-6)


def test_a_residual_block_by_hand():
    block = Residual(1, 2)
    with torch.no_grad():
        for conv in (block.body[0], block.body[3]):
            conv.weight.zero_()
        block.body[0].weight[0, 0, 1, 2] = 1.0  # the pixel to the right
        block.body[3].weight[1, 0, 1, 1] = -3.0
        block.skip.weight.copy_(torch.tensor([1.0, 2.0]).view(2, 1, 1, 1))
    block.eval()  # batch norm's running mean 0 and variance 1
    shrink = 1 / math.sqrt(1 + 1e-5)
    image = torch.tensor([[[[1.0, 2.0, -4.0]]]])
    shifted = np.array([2.0, -4.0, 0.0]) * shrink
    inner = np.where(shifted > 0, shifted, 0.01 * shifted)
    second = -3.0 * inner * shrink + 2.0 * np.array([1.0, 2.0, -4.0])
    wanted = np.stack(([1.0, 2.0, -4.0], second))
    wanted = np.where(wanted > 0, wanted, 0.01 * wanted)
    np.testing.assert_allclose(block(image)[0, :, 0].detach().numpy(), wanted, rtol=1e-5)
    assert isinstance(Residual(3, 3).skip, nn.Identity)


@pytest.mark.parametrize("cfg", CFGS, ids=str)
def test_weights_come_back_from_their_files(tmp_path, cfg):
    model, at = fresh(cfg), track()
    model.net.normalise(features(at, cfg.neighbours))
    path = tmp_path / "one.safetensors"
    save_surrogate(model, path, {"note": "a test"})
    again = load_surrogate(path)
    assert again.cfg == cfg
    assert again.card["note"] == "a test"
    assert again.card["parameters"] == again.parameters == model.parameters
    np.testing.assert_array_equal(again.predict(at), model.predict(at))


@pytest.fixture
def files(tmp_path):
    path = tmp_path / "one.safetensors"
    save_surrogate(fresh(CFGS[0]), path, {})
    return path, path.with_suffix(".json")


def _card(about, **change):
    about.write_text(json.dumps(json.loads(about.read_text()) | change))


def test_damaged_files_are_refused(files):
    weights, about = files
    whole = weights.read_bytes()
    weights.write_bytes(whole[:-4])
    with pytest.raises(SurrogateFileError, match="SHA-256"):
        load_surrogate(weights)
    weights.write_bytes(whole)
    for change, message in (
        ({"config": {"kind": "mlp_cnn"}}, "damaged"),
        ({"config": {"kind": "cubic"}}, "must be one of"),
        ({"version": 99}, "this release reads"),
        ({"format": "other"}, "no card of a surrogate"),
    ):
        text = about.read_text()
        _card(about, **change)
        with pytest.raises(SurrogateFileError, match=message):
            load_surrogate(weights)
        about.write_text(text)
    about.write_text("{")
    with pytest.raises(SurrogateFileError, match="not JSON"):
        load_surrogate(weights)
    about.unlink()
    with pytest.raises(SurrogateFileError, match="cannot be read"):
        load_surrogate(weights)
    with pytest.raises(ConfigError, match=r"NAME\.safetensors"):
        load_surrogate("one.pt")


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    model = fresh(CFGS[0])
    with torch.no_grad():
        model.net.glass.bias[0] = math.nan
    with pytest.raises(ConfigError, match="not finite"):
        save_surrogate(model, tmp_path / "one.safetensors", {})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "cubic"}, "kind"),
        ({"neighbours": 3}, "neighbours"),
        ({"neighbours": True}, "neighbours"),
        ({"on_fan": 1}, "on_fan"),
        ({"hidden": 6}, "hidden"),
        ({"channels": 2}, "channels"),
    ],
)
def test_bad_configurations_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        SurrogateCfg(**({"kind": "linear"} | change))


def test_stations_that_do_not_rise_are_refused():
    at = track()
    with pytest.raises(ConfigError, match="arcs_m"):
        features(Track(at.arcs_m[::-1], at.linear_mps, at.angular_radps, at.gravity_mps2, at.heights_m))
