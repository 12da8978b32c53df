"""The cell's file: every key checked; the cameras against OpenCV and the textbook."""

import dataclasses
import tomllib

import cv2
import numpy as np
import pytest

from seal_gym.core.cell import (
    CalibrationCfg,
    CameraCfg,
    CellCfg,
    LimitsCfg,
    MarkerCfg,
    OverheadCfg,
    ProcessCfg,
    TimingCfg,
    load_cell,
    with_cameras,
)
from seal_gym.core.errors import ConfigError
from seal_gym.core.paths import asset

TEXT = asset("ur5_sealgun", "cell.toml").read_text(encoding="utf-8")
CELL = load_cell()


def load(tmp_path, text):
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    load_cell.cache_clear()
    return load_cell(path)


def with_value(section, key, value):
    """The file with one key's line changed (or dropped, for None)."""
    out, here = [], ""
    for line in TEXT.splitlines():
        if line.startswith("["):
            here = line[1 : line.index("]")]
        hit = here == section and line.split("=")[0].strip() == key
        new = "" if value is None else f"{key} = {value}"
        out.append(new if hit else line)
    assert "\n".join(out) != TEXT.rstrip("\n")
    return "\n".join(out)


def keys():
    table = tomllib.loads(TEXT)
    sections = {k: v for k, v in table.items() if k != "camera"}
    sections |= {f"camera.{view}": v for view, v in table["camera"].items()}
    return [(section, key, value) for section, values in sections.items() for key, value in values.items()]


def test_the_shipped_file_holds_the_protocols_numbers():
    assert CELL.process == ProcessCfg(stand_off_m=0.003, speed_m_s=0.01, mouth_radius_m=0.0015)
    assert (CELL.timing.frame_rate_hz, CELL.front.roi_px, CELL.side.roi_px) == (30, (50, 100), (100, 50))
    assert CELL.cameras == (CELL.front, CELL.side)
    assert CELL.timing.substeps * CELL.timing.step_s == pytest.approx(1 / 30, rel=1e-15)


@pytest.mark.parametrize(("section", "key"), [(s, k) for s, k, _ in keys()])
def test_a_missing_key_is_named(tmp_path, section, key):
    with pytest.raises(ConfigError, match=rf"\[{section}\].*{key}.*missing"):
        load(tmp_path, with_value(section, key, None))


@pytest.mark.parametrize("section", sorted({s for s, _, _ in keys()}))
def test_an_unknown_key_is_named(tmp_path, section):
    with pytest.raises(ConfigError, match=rf"\[{section}\].*unknown.*'colour'"):
        load(tmp_path, TEXT.replace(f"[{section}]", f"[{section}]\ncolour = 1 #"))


@pytest.mark.parametrize("section", sorted({s for s, _, _ in keys()}))
def test_a_missing_section_is_named(tmp_path, section):
    lines, keep = [], True
    for line in TEXT.splitlines():
        keep = not line.startswith(f"[{section}]") if line.startswith("[") else keep
        if keep:
            lines.append(line)
    with pytest.raises(ConfigError, match=rf"section \[{section}\] missing"):
        load(tmp_path, "\n".join(lines))


SCALARS = [(s, k) for s, k, v in keys() if not isinstance(v, list) and (s, k) != ("marker", "id")]
VECTORS = [(s, k, v) for s, k, v in keys() if isinstance(v, list)]


@pytest.mark.parametrize("bad", ["0", "-1", "nan", "inf"])
@pytest.mark.parametrize(("section", "key"), SCALARS)
def test_a_scalar_out_of_range_is_named(tmp_path, section, key, bad):
    with pytest.raises(ConfigError, match=rf"{key} = {float(bad):g}(\.0)?: must be"):
        load(tmp_path, with_value(section, key, bad))


@pytest.mark.parametrize("bad", ["short", "nan"])
@pytest.mark.parametrize(("section", "key", "value"), VECTORS)
def test_a_vector_of_wrong_length_or_not_finite_is_named(tmp_path, section, key, value, bad):
    wrong = value[:-1] if bad == "short" else [float("nan"), *value[1:]]
    cfg = {"calibration": "CalibrationCfg", "camera.overhead": "OverheadCfg"}.get(section, "CameraCfg")
    with pytest.raises(ConfigError, match=rf"^{cfg}\.{key} = .*must be {len(value)} finite numbers"):
        load(tmp_path, with_value(section, key, str(wrong)))


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("timing", "substeps", "7.5", "whole number"),
        ("camera.front", "roi_px", "[4, 100]", "8..1024"),
        ("camera.side", "roi_px", "[100, 2000]", "8..1024"),
        ("camera.side", "roi_px", "[100.5, 50]", "whole numbers"),
        ("camera.front", "up", "[0.0, 47.0, 98.0]", "parallel"),
        ("camera.front", "target_mm", "[0.0, 110.0, 193.0]", "behind the camera"),
        ("camera.front", "tip_px", "[25.0, 101.0]", r"must lie in the ROI of \(50, 100\) pixels"),
        ("camera.side", "tip_px", "[-1.0, 20.0]", r"must lie in the ROI of \(100, 50\) pixels"),
        ("camera.overhead", "up", "[0.0, 0.0, 2.0]", "parallel"),
        ("camera.overhead", "frame_px", "[1280, 9600]", r"OverheadCfg\.frame_px.*8\.\.4096"),
        ("calibration", "frame_px", "[640.5, 480]", r"CalibrationCfg\.frame_px.*whole numbers in 8\.\.1024"),
        ("calibration", "squares", "[2, 7]", r"3\.\.20"),
        ("calibration", "marker_mm", "12.0", r"smaller than square_mm = 12\.0"),
        ("marker", "id", "50", r"id = 50: must be a whole number in 0\.\.49"),
        ("marker", "id", "-1", r"0\.\.49"),
        ("marker", "id", "1.5", "whole number"),
        ("process", "stand_off_m", "3", r"stand_off_m = 3: must be at most 0\.05; check the unit"),
        ("process", "speed_m_s", "10.0", r"speed_m_s = 10\.0: must be at most 1; check the unit"),
        ("process", "mouth_radius_m", "1.5", "at most 0.02; check the unit"),
    ],
)
def test_other_impossible_values_are_named(tmp_path, section, key, value, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, with_value(section, key, value))


def test_not_toml_and_no_file(tmp_path):
    with pytest.raises(ConfigError, match="not valid TOML"):
        load(tmp_path, "[process\n")
    with pytest.raises(FileNotFoundError):
        load_cell(tmp_path / "none.toml")


def test_a_changed_value_arrives(tmp_path):
    cell = load(tmp_path, with_value("process", "speed_m_s", "0.02"))
    assert cell.process.speed_m_s == 0.02
    assert dataclasses.replace(cell, process=CELL.process) == CELL


CONFIGS = [CalibrationCfg, CameraCfg, CellCfg, LimitsCfg, MarkerCfg, OverheadCfg, ProcessCfg, TimingCfg]


@pytest.mark.parametrize("cls", CONFIGS)
def test_configs_are_frozen(cls):
    assert cls.__dataclass_params__.frozen


def look_at(camera):
    """Rows: the camera's right, down and forward in the tip frame."""
    eye, target = np.array(camera.position_mm) / 1e3, np.array(camera.target_mm) / 1e3
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    return eye, np.stack((right, np.cross(forward, right), forward))


@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_projection_is_the_textbooks_and_opencvs(camera):
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.02, 0.02, (500, 3))
    eye, axes = look_at(camera)
    seen, mouth = (points - eye) @ axes.T, axes @ -eye
    f = camera.focal_px
    centre = np.array(camera.tip_px) - f * mouth[:2] / mouth[2]
    by_hand = f * seen[:, :2] / seen[:, 2:] + centre
    matrix = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1.0]])
    by_cv2, _ = cv2.projectPoints(points, cv2.Rodrigues(axes)[0], -axes @ eye, matrix, None)
    actual = camera.project(points)
    np.testing.assert_allclose(actual, by_hand, atol=1e-9, rtol=0)
    np.testing.assert_allclose(actual, by_cv2[:, 0], atol=1e-9, rtol=0)
    np.testing.assert_allclose(camera.project(points[0]), actual[0], atol=0)


@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
def test_camera_frame_is_a_rotation_with_the_mouth_at_its_pixel(camera):
    _, axes = look_at(camera)
    np.testing.assert_allclose(camera.rotation, axes.T, atol=1e-15)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(camera.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.project(np.zeros(3)), camera.tip_px, atol=1e-12)
    assert (camera.width, camera.height) == camera.roi_px


def test_what_is_up_and_right_in_the_images():
    """Front: travel is up, right is right. Side: travel is right, the tip's z is up."""
    ahead, right, back = np.eye(3)[[1, 0, 2]] * 1e-3
    front = [CELL.front.project(p) - CELL.front.tip_px for p in (ahead, right)]
    side = [CELL.side.project(p) - CELL.side.tip_px for p in (ahead, back)]
    assert front[0][1] < -1 and front[1][0] > 1
    assert side[0][0] > 1 and side[1][1] < -1
    # 0.2-0.4 mm per pixel at the seam.
    for step in (front[0], front[1], side[0]):
        assert 0.2 < 1.0 / np.linalg.norm(step) < 0.4


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("speed_m_s = 0.010", 'speed_m_s = "fast"', r"speed_m_s = 'fast'.*finite number > 0"),
        ("focal_px = 400.0", "focal_px = true", r"focal_px = True"),
        ("up = [0.0, 1.0, 0.0]", "up = 1.0", r"up = 1\.0: must be 3 finite numbers"),
        ("[process]", "[robot]\nname = 'x'\n[process]", r"unknown \['robot'\]; the sections are"),
        ("[camera.side]", "[camera.rear]\nup = [0]\n[camera.side]", r"unknown \['rear'\]; the cameras are"),
        ("[camera.front] ", "[camera.front]\nname = 'left' #", r"\[camera.front\]: unknown \['name'\]"),
        ("[process]", "[process]\nflow = 1", r"\[process\]: unknown \['flow'\]"),
    ],
)
def test_wrong_types_and_sections_are_named(tmp_path, old, new, message):
    text = asset("ur5_sealgun", "cell.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "cell.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_cell(path)


@pytest.mark.parametrize("text", ["camera = 3", "[camera]\nfront = 3\nside = 3\noverhead = 3"])
def test_cameras_that_are_no_sections_are_named(tmp_path, text):
    rest = [part for part in TEXT.split("\n\n") if not part.startswith("[camera")]
    with pytest.raises(ConfigError, match="must be a section with keys, not 3"):
        load(tmp_path, text + "\n" + "\n\n".join(rest))


@pytest.mark.parametrize("camera", CELL.cameras, ids=lambda c: c.name)
@pytest.mark.parametrize("size", [(640, 480), (641, 483), (24, 24), (1024, 8)])
def test_a_window_is_the_same_camera_with_pixels_counted_from_another_corner(camera, size):
    if not all(
        0 <= t + int((n - w) / 2) <= n for t, n, w in zip(camera.tip_px, size, camera.roi_px, strict=True)
    ):
        with pytest.raises(ConfigError, match="must lie in the ROI"):
            camera.window(size)
        return
    wide = camera.window(size)
    points = np.random.default_rng(0).uniform(-0.02, 0.02, (50, 3))
    shift = wide.project(points) - camera.project(points)
    corner = [int((n - w) / 2) for n, w in zip(size, camera.roi_px, strict=True)]
    np.testing.assert_allclose(shift, np.tile(corner, (50, 1)), atol=1e-9)
    assert (wide.width, wide.height) == size
    assert wide.window(camera.roi_px) == camera


def test_the_whole_frame_holds_the_roi_in_its_middle():
    for camera in CELL.cameras:
        wide = camera.window(CELL.calibration.frame_px)
        left_top = np.subtract(wide.tip_px, camera.tip_px)
        right_bottom = np.subtract(wide.roi_px, left_top + camera.roi_px)
        assert (left_top > 100).all() and (np.abs(left_top - right_bottom) <= 1).all()


def test_the_overhead_camera_looks_down_with_up_away_from_the_robot():
    camera = CELL.overhead
    seen = [np.linalg.inv(camera.pose) @ [*p, 1.0] for p in ((0.43, 0.0, -0.05), (0.53, -0.2, -0.05))]
    pixels = [camera.matrix @ p[:3] / p[2] for p in seen]
    np.testing.assert_allclose(pixels[0][:2], [640, 480], atol=1e-9)
    # 0.1 m away from the robot and 0.2 m to its right, 1 m below: 180 px up and 360 px to the right.
    np.testing.assert_allclose(pixels[1][:2], [640 + 360, 480 - 180], atol=1e-9)
    assert np.linalg.det(camera.pose[:3, :3]) == pytest.approx(1.0)


def test_cameras_are_written_into_the_file_and_read_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(3)
    new = [
        dataclasses.replace(
            camera,
            position_mm=tuple(map(float, camera.position_mm + rng.normal(0, 1, 3))),
            target_mm=tuple(map(float, camera.target_mm + rng.normal(0, 1, 3))),
            up=tuple(map(float, camera.up + rng.normal(0, 0.1, 3))),
            focal_px=float(camera.focal_px + rng.normal()),
            tip_px=tuple(map(float, camera.tip_px + rng.normal(0, 1, 2))),
        )
        for camera in CELL.cameras
    ]
    text = with_cameras(TEXT, new)
    assert load(tmp_path, text) == dataclasses.replace(CELL, front=new[0], side=new[1])
    comments = [[line.split("#")[1] for line in t.splitlines() if "#" in line] for t in (TEXT, text)]
    assert comments[0] == comments[1]
    assert with_cameras(text, CELL.cameras) == with_cameras(TEXT, CELL.cameras)
    only = load(tmp_path, with_cameras(TEXT, new[1:]))
    assert (only.front, only.side) == (CELL.front, new[1])


def test_a_camera_the_file_does_not_have_is_named():
    stranger = dataclasses.replace(CELL.front, name="rear")
    with pytest.raises(ConfigError, match=r"no section \['\[camera.rear\]'\]"):
        with_cameras(TEXT, [stranger])
