"""The tau-Jerk experiment: its files, and rows against what the paper and hand calculations say."""

import json

import numpy as np
import pytest

from experiments import six_axis
from experiments import tau_jerk as experiment
from seal_gym.planning.tau_jerk import DEFAULT_K

pytest.importorskip("ruckig")


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert experiment.main(["--moves", "5", "--out", str(out)]) == 0
    for name in ("csv", "md"):
        assert (out / f"tau_jerk.{name}").stat().st_size > 100
    for name in ("fig2", "fig3", "comparison"):
        assert (out / f"tau_jerk_{name}.png").stat().st_size > 10_000
    return json.loads((out / "tau_jerk.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_every_motion_keeps_to_the_limits_and_only_the_trapezoid_jerks_without_bound(document):
    rows, limits = document["rows"], document["limits"]
    assert len(rows) == 4 * len(experiment.WAYS_RAD)
    for row in rows:
        assert row["peak_speed_rad_s"] <= limits["speed"] * (1 + 1e-9)
        assert row["peak_acceleration_rad_s2"] <= limits["acceleration"] * (1 + 1e-9)
        assert (row["peak_jerk_rad_s3"] is None) == (row["motion"] == "trapezoidal")
        if row["motion"] != "trapezoidal":
            assert row["peak_jerk_rad_s3"] <= limits["jerk"] * (1 + 1e-9)
            assert row["duration_over_ruckig"] >= 1.0 - 1e-9


def test_in_the_same_time_the_paper_s_k_is_unbounded_and_the_default_rests(document):
    rows = {row["motion"]: row for row in document["same_time"]}
    assert rows["tau-Jerk, k = 0.4"]["end_jerk"] is None
    assert rows["tau-Jerk, k = 0.4"]["peak_acceleration"] is not None
    assert rows["tau-Jerk, k = 0.6"]["peak_acceleration"] is None
    assert rows["tau-Jerk, k = 0.333"]["end_jerk"] == pytest.approx(162.0)
    assert rows[f"tau-Jerk, k = {DEFAULT_K:g}"]["end_jerk"] == 0.0


def test_six_joints_take_at_least_ruckig_s_time(document):
    for row in document["several_axes"]:
        assert row["moves"] == 5
        assert row["duration_over_ruckig_min"] <= row["duration_over_ruckig_mean"]
        if row["motion"] != "trapezoidal":
            assert row["duration_over_ruckig_min"] >= 1.0 - 1e-9


def test_fig3_ends_at_its_target():
    for k, motion in experiment.arm_motions().items():
        end = six_axis.pose(motion.sample(experiment.FIG3_S).position)[0]
        np.testing.assert_allclose(end, experiment.FIG3_TARGET, atol=1e-7)
        assert (motion.k == k).all()
