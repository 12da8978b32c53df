"""Pictures: the ROIs are where the panel says, the trail follows the mouth, errors say what to do."""

import gymnasium as gym
import numpy as np
import pytest

import seal_gym  # noqa: F401  # registers the ids
from seal_gym.core.errors import ConfigError, RenderError
from seal_gym.envs import viewing
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore


def core():
    c = SealCore(SealCfg.of(control="tip"), 1)
    c.reset(0, np.random.default_rng(0))
    c.observe()
    return c


def test_the_inset_shows_the_roi_with_line_and_mouth():
    image = np.full((100, 50, 3), 90, np.uint8)
    image[40, 10] = (250, 0, 0)
    inset = viewing.roi_inset(image, np.array([25.0, 0.0]), np.array([0.0, 1.0]), (25.0, 80.0))
    assert inset.shape == (300, 150, 3)
    np.testing.assert_array_equal(inset[121, 31], (250, 0, 0))  # pixel (10, 40), three times as large
    green = np.flatnonzero(inset[10, :, 1] > inset[10, :, 0].astype(int) + 20)
    assert green.mean() == pytest.approx(75, abs=1)
    red = np.argwhere((inset.astype(int)[..., 0] > 200) & (inset.astype(int)[..., 1] < 100))
    red = red[red[:, 0] > 200]
    np.testing.assert_allclose(red.mean(axis=0), [240, 75], atol=1.5)


def test_without_a_line_none_is_drawn():
    inset = viewing.roi_inset(np.zeros((100, 50, 3), np.uint8), None, np.zeros(2), (25.0, 80.0))
    assert not (inset[..., 1] > inset[..., 0].astype(int) + 20).any()


@pytest.mark.gl
def test_the_picture_holds_the_scene_and_both_rois():
    env = gym.make("SealGym/Cylinder-v0", render_mode="rgb_array", disable_env_checker=True)
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (viewing.HEIGHT, viewing.WIDTH, 3)
    c = env.unwrapped.core
    images = c.sensors.images(c.tip.pose, c.arm, c.frames)
    left = viewing.WIDTH - viewing._PANEL
    shown = picture[28 : 28 + 300, left + 77 : left + 77 + 150][1::3, 1::3]
    plain = np.abs(shown.astype(int) - images.front[0]).max(axis=-1) == 0
    assert plain.mean() > 0.9  # all but the line and the cross
    assert picture[:, :left].std() > 20
    np.testing.assert_array_equal(env.render(), picture)  # the same again: pictures change nothing
    env.close()
    env.close()


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


def test_a_viewer_without_a_screen_says_so(monkeypatch):
    viewer = pytest.importorskip("mujoco.viewer")

    def broken(*_, **__):
        raise RuntimeError("could not open a window")

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RenderError, match="DISPLAY"):
        viewing.SceneView(core()).sync()
    monkeypatch.setenv("DISPLAY", ":99")
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
