"""Cameras: noise, lost and late frames in images and oracle lines, and the hand-eye error in pixels."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.sim.look import LookCfg
from seal_gym.vision.features import ViewGeometry, oracle_lines
from seal_gym.workpieces.seam import seam_in_world
from seal_gym.wrappers.cameras import (
    CameraDropoutCfg,
    CameraLatencyCfg,
    CameraNoiseCfg,
    Feed,
    HandEyeErrorCfg,
)

CELL = load_cell()
STILL = np.zeros(6, np.float32)
IMAGES = {"observation": "features+images"}


def frames(env, seed, steps, amount=0.1):
    """Images of a run that moves a little, so that no two are alike."""
    rng, out = np.random.default_rng(1), [env.reset(seed=seed)[0]]
    for _ in range(steps):
        out.append(env.step((amount * rng.uniform(-1, 1, 6)).astype(np.float32))[0])
    return {view: np.array([o[view] for o in out]) for view in ("front", "side")}


# -- noise --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("severity", [1.0, 2.0])
def test_noise_adds_its_variance_to_the_sensors_own(make, severity):
    """In flat grey: exposure leaves 3 sigma of room, so nothing clips."""
    look = LookCfg(texture=(0.0, 0.0), contrast=(0.0, 0.0), brightness=(0.0, 0.0), noise_sigma=6.0)
    clean = LookCfg(texture=(0.0, 0.0), contrast=(0.0, 0.0), brightness=(0.0, 0.0), noise_sigma=0.0)
    noisy = make(**IMAGES, look=look, disturbances=[{"name": "CameraNoise", "severity": severity}])
    images = [frames(e, 3, 8)["front"].astype(float) for e in (noisy, make(**IMAGES, look=clean))]
    # A smooth patch on the plate: the difference to the mean grey of the patch is noise alone.
    residual = images[0] - images[1]
    residual -= np.median(residual, axis=(1, 2, 3), keepdims=True)
    expected = np.sqrt(6.0**2 + (8.0 * severity) ** 2)
    assert np.std(residual[:, :60, 2:12]) == pytest.approx(expected, rel=0.06)


# -- late ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [1, 2, 4])
def test_latency_shifts_the_images_by_whole_frames(make, late):
    now = frames(make(**IMAGES), 5, 10)
    then = frames(make(**IMAGES, disturbances=[{"name": "CameraLatency", "severity": late}]), 5, 10)
    for view in ("front", "side"):
        for k in range(11):
            np.testing.assert_array_equal(then[view][k], now[view][max(k - late, 0)])


def test_latency_shifts_the_oracles_lines_too(make):
    def lines(**kwargs):
        env, rng = make(**kwargs), np.random.default_rng(1)
        core, out = env.unwrapped.core, []
        env.reset(seed=5)
        for _ in range(8):
            out.append(core.lines)
            env.step((0.1 * rng.uniform(-1, 1, 6)).astype(np.float32))
        return out

    now, then = lines(), lines(disturbances=[{"name": "CameraLatency", "frames": 2}])
    for k in range(8):
        for a, b in zip(now[max(k - 2, 0)], then[k], strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_fraction_of_a_frame_is_a_chance_and_time_never_runs_back():
    feed = Feed(1, None, CameraLatencyCfg(frames=2.4))
    feed.reset(0, np.random.default_rng(0), np.random.default_rng(1))
    shown = []
    for k in range(4000):
        feed.expose(np.array([k]))
        shown.append(int(feed("x", (np.array([k]),))[0][0]))
    age = np.arange(4000) - shown
    assert set(age[5:]) == {2, 3}
    assert np.all(np.diff(shown) >= 0)
    assert np.mean(age[5:]) == pytest.approx(2.4, abs=0.05)


# -- lost ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("in_a_row", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("severity", [1.0, 4.0])
def test_dropout_loses_its_share_of_frames_in_runs_of_its_length(severity, in_a_row):
    feed = Feed(1, CameraDropoutCfg(severity=severity, in_a_row=in_a_row), None)
    feed.reset(0, np.random.default_rng(2), np.random.default_rng(3))
    lost = []
    for k in range(40_000):
        feed.expose(np.array([k]))
        lost.append(feed("x", (np.array([1.0]),))[0][0] == 0.0)
    assert not lost[0]
    assert np.mean(lost) == pytest.approx(0.1 * severity, rel=0.1)
    starts = np.sum(np.diff(np.array(lost, int)) == 1)
    assert np.sum(lost) / starts == pytest.approx(in_a_row, rel=0.1)


def test_so_many_lost_frames_that_runs_must_be_longer():
    feed = Feed(1, CameraDropoutCfg(share=0.9, in_a_row=2.0), None)
    feed.reset(0, np.random.default_rng(2), np.random.default_rng(3))
    lost = []
    for k in range(20_000):
        feed.expose(np.array([k]))
        lost.append(feed("x", (np.array([1.0]),))[0][0] == 0.0)
    assert np.mean(lost) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("kind", ["black", "frozen"])
def test_a_lost_frame_is_black_or_the_last(make, kind):
    now = frames(make(**IMAGES), 6, 25)
    lossy = make(**IMAGES, disturbances=[{"name": "CameraDropout", "share": 0.4, "lost": kind}])
    then = frames(lossy, 6, 25)
    count, last = 0, 0
    for k in range(26):
        for view in ("front", "side"):
            black, kept = then[view][k], now[view][last]
            if (then[view][k] == now[view][k]).all():
                last = k if view == "side" else last
                continue
            count += view == "front"
            np.testing.assert_array_equal(black, 0 if kind == "black" else kept)
    assert 4 <= count <= 18


def test_the_oracle_is_blind_in_a_black_frame(make):
    env = make(disturbances=[{"name": "CameraDropout", "severity": 4.0}])
    env.reset(seed=1)
    seen = [env.step(STILL)[-1]["roi"]["valid_front"] for _ in range(60)]
    assert 0.3 < np.mean(seen) < 0.9


def test_lost_and_late_go_together(make):
    """A frame lost at the camera is missed when it should have arrived."""
    lossy, both = (
        [{"name": "CameraDropout", "severity": 3.0}],
        [{"name": "CameraLatency", "severity": 2.0}, {"name": "CameraDropout", "severity": 3.0}],
    )
    first, later = (frames(make(**IMAGES, disturbances=d), 9, 20)["front"] for d in (lossy, both))
    assert (first.max(axis=(1, 2, 3)) == 0).any()
    for k in range(2, 21):
        np.testing.assert_array_equal(later[k], first[k - 2])


def test_looking_twice_at_a_frame_loses_and_delays_nothing_more(make):
    env = make(**IMAGES, disturbances=["CameraDropout", "CameraLatency"])
    core = env.unwrapped.core
    env.reset(seed=2)
    for _ in range(6):
        observation = env.step(STILL)[0]
        again = core.observe()
        np.testing.assert_array_equal(again["front"][0], observation["front"])


# -- hand and eye -------------------------------------------------------------------------------------------


def pixels_off(core):
    """The seam's foot in the images: by the perception's geometry, and where it was seen."""
    point, tangent = seam_in_world(core.scene.workpiece.seam, core.progress.s, core.arm.part_pose)
    truth = oracle_lines(point, tangent, core.tip.pose, ViewGeometry.of(CELL))
    return core.lines.point[0] - truth.point[0]


def test_a_displaced_bracket_shifts_the_pixels_by_the_pinhole_formula(make):
    """f * shift / depth, for the shift's components along the image's axes."""
    sizes = []
    for seed in range(5):
        env = make(disturbances=[{"name": "HandEyeError", "shift_mm": 0.5, "turn_deg": 0.0}])
        core = env.unwrapped.core
        env.reset(seed=seed)
        error = core._disturbances.bracket(core.tip.pose)[0]
        moved = core.tip.pose[0, :3, :3].T @ (error[:3, 3] - core.tip.pose[0, :3, 3])
        assert np.linalg.norm(moved) == pytest.approx(0.5e-3, rel=1e-9)
        point, _ = seam_in_world(core.scene.workpiece.seam, core.progress.s, core.arm.part_pose)
        local = core.tip.pose[0, :3, :3].T @ (point[0] - core.tip.pose[0, :3, 3])
        for v, camera in enumerate(CELL.cameras):
            ray, step = camera.rotation.T @ (local - camera.position_m), camera.rotation.T @ moved
            expected = -camera.focal_px * (step[:2] - ray[:2] / ray[2] * step[2]) / ray[2]
            np.testing.assert_allclose(pixels_off(core)[v], expected, atol=0.02)
            sizes.append(np.linalg.norm(expected))
    assert max(sizes) > 1.0


def test_a_turned_bracket_shifts_the_pixels_by_focal_length_times_angle(make):
    """About the pivot between the cameras: up to 0.5 deg * 400 px and the pivot's lever."""
    sizes = []
    for seed in range(8):
        env = make(disturbances=[{"name": "HandEyeError", "shift_mm": 0.0, "turn_deg": 0.1, "severity": 5.0}])
        core = env.unwrapped.core
        env.reset(seed=seed)
        error = np.linalg.inv(core.tip.pose[0]) @ core._disturbances.bracket(core.tip.pose)[0]
        assert np.degrees(np.arccos((np.trace(error[:3, :3]) - 1) / 2)) == pytest.approx(0.5, rel=1e-6)
        middle = np.mean([c.position_m for c in CELL.cameras], axis=0)
        np.testing.assert_allclose(error[:3, :3] @ middle + error[:3, 3], middle, atol=1e-12)
        sizes += np.linalg.norm(pixels_off(core), axis=1).tolist()
    limit = 400 * np.deg2rad(0.5)
    assert 0.8 * limit < max(sizes) < 2.0 * limit


def test_the_images_show_what_a_displaced_camera_sees(make):
    """Two environments: one's bracket is off, the other's gun is moved there."""
    clean = LookCfg.clean()
    env = make(**IMAGES, look=clean, disturbances=[{"name": "HandEyeError", "severity": 5.0}])
    core = env.unwrapped.core
    observation, _ = env.reset(seed=3)
    there = core._disturbances.bracket(core.tip.pose)
    seen = core.sensors.images(there, core.arm, core.frames)
    believed = core.sensors.images(core.tip.pose, core.arm, core.frames)
    np.testing.assert_array_equal(observation["front"], seen.front[0])
    assert (seen.front != believed.front).mean() > 0.01


def test_the_error_stays_through_an_episode_and_differs_between_them(make):
    env = make(disturbances=["HandEyeError"])
    core = env.unwrapped.core
    errors = []
    for seed in (1, 2):
        env.reset(seed=seed)
        for _ in range(2):
            errors.append(np.linalg.inv(core.tip.pose[0]) @ core._disturbances.bracket(core.tip.pose)[0])
            env.step(STILL)
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-12)
    assert np.abs(errors[0] - errors[2]).max() > 1e-6


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (CameraNoiseCfg, {"sigma": -1.0}),
        (CameraDropoutCfg, {"share": 1.0}),
        (CameraDropoutCfg, {"in_a_row": 0.5}),
        (CameraDropoutCfg, {"lost": "grey"}),
        (CameraLatencyCfg, {"frames": 31.0}),
        (HandEyeErrorCfg, {"shift_mm": -0.1}),
        (HandEyeErrorCfg, {"turn_deg": "1"}),
    ],
)
def test_values_out_of_range_are_refused(kind, wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        kind(**wrong)
