"""Prints as cameras see them, against the pinhole formula and MuJoCo; labels change neither touch nor ROI."""

import dataclasses

import cv2
import mujoco
import numpy as np
import pytest

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError, SeamError
from seal_gym.core.frames import axis_angle, quat_from_matrix, tip_rotation, transform
from seal_gym.sim import gl, markers
from seal_gym.sim.arm import ArmBatch
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.markers import ShotCfg, add_label, marker_place, part_marker, shoot, shoot_board
from seal_gym.sim.reach import check_reach
from seal_gym.sim.scene import GROUP_COLLISION, GROUP_PART, build_scene
from seal_gym.vision.calibration import Board
from seal_gym.vision.part_pose import level_part_pose
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.workpiece import Workpiece

CELL = load_cell()
CLEAN = ShotCfg(noise_sigma=0.0, blur_px=0.0, black=0.0, white=200.0, surround=0.0)
NO_TOOL = np.empty((0, 3, 3))


def spot_seen(x_m, y_m, T_camera_print, matrix, cfg=CLEAN):
    """Centroid of a white disc's picture, the disc of 1 mm radius at (x, y) of a print of 40 x 30 mm."""
    picture = np.zeros((600, 800), np.uint8)  # 20 px a mm
    cv2.circle(
        picture, (round(320 * x_m * 1e3) - 8, round(320 * y_m * 1e3) - 8), 320, 255, -1, cv2.LINE_AA, 4
    )
    image = shoot(
        picture, (0.04, 0.03), T_camera_print, matrix, (120, 100), np.random.default_rng(0), cfg
    ).astype(float)
    rows, columns = np.mgrid[:100, :120] + 0.5
    return np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()


@pytest.mark.parametrize("place", [(0.01, 0.01), (0.02, 0.015), (0.03, 0.02)])
@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_a_print_is_seen_where_the_pinhole_formula_says(place, tilt):
    matrix = np.array([[300.0, 0.0, 55.0], [0.0, 300.0, 52.0], [0.0, 0.0, 1.0]])
    turn = axis_angle(np.array([0.6, 0.8, 0.0]), tilt)
    pose = transform(turn, np.array([0.0, 0.0, 0.12]) - turn @ [0.02, 0.015, 0.0])
    p = pose[:3, :3] @ [*place, 0.0] + pose[:3, 3]
    expected = matrix[:2, 2] + 300.0 * p[:2] / p[2]
    assert np.abs(spot_seen(*place, pose, matrix) - expected).max() < 0.04
    for blur, samples in ((1.5, 4), (0.0, 1)):
        cfg = dataclasses.replace(CLEAN, blur_px=blur, supersample=samples)
        assert np.abs(spot_seen(*place, pose, matrix, cfg) - expected).max() < 0.1


def test_levels_noise_and_surround_are_as_asked():
    cfg = ShotCfg(black=30.0, white=200.0, surround=90.0, noise_sigma=5.0, blur_px=0.5)
    half = np.zeros((100, 100), np.uint8)
    half[:, 50:] = 255
    pose = transform(np.eye(3), np.array([-0.05, -0.05, 0.2]))  # 100 mm square, its middle ahead
    matrix = np.array([[400.0, 0.0, 150.0], [0.0, 400.0, 120.0], [0.0, 0.0, 1.0]])
    image = shoot(half, (0.1, 0.1), pose, matrix, (300, 240), np.random.default_rng(1), cfg)
    assert image.shape == (240, 300) and image.dtype == np.uint8
    # The print spans columns 50..250 and rows 20..220, black on the left.
    for rows, columns, level in (
        (slice(30, 210), slice(55, 145), 30),
        (slice(30, 210), slice(155, 245), 200),
        (slice(30, 210), slice(2, 45), 90),
        (slice(2, 15), slice(55, 245), 90),
    ):
        patch = image[rows, columns].astype(float)
        assert patch.mean() == pytest.approx(level, abs=0.5)
        assert patch.std() == pytest.approx(5.0, rel=0.1)
    again = shoot(half, (0.1, 0.1), pose, matrix, (300, 240), np.random.default_rng(1), cfg)
    np.testing.assert_array_equal(image, again)


def test_what_stands_before_the_print_hides_it():
    white = np.full((50, 50), 255, np.uint8)
    pose = transform(np.eye(3), np.array([-0.05, -0.05, 0.2]))
    matrix = np.array([[400.0, 0.0, 100.0], [0.0, 400.0, 100.0], [0.0, 0.0, 1.0]])
    # Half as far, x from 0 to 10 mm: columns 100..140; and one behind the camera.
    near = np.array([[0.0, -0.01, 0.1], [0.01, -0.01, 0.1], [0.0, 0.01, 0.1]])
    image = shoot(
        white, (0.1, 0.1), pose, matrix, (200, 200), np.random.default_rng(0), CLEAN, np.stack((near, -near))
    )
    assert image[70, 105] == 0 and image[65, 130] == 0
    assert image[130, 135] == 200 and image[100, 95] == 200 and image[50, 120] == 200
    # Legs of 40 and 80 px.
    assert (image == 0).sum() == pytest.approx(1600, rel=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"black": -1.0}, r"black = -1\.0: must be within 0\.\.255"),
        ({"noise_sigma": 200.0}, r"within 0\.\.128"),
        ({"blur_px": 11.0}, r"blur_px = 11\.0: must be within 0\.\.10"),
        ({"supersample": 0}, r"supersample = 0: must be a whole number in 1\.\.16"),
        ({"white": float("nan")}, "white = nan"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        ShotCfg(**change)


@pytest.mark.parametrize("name", catalogue.NAMES)
def test_the_codes_place_is_bare_plate_far_from_the_seam(name):
    part = catalogue.get(name)
    marker = part_marker(part, CELL.marker)
    x, y, z = marker.T_part_marker[:3, 3]
    assert marker.label_m == pytest.approx(0.04 * 8 / 6)
    assert 0 < z < 2e-4
    np.testing.assert_array_equal(marker.T_part_marker[:3, :3], np.eye(3))
    # Within the plate of catalogue.py, off the wall, by the label's half and 5 mm.
    reach = marker.label_m / 2 + 4.9e-3
    low, high = {
        "flat": ((-0.20, -0.09), (0.20, 0.04)),
        "cylinder": ((-0.13, -0.15), (0.15, 0.15)),
        "rectangular": ((-0.115, -0.15), (0.14, 0.15)),
    }[name]
    assert low[0] + reach <= x <= high[0] - reach and low[1] + reach <= y <= high[1] - reach
    gap = {
        "flat": -y,
        "cylinder": max(abs(x), abs(y)) - 0.07,
        "rectangular": max(-0.095 - x, x - 0.06, abs(y) - 0.07715),
    }[name]
    assert gap >= reach
    seam = part.seam.at(np.linspace(0, part.seam.length, 500)).position[:, :2]
    away = np.linalg.norm(seam - [x, y], axis=1).min() - marker.label_m / np.sqrt(2)
    assert away > 0.015  # no ROI at the seam reaches it


def test_a_part_without_room_is_named():
    narrow = Workpiece.from_polyline(
        [[-0.1, 0, 0], [0.1, 0, 0]], [0, 0, 1], joint="groove", groove_width=2e-3, name="narrow"
    )
    assert marker_place(narrow, 0.04).shape == (4, 4)
    with pytest.raises(SeamError, match=r"'narrow' has no place for a label of 90 mm: make the code smaller"):
        marker_place(narrow, 0.09)


@pytest.fixture(scope="module", params=catalogue.NAMES)
def scenes(request):
    """A part's scene without and with its code."""
    return [build_scene(catalogue.get(request.param), CELL, marked=marked) for marked in (False, True)]


def test_the_code_is_seen_and_never_felt(scenes):
    plain, marked = scenes
    assert plain.marker is None and marked.marker is not None
    geom = marked.model.geom("marker")
    assert (geom.contype[0], geom.conaffinity[0], geom.group[0]) == (0, 0, GROUP_PART)
    assert marked.model.ngeom == plain.model.ngeom + 1 and marked.model.ncam == plain.model.ncam + 1
    assert marked.model.nv == plain.model.nv
    np.testing.assert_array_equal(marked.model.body_mass, plain.model.body_mass)
    reach = check_reach(plain, 0.02, np.deg2rad(15.0))
    runs = []
    for scene in scenes:
        arm, rng = ArmBatch(scene, 1), np.random.default_rng(0)
        arm.reset(0, reach.start_q, reach.part_pose)
        touched = []
        for _ in range(30):
            arm.place_part(0, reach.part_pose @ transform(np.eye(3), rng.uniform(-0.02, 0.02, 3)))
            touched.append(bool(arm.step(rng.uniform(-3, 3, (1, 6)))[0]))
        runs.append((touched, arm.q.copy(), arm.qd.copy()))
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.gl
def test_the_sensor_cameras_do_not_see_the_code(scenes):
    part = scenes[0].workpiece
    look = Look.empty(1)
    look.draw(0, np.random.default_rng(0), LookCfg.clean())
    sensors = [gl.GlSensors(scene) for scene in scenes]
    for s in np.linspace(0.0, part.seam.length, 4):
        p, t, a = part.seam.at(s)
        tip = part.pose @ transform(tip_rotation(t, a), p + 0.015 * a)
        frame = np.zeros(1, np.uint64)
        plain, marked = (x.render(tip[None], part.pose[None], look, frame) for x in sensors)
        np.testing.assert_array_equal(plain.front, marked.front)
        np.testing.assert_array_equal(plain.side, marked.side)


@pytest.mark.gl
def test_the_code_in_mujocos_picture_gives_the_parts_pose(scenes):
    """The whole scene from above: arm, gun and shadows; the simulator knows the pose."""
    scene = scenes[1]
    task = (0.02, np.deg2rad(15.0))
    reach = check_reach(scene, *task)
    arm, rng = ArmBatch(scene, 1), np.random.default_rng(4)
    option = mujoco.MjvOption()
    option.geomgroup[GROUP_COLLISION] = 0
    width, height = CELL.overhead.frame_px
    with gl.offscreen(scene.model, height, width) as renderer:
        for _ in range(3):
            shift, yaw = rng.uniform(-2, 2, 2) * task[0], rng.uniform(-1.6, 1.6) * task[1]
            arm.reset(
                0,
                reach.start_q,
                reach.part_pose @ transform(axis_angle(np.eye(3)[2], yaw), np.array([*shift, 0])),
            )
            data = arm.data(0)
            renderer.update_scene(data, camera="overhead", scene_option=option)
            corners = scene.marker.find(renderer.render())
            assert corners is not None
            body = data.body("part")
            seen = level_part_pose(corners, scene.marker, CELL.overhead, float(body.xpos[2])).T_world_part
            assert np.linalg.norm(seen[:3, 3] - body.xpos) < 1e-4
            turn = body.xmat.reshape(3, 3).T @ seen[:3, :3]
            assert abs(np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0]))) < 0.04


@pytest.mark.gl
@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_mujoco_sees_the_board_where_the_software_renderer_does(camera):
    board, wide = Board.of(CELL.calibration), camera.window(CELL.calibration.frame_px)
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = wide.roi_px
    spec.visual.headlight.ambient = [1.0] * 3
    spec.visual.headlight.diffuse = [0.0] * 3
    spec.visual.map.znear = 0.001
    spec.stat.extent = 1.0
    body = spec.worldbody.add_body(name="board", pos=[0.01, 0.0, -0.03])
    add_label(spec, body, "print", board.picture(60), board.size_m, np.eye(4), GROUP_PART)
    # The world is the tip's frame; MuJoCo's camera looks along -z.
    element = spec.worldbody.add_camera(
        name="eye",
        pos=wide.position_m,
        quat=quat_from_matrix(wide.rotation @ np.diag([1.0, -1.0, -1.0])),
        resolution=list(wide.roi_px),
        focal_pixel=[wide.focal_px] * 2,
        principal_pixel=np.array(wide.roi_px) / 2 - wide.centre_px,
    )
    element.sensor_size = np.array(wide.roi_px) * 1e-5
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with gl.offscreen(model, wide.height, wide.width) as renderer:
        renderer.update_scene(data, camera="eye")
        by_mujoco = board.find(renderer.render())
    T_world_board = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.01 - 0.06, 0.042, -0.03]))
    by_software = board.find(
        shoot_board(
            board, T_world_board, wide, np.eye(4), NO_TOOL, np.random.default_rng(0), ShotCfg(noise_sigma=0.0)
        )
    )
    for seen in (by_mujoco, by_software):
        assert len(seen.pixels) > 40
        points = seen.points_m @ T_world_board[:3, :3].T + T_world_board[:3, 3]
        off = seen.pixels - wide.project(points)
        assert np.abs(off.mean(axis=0)).max() < 0.03
        assert np.abs(off).max() < 0.25


def test_paper_lies_on_the_plate():
    assert 0 < markers.part_marker(catalogue.get("flat"), CELL.marker).T_part_marker[2, 3] <= 1e-4
