"""The sensor cameras found again from pictures of a board; the closed forms by hand and against OpenCV."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from seal_gym.core.cell import load_cell, with_cameras
from seal_gym.core.errors import ConfigError, SealGymError
from seal_gym.core.frames import transform
from seal_gym.core.paths import asset
from seal_gym.sim.markers import ShotCfg, shoot_board
from seal_gym.sim.scene import cached_scene
from seal_gym.vision.calibration import (
    Board,
    BoardCorners,
    CalibrationError,
    SolveCfg,
    as_grey,
    calibrate,
    camera_cfg,
    hand_eye,
)
from seal_gym.workpieces import catalogue

CELL = load_cell()
BOARD = Board.of(CELL.calibration)
FRAME = CELL.calibration.frame_px
EXACT = SolveCfg(tip_mm=1e-3, tip_deg=1e-3)
# The board lies on the world's xy plane, its middle at the origin, face up.
T_WORLD_BOARD = transform(np.diag([1.0, -1.0, -1.0]), np.array([-0.06, 0.042, 0.0]))


def tip_poses(n, rng, tilt=30.0):
    """The nozzle 12-60 mm above the board, upright to within the tilt, turned any way."""
    angles = np.column_stack((rng.uniform(-180, 180, n), rng.uniform(-tilt, tilt, (n, 2))))
    position = np.column_stack((rng.uniform(-0.015, 0.015, (n, 2)), rng.uniform(0.012, 0.06, n)))
    return transform(Rotation.from_euler("zxy", angles, degrees=True).as_matrix(), position)


def mount(camera):
    """T_tip_camera by hand from the file's numbers."""
    eye = np.array(camera.position_mm) / 1e3
    z = np.array(camera.target_mm) / 1e3 - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, camera.up)
    x /= np.linalg.norm(x)
    return transform(np.column_stack((x, np.cross(z, x), z)), eye)


def ideal(camera, tips, rng, sigma):
    """Corners by OpenCV's projection, those in the frame, with Gaussian errors."""
    matrix = np.eye(3)
    matrix[0, 0] = matrix[1, 1] = camera.focal_px
    matrix[:2, 2] = camera.centre_px
    out = []
    for tip in tips:
        pose = np.linalg.inv(tip @ mount(camera)) @ T_WORLD_BOARD
        pixels, _ = cv2.projectPoints(
            BOARD.corners_m, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], matrix, None
        )
        pixels = pixels[:, 0]
        inside = ((pixels > 5) & (pixels < np.subtract(FRAME, 5))).all(axis=1)
        out.append(
            BoardCorners(BOARD.corners_m[inside], (pixels + rng.normal(0, sigma, pixels.shape))[inside])
        )
    return out


def errors(found, true):
    """Of focal length [%], nozzle mouth [px], position [mm] and rotation [deg]."""
    roi = found.window(true.roi_px)
    turn = Rotation.from_matrix(mount(roi)[:3, :3].T @ mount(true)[:3, :3])
    return (
        100 * abs(roi.focal_px / true.focal_px - 1),
        np.linalg.norm(np.subtract(roi.tip_px, true.tip_px)),
        np.linalg.norm(np.subtract(roi.position_mm, true.position_mm)),
        np.rad2deg(turn.magnitude()),
    )


@pytest.fixture(scope="module", params=[0, 1], ids=["front", "side"])
def seen(request):
    """A camera, tip poses, and the corners found in noisy pictures with the nozzle before the board."""
    camera = CELL.cameras[request.param]
    rng = np.random.default_rng(11)
    tips, tool = tip_poses(24, rng), cached_scene(catalogue.get("flat"), CELL).tool
    wide = camera.window(FRAME)
    pictures = [shoot_board(BOARD, T_WORLD_BOARD, wide, tip, tool, rng, ShotCfg()) for tip in tips]
    return camera, tips, [BOARD.find(picture) for picture in pictures]


def test_the_cameras_are_recovered_from_noisy_pictures(seen, tmp_path):
    camera, tips, corners = seen
    found = calibrate(camera.name, FRAME, tips, corners, EXACT)
    focal_pct, tip_px, position_mm, rotation_deg = errors(found.camera, camera)
    assert focal_pct < 0.1
    assert tip_px < 0.05
    assert position_mm < 0.08
    assert rotation_deg < 0.03
    assert found.views == 24 and len(found.errors_px) == sum(len(c.pixels) for c in corners) > 700
    assert np.median(np.linalg.norm(found.errors_px, axis=1)) < 0.15
    np.testing.assert_allclose(found.T_world_board[:3, 3], T_WORLD_BOARD[:3, 3], atol=1e-4)
    # And what was found is a cell file's camera.
    path = tmp_path / "cell.toml"
    text = asset("ur5_sealgun", "cell.toml").read_text(encoding="utf-8")
    roi = found.camera.window(camera.roi_px)
    path.write_text(with_cameras(text, [roi]), encoding="utf-8")
    assert {c.name: c for c in load_cell(path).cameras}[camera.name] == roi


def test_an_arm_that_errs_costs_little():
    """Poses off by 0.05 mm and 0.02 deg: knowing that they may be is worth something."""
    camera, found = CELL.side, {"free": [], "tight": []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        tips = tip_poses(24, rng)
        corners = ideal(camera.window(FRAME), tips, rng, 0.1)
        turn = Rotation.from_rotvec(rng.normal(0, np.deg2rad(0.02), (24, 3))).as_matrix()
        reported = tips @ transform(turn, rng.normal(0, 5e-5, (24, 3)))
        for name, cfg in (("free", SolveCfg()), ("tight", EXACT)):
            found[name].append(errors(calibrate("side", FRAME, reported, corners, cfg).camera, camera))
    free, tight = (np.sqrt((np.array(found[k]) ** 2).mean(axis=0)) for k in ("free", "tight"))
    assert free[0] < 0.05 and free[1] < 0.12 and free[2] < 0.08 and free[3] < 0.03
    assert tight[2] > 1.5 * free[2] and tight[3] > 1.5 * free[3]


@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_without_noise_the_answer_is_exact(camera):
    rng = np.random.default_rng(5)
    tips = tip_poses(8, rng)
    found = calibrate(camera.name, FRAME, tips, ideal(camera.window(FRAME), tips, rng, 0.0), EXACT)
    assert max(errors(found.camera, camera)) < 1e-3
    assert np.abs(found.errors_px).max() < 1e-3
    np.testing.assert_allclose(found.T_world_board, T_WORLD_BOARD, atol=1e-6)


def test_wrong_corners_hardly_matter():
    camera = CELL.front
    rng = np.random.default_rng(6)
    tips = tip_poses(16, rng)
    corners = ideal(camera.window(FRAME), tips, rng, 0.08)
    spoilt = []
    for c in corners:
        pixels = c.pixels.copy()
        pixels[rng.choice(len(pixels), 2, replace=False)] += rng.uniform(2, 4, (2, 2))
        spoilt.append(BoardCorners(c.points_m, pixels))
    focal_pct, tip_px, position_mm, rotation_deg = errors(
        calibrate("front", FRAME, tips, spoilt, EXACT).camera, camera
    )
    assert focal_pct < 0.2 and tip_px < 0.1 and position_mm < 0.1 and rotation_deg < 0.05


def test_views_with_few_corners_are_left_out_and_too_few_views_are_refused():
    camera = CELL.side
    rng = np.random.default_rng(7)
    tips = tip_poses(6, rng)
    corners = ideal(camera.window(FRAME), tips, rng, 0.05)
    nothing = BOARD.find(np.full((480, 640), 90, np.uint8))
    assert nothing.points_m.shape == (0, 3) and nothing.pixels.shape == (0, 2)
    found = calibrate("side", FRAME, np.concatenate((tips, tips[:1])), [*corners, nothing])
    assert found.views == 6
    with pytest.raises(CalibrationError, match=r"4 of 5 pictures show 8 corners or more: at least 5"):
        calibrate("side", FRAME, tips[:5], [*corners[:4], nothing])
    assert issubclass(CalibrationError, SealGymError)


def test_tips_turned_about_one_axis_only_are_refused():
    """Along that axis the mount could be anywhere."""
    angles = np.linspace(-40, 40, 8)
    tips = transform(Rotation.from_euler("x", angles[:, None], degrees=True).as_matrix(), np.zeros((8, 3)))
    X = mount(CELL.front)
    with pytest.raises(CalibrationError, match="turned about one axis or less"):
        hand_eye(tips, np.linalg.inv(tips @ X) @ T_WORLD_BOARD)


@pytest.mark.parametrize("seed", range(5))
def test_hand_eye_is_exact_for_any_mount(seed):
    rng = np.random.default_rng(seed)
    X, board = (transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 0.1, 3)) for _ in range(2))
    tips = tip_poses(5, rng)
    np.testing.assert_allclose(hand_eye(tips, np.linalg.inv(tips @ X) @ board), X, atol=1e-9)


@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_a_mount_is_written_as_the_file_writes_it(camera):
    again = camera_cfg(camera.name, camera.roi_px, camera.focal_px, camera.centre_px, mount(camera))
    np.testing.assert_allclose(again.rotation, camera.rotation, atol=1e-12)
    np.testing.assert_allclose(again.position_mm, camera.position_mm, atol=1e-12)
    np.testing.assert_allclose(again.tip_px, camera.tip_px, atol=1e-9)
    np.testing.assert_allclose(again.centre_px, camera.centre_px, atol=1e-9)
    assert (again.name, again.roi_px, again.focal_px) == (camera.name, camera.roi_px, camera.focal_px)
    # Its target is the foot of the perpendicular from the mouth on the optical axis.
    assert abs(np.dot(again.target_mm, camera.rotation[:, 2])) < 1e-9


def test_the_print_is_the_board_it_says():
    """Corners where the squares meet, by the print's own pixels; found there again."""
    picture = BOARD.picture(96)
    assert picture.shape == (7 * 96, 10 * 96) and BOARD.size_m == (0.12, 0.084)
    assert BOARD.corners_m.shape == (54, 3)
    np.testing.assert_allclose(
        BOARD.corners_m[[0, 1, 9]], [[0.012, 0.012, 0], [0.024, 0.012, 0], [0.012, 0.024, 0]]
    )
    for x, y, _ in np.round(BOARD.corners_m / 0.012 * 96).astype(int):
        corner = picture[y - 2 : y + 2, x - 2 : x + 2] > 127
        assert (corner[:2, :2] == corner[0, 0]).all() and (corner[2:, 2:] == corner[0, 0]).all()
        assert (corner[:2, 2:] == ~corner[0, 0]).all() and (corner[2:, :2] == ~corner[0, 0]).all()
    margin = np.pad(picture, 96, constant_values=255)
    for image in (margin, np.repeat(margin[..., None], 3, axis=-1)):
        seen = BOARD.find(image)
        assert len(seen.pixels) == 54
        np.testing.assert_allclose(seen.pixels, 96 + seen.points_m[:, :2] / 0.012 * 96, atol=0.02)


def test_grey_of_colours():
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[0, 0], rgb[1, 1] = (255, 0, 0), (90, 90, 90)
    np.testing.assert_array_equal(as_grey(rgb), [[76, 0], [0, 90]])  # 0.299 R
    assert as_grey(rgb[..., 0]) is not None and as_grey(rgb[..., 0]).shape == (2, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_views": 2}, r"min_views = 2: must be a whole number >= 3"),
        ({"min_views": 5.5}, "whole number"),
        ({"min_corners": 3}, r"min_corners = 3: must be a whole number >= 4"),
        ({"corner_px": 0.0}, r"corner_px = 0\.0: must be a finite number > 0"),
        ({"outlier_px": float("inf")}, "outlier_px = inf"),
        ({"tip_mm": 0.0}, "tip_mm"),
        ({"tip_deg": -1.0}, "tip_deg"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(SolveCfg(), **change)
