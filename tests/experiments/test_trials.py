import json

import numpy as np
import pytest

from experiments import trials
from seal_gym.core.errors import SeamError

SHORT = {"perception": "oracle"}


def write_seam(path, length=0.06):
    c = np.sqrt(0.5)
    rows = [f"{x:.4f},0,0,0,{-c:.4f},{c:.4f}" for x in np.linspace(-length / 2, length / 2, 3)]
    path.write_text("# a short one\nx,y,z,ax,ay,az\n" + "\n".join(rows) + "\n")
    return str(path)


def test_reads_points_and_unit_directions(tmp_path):
    points, approach = trials.read_seam(trials.Path(write_seam(tmp_path / "a.csv")))
    np.testing.assert_allclose(points[:, 0], [-0.03, 0.0, 0.03])
    np.testing.assert_allclose(np.linalg.norm(approach, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [("0,0,0,0,0\n", "line 1.*six numbers"), ("0,0,0,0,0,1\n1,2,x,0,0,1\n", "line 2.*six numbers")],
)
def test_a_bad_row_is_named(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(SeamError, match=message):
        trials.read_seam(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SeamError, match=r"nowhere\.csv"):
        trials.read_seam(tmp_path / "nowhere.csv")


def test_trials_resume_and_do_not_depend_on_the_number_of_jobs(tmp_path):
    seam = write_seam(tmp_path / "short.csv")
    wanted = [trials.Trial(method="rmp_expert", workpiece=seam, seed=s, env=SHORT) for s in (5, 6, 7)]
    log = tmp_path / "log.jsonl"
    rows = trials.run_all(wanted, jobs=1, log=log, title="t")
    assert [r["outcome"] for r in rows] == ["reached"] * 3
    assert [r["seed"] for r in rows] == [5, 6, 7]

    # Killed while writing the last line: that trial alone runs again, and comes out the same.
    lines = log.read_text().splitlines()
    marked = json.loads(lines[0])
    marked["rmse_mm"] = 123.0
    log.write_text("\n".join([json.dumps(marked), lines[1], lines[2][:40]]) + "\n")
    again = trials.run_all(wanted, jobs=2, log=log, title="t")
    assert again[0]["rmse_mm"] == 123.0
    assert again[1:] == rows[1:]

    fresh = trials.run_all(wanted, jobs=2, log=tmp_path / "other.jsonl", title="t")
    assert fresh == rows


def test_rows_of_other_code_are_run_again(tmp_path):
    wanted = [trials.Trial(method="rmp_expert", workpiece=write_seam(tmp_path / "s.csv"), seed=1, env=SHORT)]
    log = tmp_path / "log.jsonl"
    (row,) = trials.run_all(wanted, jobs=1, log=log, title="t")
    stale = json.loads(log.read_text())
    stale["rmse_mm"], stale["code"] = 77.0, "another"
    log.write_text(json.dumps(stale) + "\n")
    assert trials.run_all(wanted, jobs=1, log=log, title="t") == [row]


@pytest.mark.parametrize("first", ["nan,0,0,0,-0.7071,0.7071", "0.O,0,0,0,-0.7071,0.7071"])
def test_a_bad_first_row_is_no_header(tmp_path, first):
    path = tmp_path / "bad.csv"
    path.write_text(f"{first}\n0.1,0,0,0,-0.7071,0.7071\n0.2,0,0,0,-0.7071,0.7071\n")
    with pytest.raises(SeamError, match=r"line 1|not finite"):
        trials.workpiece(str(path))


def test_a_seam_file_may_come_from_a_spreadsheet_but_not_be_empty(tmp_path):
    path = tmp_path / "bom.csv"
    path.write_bytes(b"\xef\xbb\xbf0,0,0,0,0,1\r\n0.1,0,0,0,0,1\r\n")
    assert len(trials.read_seam(path)[0]) == 2
    path.write_text("x,y,z,ax,ay,az\n")
    with pytest.raises(SeamError, match=r"bom\.csv' has 0 points"):
        trials.read_seam(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SeamError, match="no text file"):
        trials.read_seam(path)
