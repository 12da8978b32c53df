"""The RGB-D camera against the scene's geometry and Lambert's law."""

import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import yaw_pose
from seal_gym.envs.palette_config import PaletteCfg
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.palette_scene import BOARD_TOP_M, RGB, build_palette
from seal_gym.sim.rgbd import DepthNoiseCfg, RgbdCamera, exposure
from seal_gym.vision.palette_seen import Regions, deproject, targets_of
from seal_gym.vision.palette_threshold import observe
from seal_gym.workpieces.palette import draw_layout

CAMERA = PaletteCfg().camera


def look(**changes):
    out = Look.empty(1)
    out.draw(0, np.random.default_rng(0), LookCfg.clean())
    for name, value in changes.items():
        getattr(out, name)[0] = value
    return out


@pytest.fixture(scope="module")
def cell():
    """A palette without yaw in its nominal place, the arm beside it: layout, pose, data, camera."""
    layout = draw_layout(np.random.default_rng(3))
    scene = build_palette(layout, load_cell())
    arm = ArmBatch(scene, 1)
    pose = yaw_pose(0.45, 0.0, BOARD_TOP_M, 0.0)
    arm.reset(0, np.radians([-60.0, -85.0, -115.0, -70.0, 90.0, -94.0]), pose)
    return layout, pose, arm.data(0), RgbdCamera(scene.model, CAMERA)


def _pixel(points):
    local = (points - CAMERA.pose[:3, 3]) @ CAMERA.pose[:3, :3]
    return CAMERA.focal_px * local[:, :2] / local[:, 2:] + np.array(CAMERA.frame_px) / 2, local[:, 2]


def test_depth_is_that_of_the_tops(cell):
    layout, pose, data, camera = cell
    ideal = camera.ideal(data, look())
    tops = np.array(
        [[s.x, s.y, h] for s, h in zip(layout.connectors, layout.connector_height_m, strict=True)]
    )
    points = np.concatenate((layout.target_m, tops)) @ pose[:3, :3].T + pose[:3, 3]
    (u, v), depth = _pixel(points)[0].T.astype(int), _pixel(points)[1]
    np.testing.assert_allclose(
        ideal.depth_m[v, u], depth, atol=1e-4
    )  # the pad of a tie sinks by its limit's give
    assert ideal.depth_m.max() == pytest.approx(0.85 + 0.06 - BOARD_TOP_M, abs=1e-6)  # the table's top


def test_deprojection_undoes_projection():
    points = np.random.default_rng(0).uniform((0.3, -0.2, -0.01), (0.6, 0.2, 0.1), (50, 3))
    pixel, depth = _pixel(points)
    np.testing.assert_allclose(deproject(pixel, depth, CAMERA), points, atol=1e-12)


def test_colour_is_lamberts_law_on_the_board(cell):
    *_, data, camera = cell
    for lamp in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8]):
        ideal = camera.ideal(data, look(lamp=lamp, ambient=0.3, diffuse=0.6))
        board = ideal.geom == np.bincount(ideal.geom[150:330, 100:300].ravel()).argmax()
        expected = 255 * np.array(RGB["board"]) * (0.3 + 0.6 * lamp[2])
        np.testing.assert_allclose(ideal.rgb[board].mean(axis=0), expected, rtol=1e-6)


def test_without_errors_the_sensor_adds_none(cell):
    *_, data, camera = cell
    clean, rng = look(), np.random.default_rng(0)
    ideal = camera.ideal(data, clean)
    picture = camera.sense(ideal, clean, DepthNoiseCfg(sigma_m=0.0, dropout=0.0), rng)
    np.testing.assert_allclose(picture.depth_m, ideal.depth_m, rtol=1e-6)
    gain, offset = exposure(ideal.rgb, clean)
    np.testing.assert_allclose(picture.rgb, np.clip(gain * ideal.rgb + offset, 0, 255), atol=0.51)


def test_what_is_too_far_has_no_depth(cell):
    *_, data, camera = cell
    ideal = camera.ideal(data, look())
    noise = DepthNoiseCfg(sigma_m=0.0, dropout=0.0, range_m=0.88)
    picture = camera.sense(ideal, look(), noise, np.random.default_rng(0))
    np.testing.assert_array_equal(np.isnan(picture.depth_m), ideal.depth_m > 0.88)


@pytest.mark.parametrize("contrast", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("brightness", [-0.3, 0.0, 0.3])
def test_at_most_two_percent_clip(contrast, brightness):
    rgb = np.random.default_rng(0).uniform(5.0, 240.0, (80, 60, 3))
    noisy = look(contrast=contrast, brightness=brightness, noise_sigma=8.0)
    gain, offset = exposure(rgb, noisy)
    grey = gain * rgb + offset
    assert ((grey < 0) | (grey > 255)).any(axis=2).mean() <= 0.02
    unbound = exposure(rgb, look(contrast=contrast, brightness=brightness, clip_fraction=1.0))
    assert unbound == pytest.approx((1 + contrast, 127.5 * -contrast + 255 * brightness))


def test_the_observer_finds_the_middles_of_clean_zones(cell):
    layout, pose, data, camera = cell
    picture = camera.sense(
        camera.ideal(data, look()), look(), DepthNoiseCfg(sigma_m=0.0, dropout=0.0), np.random.default_rng(0)
    )
    seen = observe(picture.rgb, picture.depth_m, CAMERA)
    targets = layout.target_m @ pose[:3, :3].T + pose[:3, 3]
    away = np.linalg.norm(seen.position_m[:, None] - targets, axis=2)
    assert away.shape == (len(targets),) * 2 and away.min(axis=0).max() < 0.004


def test_nothing_red_is_nothing_seen():
    grey = np.full((480, 400, 3), 128, np.uint8)
    assert observe(grey, np.full((480, 400), 0.86), CAMERA).position_m.shape == (0, 3)


def test_targets_are_chosen_by_class():
    points = np.arange(9.0).reshape(3, 3)
    np.testing.assert_array_equal(targets_of(Regions(points, ("cable", "tie", "target"))), points[1:])
    assert targets_of(Regions(np.empty((0, 3)), ())).shape == (0, 3)


def test_wrong_settings_are_refused():
    with pytest.raises(ConfigError, match="dropout"):
        DepthNoiseCfg(dropout=1.5)
