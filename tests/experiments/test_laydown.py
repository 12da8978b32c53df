"""The laydown experiments: what is run, kept, gone on with and written; OpenFOAM only in the slow one."""

import json
import shutil

import numpy as np
import pytest

from experiments import laydown as experiment
from experiments import laydown_data
from experiments.laydown_data import ARRAYS, Run
from seal_gym.sealant.laydown import mesh as meshes
from seal_gym.sealant.laydown import sections
from seal_gym.sealant.laydown.substrates import SUBSTRATES


def fake_row(run, n=3):
    """What a run gives, without one."""
    arrays = {
        "linear_mps": np.full((n, 3), run.draw, dtype=np.float32),
        "image": np.full((n, 20, 40), 10 * run.draw, dtype=np.uint8),
    }
    row = {"commit": "c", "error": None, "volume_error": -0.001, "lid_fraction": 0.0, "cpu_s": 2.0}
    return row | {"cells": 5, "sections": n, "wall_s": 1.0, ARRAYS: arrays}


def blank_row(solver, cell_mm, columns):
    section = np.zeros((20, 40))
    section[8:10, columns] = 1.0
    numbers = dict.fromkeys(
        ("area_mm2", "area_sd_mm2", "ideal_mm2", "width_mm", "height_mm", "volume_error_pct", "cpu_s"), 1.0
    )
    head = {"solver": solver, "cell_mm": cell_mm, "cells": 1, "lid_fraction": 0.0}
    return {**head, **numbers, "section": section.tolist()}


@pytest.fixture
def without_openfoam(monkeypatch):
    """Runs that cost nothing; one fails. Gives the list of those that were run."""
    ran = []

    def simulate_run(run):
        ran.append(run)
        if (run.path, run.draw) == ("overhead", 1):
            row = fake_row(run)
            del row[ARRAYS]
            return row | {"error": "the solver took more than 1800 s", "sections": 0}
        return fake_row(run)

    monkeypatch.setattr(laydown_data, "simulate_run", simulate_run)
    monkeypatch.setattr(experiment.foam, "find", lambda program: program)
    return ran


def test_every_path_comes_once_before_any_comes_twice():
    plan = laydown_data.plan(3, 7, 1.0, "interFoam")
    assert len(plan) == 3 * 37 == len(set(plan))
    assert len({run.path for run in plan[:37]}) == 37
    assert [run.draw for run in plan[::37]] == [0, 1, 2]


def test_a_run_depends_on_its_seed_path_and_draw():
    one, again, other, seed = (
        laydown_data.simulation(Run("step_edge", draw, seed, 2.0, "interFoam"))
        for draw, seed in ((1, 0), (1, 0), (2, 0), (1, 3))
    )
    np.testing.assert_array_equal(one.path.positions, again.path.positions)
    assert abs(one.path.positions[0] - other.path.positions[0]).max() > 1e-4
    assert abs(one.path.positions[0] - seed.path.positions[0]).max() > 1e-4
    assert (one.substrate, one.grid.cell_m) == ("step", 2e-3)


def test_data_are_kept_and_a_stopped_command_goes_on(tmp_path, without_openfoam):
    arguments = ["runs", "--out", str(tmp_path), "--draws"]
    assert experiment.main([*arguments, "1"]) == 0
    assert len(without_openfoam) == 37
    log = tmp_path / "laydown_runs.trials.jsonl"
    log.write_text(log.read_text() + '{"unit": {"path": "pl')  # the line a killed run was writing
    assert experiment.main([*arguments, "2"]) == 0
    assert [run.draw for run in without_openfoam[37:]] == [1] * 37
    assert experiment.main([*arguments, "2"]) == 0
    assert [(run.path, run.draw) for run in without_openfoam[74:]] == [
        ("overhead", 1)
    ]  # it failed: once more
    with np.load(tmp_path / "plane_s.npz", allow_pickle=False) as data:
        assert data["draw"].tolist() == [0, 0, 0, 1, 1, 1]
        assert data["image"].shape == (6, 20, 40)
        assert data["image"][:, 0, 0].tolist() == [0, 0, 0, 10, 10, 10]
    with np.load(tmp_path / "overhead.npz") as data:
        assert set(data["draw"]) == {0}
    rows = {r["path"]: r for r in json.loads((tmp_path / "laydown_runs.json").read_text())["rows"]}
    assert (rows["overhead"]["runs"], rows["overhead"]["failed"], rows["overhead"]["sections"]) == (2, 1, 3)
    assert (rows["plane_s"]["failed"], rows["plane_s"]["sections"]) == (0, 6)
    assert [r["set"] for r in rows.values()].count("validation") == 12


def test_a_folder_of_other_runs_is_refused(tmp_path, without_openfoam, capsys):
    arguments = ["runs", "--out", str(tmp_path), "--draws", "1"]
    assert experiment.main(arguments) == 0
    before = (tmp_path / "plane_s.npz").read_bytes()
    assert experiment.main([*arguments, "--seed", "1"]) == 2
    assert experiment.main([*arguments, "--cell", "2"]) == 2
    assert "use another --out" in capsys.readouterr().err
    assert (tmp_path / "plane_s.npz").read_bytes() == before and len(without_openfoam) == 37


def test_a_run_stored_twice_is_there_once(tmp_path):
    run = Run("plane_s", 2, 0, 1.0, "interFoam")
    for _ in range(2):
        laydown_data.store(tmp_path / "a.npz", run.draw, fake_row(run)[ARRAYS])
    with np.load(tmp_path / "a.npz") as data:
        assert data["draw"].tolist() == [2, 2, 2]
    assert [f.name for f in tmp_path.iterdir()] == ["a.npz"]


def test_data_of_a_slab_by_hand():
    cfg = laydown_data.simulation(Run("plane_straight", 0, 0, 1.0, "interFoam"))
    mesh = meshes.build(SUBSTRATES["plane"], np.array([-0.06, -0.06]), np.array([0.06, 0.06]), 1e-2, 1e-3)
    fractions = np.zeros(mesh.cell_ids.shape)
    fractions[:, :, :2] = 1.0  # 2 mm of sealant everywhere
    at = sections.stations(cfg)
    data = laydown_data.data(mesh, fractions.reshape(-1), at)
    np.testing.assert_allclose(data["across_height_m"], 2e-3, rtol=1e-6)
    np.testing.assert_allclose(data["across_area_m2"], 80e-6, rtol=1e-6)
    assert data["heights_m"].shape == (len(at.arcs_m), 41)
    assert data["image"].dtype == np.uint8
    # where the nozzle points at there is sealant above the substrate, and none below
    assert (data["image"][:, 9, 19:21] > 200).all()
    assert (data["image"][:, 7, 19:21] < 60).all()


def test_beads_are_compared_with_the_finest_and_across_solvers():
    rows = [
        blank_row("interFoam", 1.0, slice(10, 20)),
        blank_row("interFoam", 0.5, slice(12, 22)),
        blank_row("interIsoFoam", 1.0, slice(10, 15)),
    ]
    found = experiment.compared(rows)
    assert [r["iou_finest"] for r in found] == pytest.approx([8 / 12, 1.0, 1.0])
    assert [r["iou_solvers"] for r in found] == [pytest.approx(0.5), None, pytest.approx(0.5)]
    assert all("section" not in r for r in found)


def test_the_grid_study_writes_its_files(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment.foam, "find", lambda program: program)
    monkeypatch.setattr(
        experiment, "lay", lambda c: blank_row(c.solver, c.cell_mm, slice(10, 20 + int(c.cell_mm)))
    )
    assert experiment.main(["grid", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "laydown_grid.json").read_text())["rows"]
    assert [r["cell_mm"] for r in rows if r["solver"] == "interFoam"] == [2.0, 1.0, 0.75, 0.5]
    assert (tmp_path / "laydown_grid.png").stat().st_size > 10_000
    assert "IoU finest" in (tmp_path / "laydown_grid.md").read_text()


def test_without_openfoam_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert experiment.main(["runs", "--out", str(tmp_path / "out")]) == 2
    assert "apt-get install openfoam" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("interFoam") is None, reason="OpenFOAM is not installed")
def test_a_run_with_openfoam_gives_data():
    row = laydown_data.simulate_run(Run("plane_straight", 0, 0, 2.0, "interFoam"))
    assert row["error"] is None
    assert abs(row["volume_error"]) < 5e-3
    data = row[ARRAYS]
    middle = slice(15, len(data["image"]) - 10)
    ratio = data["across_area_m2"][middle].mean() / data["ideal_m2"][middle].mean()
    assert ratio == pytest.approx(1.0, abs=0.1)


def test_a_sample_is_the_course_s_first_draws(tmp_path):
    run = Run("box_side", 0, 0, 1.0, "interFoam")
    arrays = fake_row(run)[ARRAYS] | {"arc_m": np.zeros(3), "area": np.zeros(3)}
    for key in ("angular_radps", "gravity_mps2", "heights_m"):
        arrays[key] = np.zeros((3, 3), dtype=np.float32)
    for draw in range(3):
        for name in ("box_side", "plane_s"):
            laydown_data.store(tmp_path / f"{name}.npz", draw, arrays)
    out = tmp_path / "course"
    command = ["sample", "--data", str(tmp_path), "--out", str(out), "--draws", "2"]
    assert experiment.main(command) == 0
    assert sorted(f.name for f in out.iterdir()) == ["box_side.npz", "sample.json"]
    (row,) = json.loads((out / "sample.json").read_text())["rows"]
    assert (row["path"], row["beads"], row["sections"]) == ("box_side", 2, 6)
    with np.load(out / "box_side.npz") as data:
        assert data["draw"].tolist() == [0] * 3 + [1] * 3
        assert set(data) == {"draw", "image", *laydown_data.INPUTS}
    assert experiment.main(["sample", "--data", str(tmp_path / "no"), "--out", str(out)]) == 2
