"""Pictures: the ROIs are where the panel says, the trail follows the mouth, errors say what to do."""

import os
import subprocess
import sys
from pathlib import Path

import glfw
import gymnasium as gym
import numpy as np
import pytest

import seal_gym  # noqa: F401  # registers the ids
from agents.expert import RmpExpert
from seal_gym.core.errors import ConfigError, RenderError
from seal_gym.envs import viewing
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.vision import overlay


def core():
    c = SealCore(SealCfg.of(control="tip"), 1)
    c.reset(0, np.random.default_rng(0))
    c.observe()
    return c


@pytest.mark.parametrize("perception", ["oracle", "vision"])
@pytest.mark.gl
def test_the_picture_holds_the_scene_and_both_rois(perception):
    env = gym.make(
        "SealGym/Cylinder-v0", render_mode="rgb_array", perception=perception, disable_env_checker=True
    )
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (viewing.HEIGHT, viewing.WIDTH, 3) == (720, 1280, 3)
    c = env.unwrapped.core
    images = c.sensors.images(c.tip.pose, c.arm, c.frames)
    left = viewing.WIDTH - viewing._PANEL
    insets = ((images.front[0], left + 8), (images.side[0], left + 8 + 200 + 8))
    shares = []
    for image, x in insets:
        height, width = image.shape[:2]
        shown = picture[28 : 28 + 4 * height, x : x + 4 * width]
        corners = shown[::4, ::4]  # the marks cover few corners of the enlarged pixels
        plain = np.abs(corners.astype(int) - image).max(axis=-1) == 0
        shares.append(plain.mean())
        orange = np.abs(shown.astype(int) - overlay.CANDIDATE_RGB).max(axis=-1) < 40
        assert (orange.sum() > 200) == (perception == "vision")  # the oracle has no edge pixels
    assert min(shares) > 0.85
    assert picture[:, :left].std() > 20
    np.testing.assert_array_equal(env.render(), picture)  # the same again: pictures change nothing
    env.close()
    env.close()


@pytest.mark.gl
def test_the_gun_is_not_hidden_by_an_inset():
    """The mouth is in the middle of the main picture, far from the panel."""
    env = gym.make("SealGym/Flat-v0", render_mode="rgb_array", disable_env_checker=True)
    env.reset(seed=0)
    camera = env.unwrapped._view._close()
    mouth = env.unwrapped.core.tip.pose[0, :3, 3]
    azimuth, elevation = np.deg2rad([camera.azimuth, camera.elevation])
    forward = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = mouth - (np.asarray(camera.lookat) - camera.distance * forward)
    half_height = np.tan(np.deg2rad(45.0 / 2))  # MuJoCo's free camera
    x = (offset @ right) / (offset @ forward) / half_height * viewing.HEIGHT / 2
    assert abs(x) < 0.25 * (viewing.WIDTH - viewing._PANEL)
    env.close()


@pytest.mark.parametrize("perception", ["oracle", "vision"])
@pytest.mark.gl
def test_rendering_changes_no_number(perception):
    """The same seed with a picture after each step and without: equal to the bit."""
    kwargs = {"perception": perception, "control": "rmp", "disable_env_checker": True}
    seen = gym.make("SealGym/Rectangular-v0", render_mode="rgb_array", **kwargs)
    blind = gym.make("SealGym/Rectangular-v0", **kwargs)
    expert = RmpExpert()
    (o, info), (p, plain) = seen.reset(seed=5), blind.reset(seed=5)
    for _ in range(25):
        assert seen.render() is not None
        np.testing.assert_array_equal(o, p)
        assert info["roi"] == plain["roi"] and info["tip_error_mm"] == plain["tip_error_mm"]
        assert info.keys() == plain.keys()
        (o, r, _, _, info), (p, q, _, _, plain) = (
            e.step(expert.predict(x)[0]) for e, x in ((seen, o), (blind, p))
        )
        assert r == q
    np.testing.assert_array_equal(seen.unwrapped.core.arm.q, blind.unwrapped.core.arm.q)
    seen.close()
    blind.close()


def ink(picture):
    return (np.abs(picture.astype(int) - viewing._BACK_RGB).max(axis=-1) > 60).sum()


def test_a_lost_view_is_named_in_the_panel():
    c = core()
    view = viewing.SceneView(c)
    view._insets()
    found = view._facts(400)
    c.features.valid[0, 1] = False
    lost = view._facts(400)
    orange = np.abs(lost[:72].astype(int) - viewing._LOST_RGB).max(axis=-1) < 40
    rows = np.flatnonzero(orange.any(axis=1))
    assert len(rows) and rows.min() >= 48  # the side view's row of the table
    assert not (np.abs(found.astype(int) - viewing._LOST_RGB).max(axis=-1) < 40)[:72].any()
    assert ink(found) > 500


def test_pictures_that_are_too_large_are_shrunk_in_proportion():
    big = np.zeros((400, 900, 3), np.uint8)
    assert viewing.fitted(big, 300, 200).shape == (133, 300, 3)
    assert viewing.fitted(big, 900, 400) is big


@pytest.mark.gl
def test_the_trail_begins_anew_with_each_episode():
    env = gym.make("SealGym/Flat-v0", render_mode="rgb_array", disable_env_checker=True)
    view = env.unwrapped._view
    action = np.array([0.3, 0.5, 0, 0, 0, 0], np.float32)
    for _ in range(2):
        env.reset(seed=0)
        for k in range(15):
            env.step(action)
            if k % 7 == 0:
                env.render()
        assert 1 < len(view._trail) < 6
        part, tip = env.unwrapped.core.arm.part_pose[0], env.unwrapped.core.tip.pose[0, :3, 3]
        assert np.linalg.norm(part[:3, :3] @ view._trail[-1] + part[:3, 3] - tip) < 5e-3
    env.close()


HUMAN = """
import gymnasium as gym, seal_gym
from seal_gym.core.errors import RenderError
env = gym.make("SealGym/Flat-v0", render_mode="human", perception="oracle")
try:
    env.reset(seed=0)
except RenderError as error:
    print("refused:", error)
env.close()
print("alive")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a screen")
@pytest.mark.parametrize("display", [None, ":77"])
def test_without_a_screen_the_process_lives_on(display):
    """No display, and one that does not answer: GLFW itself would end the process."""
    environ = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environ |= {"MUJOCO_GL": "disabled", **({"DISPLAY": display} if display else {})}
    root = Path(__file__).resolve().parents[3]
    run = subprocess.run(
        [sys.executable, "-c", HUMAN], cwd=root, env=environ, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "refused:" in run.stdout and "rgb_array" in run.stdout
    assert run.stdout.endswith("alive\n")


def test_a_viewer_without_a_screen_says_so(monkeypatch):
    viewer = pytest.importorskip("mujoco.viewer")

    def broken(*_, **__):
        raise RuntimeError("could not open a window")

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderError, match="DISPLAY"):
        viewing.SceneView(core()).sync()
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(glfw, "init", lambda: True)
    monkeypatch.setattr(viewer, "launch_passive", broken)
    with pytest.raises(RenderError, match="rgb_array"):
        viewing.SceneView(core()).sync()


def test_the_viewer_is_shown_the_current_state(monkeypatch):
    viewer = pytest.importorskip("mujoco.viewer")
    c = core()
    shown = {}

    class Window:
        def __init__(self, model, data):
            shown["data"], shown["model"], shown["closed"] = data, model, False

        def sync(self):
            shown["q"] = shown["data"].qpos.copy()

        def close(self):
            shown["closed"] = True

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(glfw, "init", lambda: True)
    monkeypatch.setattr(viewer, "launch_passive", Window)
    view = viewing.SceneView(c)
    view.sync()
    c.step(np.ones((1, 6)))
    view.sync()
    np.testing.assert_array_equal(shown["q"], c.arm.q[0])
    view.close()
    assert shown["closed"]


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ConfigError, match="rgb_array"):
        viewing.check_render_mode("ansi", ["rgb_array", "human"])
