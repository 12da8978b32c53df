"""The inverse kinematics experiment: its files and what they say."""

import json
import sys

import numpy as np
import pytest

from experiments import inverse_kinematics as experiment
from experiments import reference_arm
from seal_gym.core.kinematics import JOINT_LOWER, JOINT_UPPER


@pytest.fixture(scope="module")
def arm():
    pytest.importorskip("pinocchio", reason="the reference UR5 needs pin and example-robot-data")
    return reference_arm.ReferenceArm()


@pytest.fixture(scope="module")
def rows(arm, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert experiment.main(["--poses", "60", "--out", str(out)]) == 0
    for name in ("csv", "md"):
        assert (out / f"inverse_kinematics.{name}").stat().st_size > 100
    document = json.loads((out / "inverse_kinematics.json").read_text(encoding="utf-8"))
    return {row["method"]: row for row in document["rows"]}


def test_closed_form_and_newton_reach_all_and_the_print_none(rows):
    for name in ("closed form, numpy", "closed form, compiled", "Newton"):
        assert rows[name]["reached_pct"] == 100.0
        assert rows[name]["largest_m"] < 1e-6
    assert rows["Newton as printed, without the target"]["reached_pct"] == 0.0
    assert rows["pinocchio's CLIK example"]["reached_pct"] > 50.0


def test_the_judge_sees_small_errors_limits_and_missing_postures(arm):
    q = np.random.default_rng(0).uniform(JOINT_LOWER, JOINT_UPPER, (6, 6))
    poses = arm.tip(q)
    poses[1, 0, 3] += 2e-6
    q[2, 5] += 2e-6
    q[3, 0] += 2 * np.pi * (1 if q[3, 0] > 0 else -1)
    q[4] = np.nan
    good, apart, angle = experiment.judge(arm, q, poses)
    np.testing.assert_array_equal(good, [True, False, False, False, False, True])
    assert apart[1] == pytest.approx(2e-6, rel=1e-3)
    # The last joint turns the tip about its own axis.
    assert angle[2] == pytest.approx(2e-6, rel=1e-3)


def test_without_pinocchio_the_error_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    assert experiment.main(["--poses", "1", "--out", str(tmp_path)]) == 2
    assert "pip install pin" in capsys.readouterr().err
