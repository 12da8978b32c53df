"""The palette experiments: their files, their arithmetic, and that they repeat."""

import json

import numpy as np
import pytest

from experiments import palette, palette_paths
from seal_gym.core.errors import ConfigError
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.palette_env import POSTURE, PaletteEnv
from seal_gym.sim.tool_check import ToolCheck


@pytest.mark.slow
def test_a_small_run_writes_its_files(tmp_path):
    arguments = ["--trials", "2", "--out", str(tmp_path), "--no-video"]
    assert palette.main(arguments) == 0
    document = json.loads((tmp_path / "palette.json").read_text())
    assert [r["perception"] for r in document["rows"]] == ["oracle", "hopfield", "threshold"]
    assert [t["seed"] for t in document["trials"]] == [500_000, 500_001] * 3
    for row in document["rows"]:
        mine = [t for t in document["trials"] if t["perception"] == row["perception"]]
        assert row["completed_pct"] == 50.0 * sum(t["completed"] for t in mine)
        assert row["time_s"] == pytest.approx(np.mean([t["time_s"] for t in mine]))
    for name in (
        "palette.csv",
        "palette.md",
        "palette_jerk.png",
        "palette_tip.png",
        "palette_segmentation.png",
    ):
        assert (tmp_path / name).stat().st_size > 100
    again = palette.run("oracle", 500_000)
    assert json.loads(json.dumps(again)) == document["trials"][0]


def test_rows_by_hand():
    base = {
        "seed": 5, "targets": 4, "targets_done": 4, "wrong_touches": 0, "timeout": False, "collision": False,
        "completed": True, "path_mm": 1000.0, "peak_jerk_m_s3": 10.0, "peak_force_n": 50.0, "time_s": 10.0,
        "missed": 0, "invented": 0, "place_error_mm": 1.0, "perception": "hopfield",
    }  # fmt: skip
    other = base | {"seed": 4, "targets_done": 2, "completed": False, "wrong_touches": 3, "time_s": 20.0}
    (row,) = palette.summarise([base, other | {"timeout": True, "missed": 2, "place_error_mm": 3.0}])
    assert row["completed_pct"] == 50.0 and row["home_pct"] == 75.0 and row["touched_pct"] == 50.0
    assert row["wrong_touches"] == 3 and row["time_s"] == 15.0 and row["timeout_pct"] == 50.0
    assert row["seed0"] == 4 and row["missed"] == 2 and row["place_error_mm"] == 3.0
    assert "50.0" in palette.markdown([row])


def test_an_unknown_observer_is_refused():
    for name in ("nowhere:observe", "seal_gym.vision.palette_threshold:hopfield", "observe"):
        with pytest.raises(ConfigError, match="MODULE:FUNCTION"):
            palette.observer(name)


# -- ways ---------------------------------------------------------------------------------------------------


def test_a_way_is_timed_within_its_limits():
    """One joint turned by 1 rad: T from the closed-form peaks of the gap, by joint or by tip."""
    from seal_gym.planning.tau_jerk import peaks

    q = np.tile(np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0]), (200, 1))
    q[:, 0] += np.linspace(0.0, 1.0, 200)
    radius = np.hypot(*tip_kinematics(q[:1], 0 * q[:1]).pose[0, :2, 3])
    peak = peaks(0.25)
    # The tip's acceleration along its circle and towards the middle, at worst together.
    fastest = max(
        float(peak.speed) * radius / 0.5,
        float(peak.speed) / (0.5 * 3.15),
        np.sqrt(float(peak.acceleration) / 15),
    )
    slowest = np.sqrt(radius * np.hypot(float(peak.acceleration), float(peak.speed) ** 2) / 2.0)
    assert 0.99 * fastest <= palette_paths.duration_s(q) <= 1.01 * max(fastest, slowest)
    assert palette_paths.duration_s(q[:1].repeat(3, axis=0)) == 0.0


@pytest.fixture(scope="module")
def setting():
    env = PaletteEnv(perception="oracle")
    env.reset(seed=500_000)
    check = ToolCheck(env.scene, env.part_pose, POSTURE, 0.003)
    return env, check, palette_paths.problems(env, check, np.random.default_rng(0))


def test_problems_come_in_pairs_with_free_ends(setting):
    env, check, found = setting
    assert [p.kind for p in found] == ["beside", "tie"] * len(env.target_m)
    for problem in found:
        assert check.free(problem.goal[None]).all() and check.free(problem.starts).all()


@pytest.mark.parametrize("method", ["up, across, down", "multi-path", "multi-path, best start"])
def test_what_succeeds_goes_from_start_to_goal(setting, method):
    _, check, found = setting
    for problem in found[:4]:
        way = palette_paths._PLANNERS[method](check, problem)
        assert way is not None
        ends = np.stack((way.q[0][0], way.q[-1][-1]))
        tip = tip_kinematics(ends, np.zeros((2, 6))).pose[:, :3, 3]
        np.testing.assert_allclose(tip[1], problem.goal, atol=1e-6)
        assert np.linalg.norm(problem.starts - tip[0], axis=1).min() < 1e-6
        row = palette_paths.measure(method, check, check, problem)
        assert row["success"] and row["length_mm"] >= 999.0 * np.linalg.norm(tip[1] - tip[0])


def test_a_line_through_a_peg_fails(setting):
    env, check, _ = setting
    peg = env.part_pose[:3, :3] @ [*env.scene.layout.pegs[0, :2], 0.03] + env.part_pose[:3, 3]
    start, goal = peg - np.array([0.03, 0, 0]), peg + np.array([0.03, 0, 0])
    row = palette_paths.measure(
        "straight line", check, check, palette_paths.Problem("tie", start[None], goal)
    )
    assert row["found"] and not row["success"]


def test_rrt_connect_finds_a_way(setting):
    pytest.importorskip("ompl")
    _, check, found = setting
    row = palette_paths.measure("RRT-Connect", check, check, found[0])
    assert row["found"] and row["length_mm"] >= 999.0 * np.linalg.norm(found[0].goal - found[0].starts[0])
