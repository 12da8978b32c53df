"""What is recorded is what the policy's actions say and what the arm was told; looking changes nothing."""

import types

import imageio.v2 as imageio
import numpy as np
import pytest

import agents
from agents.expert import RmpExpert
from agents.policies import LearnedPolicy, save
from experiments import explain, recording, trials
from experiments.explain_plot import Story, stations
from seal_gym.core.errors import ConfigError
from seal_gym.core.kinematics import tip_kinematics
from seal_gym.envs.seal_env import SealEnv

SEED, EVERY = 500_000, 4
SCALE = np.array([1.0, 1.0, 1.0, 25.0, 25.0, 25.0])  # of an action's accelerations, cell.toml
FRAME_S = 1.0 / 30.0


def write_seam(folder):
    c = np.sqrt(0.5)
    seam = folder / "mine.csv"
    seam.write_text(f"-0.02,0,0,0,{-c},{c}\n0.02,0,0,0,{-c},{c}\n")
    return seam


def actions_of(name, seam):
    """The actions and tip errors of the same run without anybody looking."""
    env = SealEnv(workpiece=trials.workpiece(str(seam)), control=agents.control_of(name))
    policy = agents.load_policy(name, env)
    observation, _ = env.reset(seed=SEED)
    state, start, done, actions, errors = None, np.array([True]), False, [], []
    while not done:
        action, state = policy.predict(observation, state, start)
        actions.append(action.astype(float))
        errors.append(1e3 * float(env.core.progress.error_m[0]))
        observation, _, terminated, truncated, _ = env.step(action)
        start, done = np.array([False]), terminated or truncated
    env.close()
    return np.array(actions), np.array(errors)


def decoded_metric(action):
    """A = L L^T with L's entries row by row, times 2, by hand."""
    lower, k = np.zeros((6, 6)), 6
    for row in range(6):
        for column in range(row + 1):
            lower[row, column] = 2.0 * action[k]
            k += 1
    return lower @ lower.T


@pytest.fixture(scope="module", params=["rmp_expert", "pid_servo"])
def run(request, tmp_path_factory):
    """One explained run of a short seam by vision: the command's files, and what its recording holds."""
    rerun = pytest.importorskip("rerun")
    folder = tmp_path_factory.mktemp("explain")
    seam, name = write_seam(folder), request.param
    options = ["--policy", name, "--seam", str(seam), "--seed", str(SEED), "--every", str(EVERY)]
    assert explain.main([*options, "--out", str(folder / "out")]) == 0
    stem = f"mine_{name}_vision_{SEED}"
    reader = rerun.chunk.RrdReader(folder / "out" / f"{stem}.rrd")
    columns = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        for column in batch.schema.names:
            values = [v for v in batch.column(column).to_pylist() if v is not None]
            columns.setdefault((chunk.entity_path, column), []).extend(values)
    actions, errors = actions_of(name, seam)
    return types.SimpleNamespace(
        name=name,
        columns=columns,
        actions=actions,
        errors=errors,
        reader=reader,
        picture=folder / "out" / f"{stem}.png",
    )


def scalars(run, entity):
    return np.array(run.columns[entity, "Scalars:scalars"])


def test_the_recorded_accelerations_are_those_of_the_actions(run):
    f = np.concatenate(
        [scalars(run, f"/decision/{k}/f") for k in ("translation_m_s2", "rotation_rad_s2")], axis=1
    )
    np.testing.assert_allclose(f, run.actions[:, :6] * SCALE, atol=1e-12)
    assert np.ptp(f, axis=0).min() > 0 or run.name == "rmp_expert"  # of the lean the expert says nothing


def test_the_recorded_metrics_are_those_of_the_actions(run):
    if run.name == "pid_servo":
        assert not any("/metric" in entity or "/share" in entity for entity, _ in run.columns)
        return
    wanted = np.array([decoded_metric(action) for action in run.actions])
    np.testing.assert_allclose(scalars(run, "/policy/metric"), wanted[:, *np.tril_indices(6)], atol=1e-12)
    diagonal = np.diagonal(wanted, axis1=1, axis2=2)
    np.testing.assert_allclose(scalars(run, "/metric/translation"), diagonal[:, :3], atol=1e-12)
    np.testing.assert_allclose(scalars(run, "/metric/rotation"), diagonal[:, 3:], atol=1e-12)
    # Half axes of an ellipsoid: 10 mm times the roots of the eigenvalues, at least 0.3 mm.
    half = np.array(
        [h[0] for h in run.columns["/world/tip/rotation/policy/metric", "Ellipsoids3D:half_sizes"]]
    )
    eigen = np.linalg.eigvalsh(wanted[::EVERY, 3:, 3:])
    np.testing.assert_allclose(
        np.sort(half, axis=1), np.maximum(0.010 * np.sqrt(np.maximum(eigen, 0.0)), 3e-4), rtol=1e-5
    )


def test_arrows_are_the_accelerations_in_the_lengths_the_text_gives(run):
    for kind, part, length in (("translation", slice(0, 3), 0.08), ("rotation", slice(3, 6), 0.002)):
        vectors = run.columns[f"/world/tip/{kind}/policy/accel", "Arrows3D:vectors"]
        arrows = np.array([v[0] for v in vectors])
        wanted = (run.actions[:, :6] * SCALE)[::EVERY, part]
        np.testing.assert_allclose(arrows, length * wanted, atol=1e-6)
        assert len(run.columns[f"/world/tip/{kind}/resolved/accel", "Arrows3D:vectors"]) == len(wanted)


def test_the_recording_shows_the_run_as_it_is_without_recording(run):
    np.testing.assert_array_equal(scalars(run, "/tip/error_mm").ravel(), run.errors)


def test_images_and_features_are_there_and_the_recording_opens_with_a_layout(run):
    full = -(-len(run.actions) // EVERY)
    for view in ("front", "side"):
        assert len(run.columns[f"/{view}/image", "EncodedImage:blob"]) == full
        assert len(run.columns[f"/features/d_{view}_mm/estimated", "Scalars:scalars"]) == len(run.actions)
    kinds = [store.kind for store in [*run.reader.recordings(), *run.reader.blueprints()]]
    assert kinds == ["recording", "blueprint"]


def test_the_picture_is_made(run):
    picture = imageio.imread(run.picture)
    assert picture.shape[0] > 900 and picture.shape[1] > 1100
    assert picture[..., :3].std() > 20


@pytest.mark.parametrize("control", ["rmp", "tip"])
def test_the_resolved_acceleration_is_j_qdd_and_jdot_qd(control):
    """qdd from the change of the commanded speeds, Jdot from differences of J along the motion."""
    env = SealEnv(workpiece="cylinder", control=control, perception="oracle")
    name = "rmp_expert" if control == "rmp" else "pid_servo"
    policy, state = agents.load_policy(name, env), None
    observation, _ = env.reset(seed=3)
    arm, checked = env.core.arm, 0
    for _ in range(60):
        action, state = policy.predict(observation, state)
        decision = explain.decide(env.core, action)
        q, qd = arm.q_command.copy(), arm.qd_command.copy()
        observation, *_ = env.step(action)
        qdd = (arm.qd_command - qd) / FRAME_S
        h = 1e-5
        ahead, behind = (tip_kinematics(q + s * h * qd, qd).jacobian[0] for s in (1.0, -1.0))
        drift = (ahead - behind) / (2.0 * h) @ qd[0]
        wanted = tip_kinematics(q, qd).jacobian[0] @ qdd[0] + drift
        np.testing.assert_allclose(decision.resolved, wanted, atol=1e-7)
        np.testing.assert_allclose(observation[17:23], decision.resolved, atol=1e-5)
        checked += int(np.abs(drift).max() > 1e-5)
    assert checked > 30  # the arm moved: Jdot qd was put to the test
    env.close()


def test_direct_control_gets_what_it_asks_for():
    env = SealEnv(control="tip", perception="oracle")
    env.reset(seed=0)
    action = np.array([0.3, -0.2, 0.1, 0.05, -0.1, 0.02], np.float32)
    decision = explain.decide(env.core, action)
    np.testing.assert_allclose(decision.resolved, action * SCALE, atol=1e-9)
    np.testing.assert_allclose(decision.accel, action * SCALE, atol=1e-12)
    np.testing.assert_array_equal(decision.share, 1.0)
    env.close()


def test_the_share_says_how_far_a_change_of_f_comes_through():
    """Moving the policy's f by d moves the resolved acceleration by W d; the share is W's diagonal."""
    env = SealEnv(workpiece="cylinder", control="rmp", perception="oracle")
    observation, _ = env.reset(seed=5)
    rng, expert = np.random.default_rng(0), RmpExpert()
    for _ in range(20):
        observation, *_ = env.step(expert.predict(observation)[0])
    action = expert.predict(observation)[0].astype(float)
    action[6:] += 0.1 * rng.normal(size=21)  # a metric with no zeros
    base = explain.decide(env.core, action)
    for axis in range(6):
        pushed = action.copy()
        pushed[axis] += 1e-3
        change = explain.decide(env.core, pushed).resolved - base.resolved
        assert change[axis] / (1e-3 * SCALE[axis]) == pytest.approx(base.share[axis], abs=1e-3)
    assert base.share[4] > 1e-3 and base.share.max() < 1.0
    env.close()


def test_a_networks_weights_can_be_explained_by_their_path(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(recording, "find_spec", lambda _: None)
    weights = tmp_path / "mine.safetensors"
    save(LearnedPolicy.fresh("neural_rmp", 0), weights, {})
    options = ["--policy", str(weights), "--seam", str(write_seam(tmp_path)), "--perception", "oracle"]
    assert explain.main([*options, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    assert "rerun-sdk is not installed" in said.err
    assert "diagonal of A" in said.out and "approach" in said.out
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"mine_mine_oracle_{SEED}.png"]


def test_wrong_policies_and_options_are_refused(tmp_path, capsys):
    assert explain.main(["--policy", "neural", "--out", str(tmp_path)]) == 2
    assert "policy = 'neural': must be one of" in capsys.readouterr().err
    for wrong in (["--every", "0"], ["--seed", "-1"], ["--out", __file__]):
        with pytest.raises(SystemExit):
            explain.parse(wrong)
    env = SealEnv(control="joint", perception="oracle")
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="control = 'joint'"):
        explain.decide(env.core, np.zeros(6, np.float32))
    env.close()


def made_up(arc, turn, corners):
    """A story of which only arc length, turning and corners matter."""
    n = len(arc)
    accel = np.zeros((n, 6))
    accel[:, 5] = turn
    metric = np.tile(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), (n, 1, 1))
    return Story(
        arc_mm=arc, tip_pose=np.tile(np.eye(4), (n, 1, 1)), desired_mm=np.zeros((2, 3)),
        tip_error_mm=np.zeros(n), accel=accel, resolved=0.5 * accel, metric=metric, fixed_metric=metric,
        share=np.full((n, 6), 0.5), has_metric=True, d_mm=np.zeros((n, 2)), theta_deg=np.zeros((n, 2)),
        valid=np.ones((n, 2), bool), corners_mm=corners,
    )  # fmt: skip


def test_stations_are_the_start_the_hardest_turns_and_some_between():
    arc = np.arange(0.0, 100.0)
    turn = np.where(arc == 33, -9.0, np.where(arc == 70, 8.0, 0.1))
    found = stations(made_up(arc, turn, np.array([[30.0, 38.0], [66.0, 74.0]])), 8)
    assert found[0] == 0 and {33, 70} <= set(found) and found == sorted(found)
    assert 7 <= len(found) <= 10


def test_the_report_separates_approach_straights_and_corners():
    arc = np.array([0.0, 5.0, 20.0, 30.0, 50.0])
    text = explain.report(made_up(arc, np.array([3.0, 4.0, 0.0, 2.0, 6.0]), np.array([[25.0, 35.0]])))
    rows = {}
    for line in text.splitlines()[1:]:
        if "frames" in line:
            region = line.split(",")[0]
        else:
            rows[region, line[:20].strip()] = [float(v) for v in line[20:].split()]
    assert rows["approach", "f, RMS"][5] == pytest.approx(np.sqrt(12.5), abs=1e-4)
    assert rows["along", "f, RMS"][5] == pytest.approx(np.sqrt(18.0), abs=1e-4)
    assert rows["corners", "f, RMS"][5] == pytest.approx(2.0)
    assert rows["corners", "resolved, RMS"][5] == pytest.approx(1.0)
    assert rows["along", "diagonal of A"] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert rows["along", "share"] == [0.5] * 6
