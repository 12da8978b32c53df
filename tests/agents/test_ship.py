"""The seed that is shipped, and where it goes."""

import pytest
import torch

import agents
from agents import policies, ship
from agents.policies import LearnedPolicy
from seal_gym.core.errors import ConfigError


def card(flat, cylinder):
    scores = [{"trials": 10, "reached": reached, "rmse_mm": rmse} for reached, rmse in (flat, cylinder)]
    return {"validation": dict(zip(("flat", "cylinder"), scores, strict=True))}


def test_the_seed_to_ship():
    cards = [card((10, 0.3), (9, 0.1)), card((10, 0.3), (10, 0.3)), card((10, 0.2), (10, 0.3))]
    assert ship.best_of(cards) == 2
    assert ship.best_of(cards[:2]) == 1
    assert ship.best_of([card((0, None), (0, None)), card((0, None), (1, 2.0))]) == 1
    with pytest.raises(ConfigError, match="--validate"):
        ship.best_of([{}])


def test_shipping_takes_the_best_seed_and_keeps_the_others(tmp_path, monkeypatch):
    def trained(seed, reached, **more):
        path = tmp_path / f"run{seed}" / "x.safetensors"
        made = {**card((10, 0.1), (reached, 0.1)), "seed": seed, "data_sha256": "d", **more}
        policies.save(LearnedPolicy.fresh("neural_rmp", seed), path, made)
        return path

    paths, folder = [trained(seed, reached) for seed, reached in ((0, 9), (1, 10), (2, 8))], tmp_path / "w"
    ship.ship(paths, folder)
    assert {p.stem for p in folder.glob("*.safetensors")} == {
        "neural_rmp",
        *(f"neural_rmp-seed{k}" for k in range(3)),
    }
    monkeypatch.setattr(agents, "WEIGHTS", folder)
    shipped = agents.load_policy("neural_rmp")
    for name, values in LearnedPolicy.fresh("neural_rmp", 1).net.state_dict().items():
        assert torch.equal(shipped.net.state_dict()[name], values)
    assert shipped.card["seed"] == 1
    with pytest.raises(ConfigError, match=r"seeds 0 and 3 differ in \['data_sha256'\]"):
        ship.ship([paths[0], trained(3, 10, data_sha256="e")], folder)


def test_what_went_through_dagger_has_a_name_of_its_own(tmp_path, capsys):
    path = tmp_path / "x.safetensors"
    made = {**card((10, 0.1), (10, 0.1)), "seed": 0, "dagger": {"rounds": 3}}
    policies.save(LearnedPolicy.fresh("neural_control", 0), path, made)
    assert ship.main([str(path), "--out", str(tmp_path / "w")]) == 0
    assert "neural_control_dagger.safetensors: seed 0 of 1" in capsys.readouterr().out
    assert policies.load(tmp_path / "w" / "neural_control_dagger-seed0.safetensors").control == "tip"
    assert ship.main([str(tmp_path / "none.safetensors")]) == 2
