"""The recording holds the run it shows, the picture is made without it, and looking changes nothing."""

import types

import imageio.v2 as imageio
import numpy as np
import pytest

from agents.expert import RmpExpert
from experiments import inspect, recording, trials
from experiments.pictures import FeatureTrace
from seal_gym.core.cell import load_cell
from seal_gym.envs.seal_env import SealEnv
from seal_gym.rmp import blend

SEED, EVERY = 500_000, 4
STEM = f"mine_vision_{SEED}"


def write_seam(folder):
    c = np.sqrt(0.5)
    seam = folder / "mine.csv"
    seam.write_text(f"-0.02,0,0,0,{-c},{c}\n0.02,0,0,0,{-c},{c}\n")
    return seam


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One inspected run of a short seam: the command's files, and what its recording holds."""
    rerun = pytest.importorskip("rerun")
    folder = tmp_path_factory.mktemp("inspect")
    seam = write_seam(folder)
    options = ["--seam", str(seam), "--seed", str(SEED), "--every", str(EVERY), "--out", str(folder / "out")]
    assert inspect.main(options) == 0
    reader = rerun.chunk.RrdReader(folder / "out" / f"{STEM}.rrd")
    rows, columns = {}, {}
    for chunk in reader.stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            values = [v for v in batch.column(name).to_pylist() if v is not None]
            columns.setdefault((chunk.entity_path, name), []).extend(values)
    return types.SimpleNamespace(folder=folder / "out", seam=seam, reader=reader, rows=rows, columns=columns)


def plain(seam, perception="vision"):
    """The same run without anybody looking: tip error [mm] of each frame."""
    errors = []
    trial = trials.Trial(method="rmp_expert", workpiece=str(seam), seed=SEED, env={"perception": perception})
    trials.run(trial, lambda env, _: errors.append(1e3 * float(env.core.progress.error_m[0])))
    return np.array(errors)


def test_the_recording_shows_the_run_as_it_is_without_recording(run):
    recorded = np.array(run.columns["/tip/error_mm", "Scalars:scalars"]).ravel()
    np.testing.assert_array_equal(recorded, plain(run.seam))


def test_every_frame_has_numbers_and_every_fourth_images_and_marks(run):
    frames = len(run.columns["/tip/error_mm", "Scalars:scalars"])
    assert frames > 60
    full = -(-frames // EVERY)
    for view in ("front", "side"):
        for name in ("image", "candidates", "ransac", "tracked", "true", "attraction"):
            assert run.rows[f"/{view}/{name}"] == full, name
        for name in (f"d_{view}_mm", f"theta_{view}_deg"):
            for source in ("true", "estimated"):
                values = run.columns[f"/features/{name}/{source}", "Scalars:scalars"]
                assert len(values) == frames and np.isfinite(values).all()
    assert len(run.columns["/world/tip", "Transform3D:translation"]) == frames
    assert len(run.columns["/world/part", "Transform3D:translation"]) == 1  # it stood still
    assert run.rows["/world/part/tip_path"] == full
    assert run.rows["/world/part/seam"] == run.rows["/world/part/surface"] == 1
    assert run.rows["/world/tip/nozzle"] == run.rows["/about"] == 1
    times = np.array([t.total_seconds() for t in run.columns["/world/tip", "time"]])
    np.testing.assert_allclose(np.sort(times), np.arange(frames) / 30.0, atol=1e-6)


def test_each_leaf_has_its_arrow_and_its_ellipsoid_where_it_acts(run):
    acts = {
        "translation": {"attraction_front", "attraction_side", "forward_speed"},
        "rotation": {"heading_front", "heading_side", "lean"},
    }
    everywhere = {"policy", "damping", "regularisation"}
    for kind, names in acts.items():
        prefix = f"/world/tip/{kind}/"
        found = {e[len(prefix) :] for e in run.rows if e.startswith(prefix)}
        assert found == {f"{n}/{what}" for n in names | everywhere for what in ("accel", "metric")}
    frames = len(run.columns["/tip/error_mm", "Scalars:scalars"])
    assert run.rows["/world/tip/translation/damping/metric"] == -(-(frames - 1) // EVERY)  # none at the end


def test_arrows_and_ellipsoids_have_the_sizes_the_text_gives(run):
    """The gun starts at rest: the forward leaf wants 0.5 tanh(12 x 0.01 / 0.5) m/s^2 along y, weight 1."""
    arrow = run.columns["/world/tip/translation/forward_speed/accel", "Arrows3D:vectors"][0][0]
    np.testing.assert_allclose(arrow, [0, 0.08 * 0.5 * np.tanh(0.24), 0], atol=1e-4)
    half = run.columns["/world/tip/translation/forward_speed/metric", "Ellipsoids3D:half_sizes"][0][0]
    np.testing.assert_allclose(sorted(half), [3e-4, 3e-4, 0.010], rtol=1e-5)
    half = run.columns["/world/tip/translation/regularisation/metric", "Ellipsoids3D:half_sizes"][0][0]
    np.testing.assert_allclose(half, 0.010 * np.sqrt(0.05), rtol=1e-5)


def test_marks_are_where_the_cameras_see_them(run):
    cell = load_cell()
    point = np.array([0.0, 0.0, -cell.process.stand_off_m])
    for camera in cell.cameras:
        shown = run.columns[f"/{camera.name}/stand_off", "Points2D:positions"][0][0]
        np.testing.assert_allclose(shown, camera.project(point), atol=1e-4)
        true = np.array(run.columns[f"/{camera.name}/true", "LineStrips2D:strips"][-1][0])
        tracked = np.array(run.columns[f"/{camera.name}/tracked", "LineStrips2D:strips"][-1][0])
        np.testing.assert_allclose(tracked, true, atol=2.0)  # px: at the end the track is settled
        candidates = np.array(run.columns[f"/{camera.name}/candidates", "Points2D:positions"][-1])
        assert len(candidates) > 40
        way = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
        offset = (candidates - true[0]) @ [-way[1], way[0]]
        assert abs(np.median(offset)) < 1.5  # px: they lie along the seam


def test_the_recording_opens_with_a_layout(run):
    kinds = [store.kind for store in [*run.reader.recordings(), *run.reader.blueprints()]]
    assert kinds == ["recording", "blueprint"]


def test_the_picture_sums_up_the_run(run):
    picture = imageio.imread(run.folder / f"{STEM}.png")
    assert picture.shape[0] > 1000 and picture.shape[1] > 900
    assert picture.std() > 20


def test_without_rerun_there_is_a_word_and_still_a_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recording, "find_spec", lambda _: None)
    seam, out = write_seam(tmp_path), tmp_path / "out"
    options = ["--seam", str(seam), "--perception", "oracle", "--seed", str(SEED), "--out", str(out)]
    assert inspect.main(options) == 0
    said = capsys.readouterr()
    assert "rerun-sdk is not installed: pip install 'seal-gym[viz]'" in said.err
    assert "front    0.000    0.000        0.000      100.0" in said.out  # the oracle makes no error
    assert [p.name for p in out.iterdir()] == [f"mine_oracle_{SEED}.png"]


def test_the_leaves_are_what_moves_the_tip():
    """The expert's leaves sum to its action, and that with the fixed ones to the commanded acceleration."""
    env, expert = SealEnv(workpiece="cylinder", control="rmp", perception="oracle"), RmpExpert()
    observation, _ = env.reset(seed=3)
    for _ in range(40):
        action, _ = expert.predict(observation)
        found = inspect.leaves(env.core, observation, action)
        assert tuple(found) == (*inspect.SEAM_LEAVES, "policy", "damping", "regularisation", "lean")
        summed = blend([found[name] for name in inspect.SEAM_LEAVES])
        np.testing.assert_allclose(summed.metric, found["policy"].metric, atol=1e-5)
        acting = summed.metric[0].any(axis=1)  # the lean is nobody's but the fixed leaf's
        np.testing.assert_allclose(summed.accel[0, acting], found["policy"].accel[0, acting], atol=1e-3)
        total = blend([found[name] for name in ("policy", "damping", "regularisation", "lean")])
        observation, *_ = env.step(action)
        np.testing.assert_allclose(observation[17:23], total.accel[0], rtol=2e-3, atol=2e-3)
    env.close()


def test_other_control_modes_have_no_leaves():
    env = SealEnv(control="tip")
    observation, _ = env.reset(seed=0)
    assert inspect.leaves(env.core, observation, np.zeros(6, np.float32)) == {}
    env.close()


def test_an_ellipsoid_has_the_metrics_axes():
    """Rebuilt from its half axes and its rotation, the metric is there again."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        metric = root @ root.T + 0.1 * np.eye(3)
        half, (x, y, z, w) = recording.ellipsoid(metric)
        assert np.linalg.norm([x, y, z, w]) == pytest.approx(1.0)
        turned = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        np.testing.assert_allclose(
            turned @ np.diag((half / recording.METRIC_M) ** 2) @ turned.T, metric, atol=1e-9
        )


def test_the_report_counts_valid_frames_from_10_mm_on():
    arc = np.array([0.0, 5.0, 10.0, 20.0, 30.0])
    zero = np.zeros((5, 2))
    seen = np.array([[9.0, 9.0], [9.0, 9.0], [0.3, 1.0], [0.4, 1.0], [7.0, 1.0]])
    found = FeatureTrace(
        arc_mm=arc,
        true_d_mm=zero,
        seen_d_mm=seen,
        true_theta_deg=zero,
        seen_theta_deg=2 * seen,
        error_px=3 * seen,
        valid=np.array([[True, True]] * 4 + [[False, True]]),
        tip_error_mm=np.array([50.0, 50.0, 0.3, 0.3, 0.3]),
        snr_db=np.full((5, 2), 12.0),
        corners_mm=np.empty((0, 2)),
    )
    _, front, side, tip = inspect.report(found).splitlines()
    d = np.sqrt((0.09 + 0.16) / 2)
    assert [float(x) for x in front.split()[1:]] == pytest.approx([d, 3 * d, 2 * d, 66.7, 12.0], abs=1e-3)
    assert [float(x) for x in side.split()[1:]] == pytest.approx([1, 3, 2, 100, 12])
    assert tip.startswith("tip error 0.300 mm")


@pytest.mark.parametrize("option", ["--every", "--seed"])
def test_bad_numbers_are_refused(option, capsys):
    with pytest.raises(SystemExit):
        inspect.parse([option, "-1"])
    assert f"{option} -1: must be at least" in capsys.readouterr().err


def test_a_seam_that_is_none_is_refused(tmp_path, capsys):
    assert inspect.main(["--seam", str(tmp_path / "none.csv"), "--out", str(tmp_path)]) == 2
    assert "not found" in capsys.readouterr().err
