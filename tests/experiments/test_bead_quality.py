"""The bead's table: what is in it, that it resumes, and its summary by hand."""

import json

import pytest

from experiments import bead_quality


def row(part, pressure, seed, reached=True, **more):
    return {
        "method": "rmp_expert",
        "pressure": pressure,
        "workpiece": part,
        "seed": seed,
        "training_seed": None,
        "outcome": "reached" if reached else "collision",
        "reached": reached,
        "collision": not reached,
        "timeout": False,
        "rmse_mm": 0.1,
        "rmse_whole_mm": 0.5,
        "coverage_pct": 99.0,
        "time_s": 30.0,
        "bead_section_pct": 100.0,
        **more,
    }


def test_the_summary_counts_trials_that_reached():
    rows = [
        row("flat", "regulated", 0, bead_section_pct=90.0, corner_section_pct=None),
        row("flat", "regulated", 1, bead_section_pct=110.0, contact_mm=2.0),
        row("flat", "regulated", 2, reached=False, bead_section_pct=10.0),
    ]
    (line,) = bead_quality.summarise(rows)
    assert (line["pressure"], line["trials"], line["reached_pct"]) == ("regulated", 3, pytest.approx(200 / 3))
    assert line["bead_section_pct"] == 100.0
    assert line["section_sd_pct"] == pytest.approx(200**0.5)
    assert line["corner_section_pct"] is None
    assert line["contact_mm"] == 2.0
    assert "| flat" in bead_quality.markdown([line], "static")


@pytest.mark.slow
def test_the_command_writes_its_files_and_goes_on_where_it_was(tmp_path):
    command = ["--workpiece", "flat", "--policy", "rmp_expert", "--trials", "1", "--out", str(tmp_path)]
    assert bead_quality.main(command) == 0
    document = json.loads((tmp_path / "bead_quality.json").read_text())
    assert [r["pressure"] for r in document["rows"]] == ["constant", "regulated"]
    trial = document["trials"][1]
    assert trial["reached"]
    assert trial["smoothed_contact_mm"] > 1.5 * trial["contact_mm"]
    assert not trial["smoothing_touched"]
    assert 90 < trial["bead_section_pct"] < 110
    assert (tmp_path / "bead_quality.png").stat().st_size > 10_000
    logged = (tmp_path / "bead_quality.trials.jsonl").read_text()
    assert bead_quality.main(command) == 0
    assert (tmp_path / "bead_quality.trials.jsonl").read_text() == logged
