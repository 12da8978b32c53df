"""A part's pose from its AR code, against poses that were drawn and OpenCV's projection."""

import dataclasses

import cv2
import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import axis_angle, transform, yaw_pose
from seal_gym.sim.markers import ShotCfg, part_marker, shoot_marker
from seal_gym.vision.part_pose import PartMarker, level_part_pose, part_pose, refine_corners
from seal_gym.workpieces import catalogue

CELL = load_cell()
CAMERA = CELL.overhead
MARKERS = {name: part_marker(catalogue.get(name), CELL.marker) for name in catalogue.NAMES}


def corners_seen(marker, pose):
    """The code's corners by OpenCV's projection, in pixels from the picture's corner."""
    T = np.linalg.inv(CAMERA.pose) @ pose @ marker.T_part_marker
    pixels, _ = cv2.projectPoints(
        marker.corners_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], CAMERA.matrix, None
    )
    return pixels[:, 0]


def displaced(name, rng, shift=0.04, yaw=0.44):
    return catalogue.get(name).pose @ yaw_pose(*rng.uniform(-shift, shift, 2), 0.0, rng.uniform(-yaw, yaw))


def off(seen, true):
    """Position [mm] and yaw [deg] of the error."""
    d = np.linalg.inv(true) @ seen
    return 1e3 * np.linalg.norm(d[:3, 3]), np.rad2deg(np.arctan2(d[1, 0], d[0, 0]))


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_exact_corners_give_the_exact_pose(name):
    rng = np.random.default_rng(0)
    marker = MARKERS[name]
    for _ in range(5):
        true = displaced(name, rng)
        corners = corners_seen(marker, true)
        level = level_part_pose(corners, marker, CAMERA, float(true[2, 3]))
        np.testing.assert_allclose(level.T_world_part, true, atol=1e-7)
        assert level.residual_px < 1e-4
        free = part_pose(corners, marker, CAMERA)
        np.testing.assert_allclose(free.T_world_part, true, atol=1e-4)
        assert free.residual_px < 1e-2


def test_all_six_freedoms_are_read_where_perspective_shows_them():
    """A code of 160 mm, raised and tilted by 30 deg."""
    marker = PartMarker(id=3, size_m=0.16, T_part_marker=transform(np.eye(3), np.array([0.03, -0.02, 0.0])))
    true = yaw_pose(0.40, 0.05, 0.1, 0.4) @ transform(axis_angle(np.array([0.6, 0.8, 0]), 0.5), np.zeros(3))
    seen = part_pose(corners_seen(marker, true), marker, CAMERA)
    np.testing.assert_allclose(seen.T_world_part, true, atol=1e-5)


def test_noisy_pictures_of_many_displaced_parts():
    """Sensor noise of 8 grey levels, the dynamic regime's +-40 mm and +-25 deg."""
    rng = np.random.default_rng(1)
    found = []
    for k in range(18):
        name = catalogue.NAMES[k % 3]
        true = displaced(name, rng)
        corners = MARKERS[name].find(shoot_marker(MARKERS[name], true, CAMERA, rng, ShotCfg()))
        assert corners is not None
        assert np.abs(corners - corners_seen(MARKERS[name], true)).max() < 0.2
        seen = level_part_pose(corners, MARKERS[name], CAMERA, float(true[2, 3]))
        found.append(off(seen.T_world_part, true))
    rms = np.sqrt((np.array(found) ** 2).mean(axis=0))
    assert rms[0] < 0.2 and rms[1] < 0.07


def test_corners_are_found_without_bias():
    """OpenCV's own sub-pixel corners shrink the code; ours average to the truth."""
    rng = np.random.default_rng(2)
    marker, inward = MARKERS["cylinder"], []
    for _ in range(10):
        true = displaced("cylinder", rng)
        cfg = ShotCfg(noise_sigma=2.0)
        corners, exact = marker.find(shoot_marker(marker, true, CAMERA, rng, cfg)), corners_seen(marker, true)
        middle = exact.mean(axis=0)
        inward.append(np.linalg.norm(corners - middle, axis=1) - np.linalg.norm(exact - middle, axis=1))
    assert abs(np.mean(inward)) < 0.02


def test_a_shadows_edge_across_the_code_does_no_harm():
    marker, true = MARKERS["flat"], catalogue.get("flat").pose
    image = shoot_marker(marker, true, CAMERA, np.random.default_rng(0), ShotCfg(noise_sigma=1.0)).astype(
        float
    )
    exact = corners_seen(marker, true)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    x, y = exact.mean(axis=0)
    shadow = (columns - x) + 0.4 * (rows - y) > 12
    image[shadow] *= 0.6
    corners = marker.find(image.astype(np.uint8))
    assert np.abs(corners - exact).max() < 0.1


def test_refinement_starts_from_a_pixel_off():
    marker, true = MARKERS["flat"], catalogue.get("flat").pose
    image = shoot_marker(marker, true, CAMERA, np.random.default_rng(0), ShotCfg(noise_sigma=0.0))
    exact = corners_seen(marker, true)
    rough = exact + np.array([[1.0, -1.0], [-1.0, 0.5], [0.7, 1.0], [-1.0, -1.0]])
    assert np.abs(refine_corners(image, rough) - exact).max() < 0.05


def test_no_code_or_two_or_another_is_a_value():
    marker = MARKERS["flat"]
    empty = np.full((480, 640), 120, np.uint8)
    assert marker.find(empty) is None
    label = marker.picture(10)
    one = empty.copy()
    one[100:180, 100:180] = label
    assert marker.find(one) is not None
    assert marker.find(np.repeat(one[..., None], 3, axis=-1)) is not None
    assert dataclasses.replace(marker, id=8).find(one) is None
    two = one.copy()
    two[300:380, 300:380] = label
    assert marker.find(two) is None


def test_the_label_and_the_corners_in_order():
    marker = PartMarker(id=7, size_m=0.06, T_part_marker=np.eye(4))
    label = marker.picture(10)
    assert label.shape == (80, 80) and marker.label_m == pytest.approx(0.08)
    assert (label[:10] == 255).all() and (label[10:20, 10:70] == 0).all()
    np.testing.assert_allclose(
        marker.corners_m, [[-0.03, 0.03, 0], [0.03, 0.03, 0], [0.03, -0.03, 0], [-0.03, -0.03, 0]]
    )
    page = np.full((200, 200), 255, np.uint8)
    page[50:130, 40:120] = label
    np.testing.assert_allclose(marker.find(page), [[50, 60], [110, 60], [110, 120], [50, 120]], atol=0.02)
    upside_down = np.ascontiguousarray(page[::-1, ::-1])
    np.testing.assert_allclose(
        marker.find(upside_down), [[150, 140], [90, 140], [90, 80], [150, 80]], atol=0.02
    )


def test_a_part_that_is_not_at_the_height_shows_a_residual():
    marker, true = MARKERS["cylinder"], catalogue.get("cylinder").pose
    corners = corners_seen(marker, true)
    right, wrong = (level_part_pose(corners, marker, CAMERA, true[2, 3] + h).residual_px for h in (0.0, 0.02))
    # 2 % of the distance, half the diagonal of 72 px.
    assert right < 1e-3 and wrong == pytest.approx(0.02 * 72 / np.sqrt(2), rel=0.15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": 50}, r"id = 50: must be a whole number in 0\.\.49"),
        ({"size_m": 0.0}, r"size_m = 0\.0: must be a finite number > 0"),
        ({"T_part_marker": np.eye(3)}, r"shape \(4, 4\)"),
        ({"T_part_marker": np.full((4, 4), np.nan)}, "finite"),
    ],
)
def test_bad_markers_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(MARKERS["flat"], **change)
