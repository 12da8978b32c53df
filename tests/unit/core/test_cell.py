"""The cell's file: every key checked; the cameras against OpenCV and the textbook."""

import dataclasses
import tomllib

import cv2
import numpy as np
import pytest

from seal_gym.core.cell import CameraCfg, CellCfg, LimitsCfg, ProcessCfg, TimingCfg, load_cell
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


@pytest.mark.parametrize("section", ["process", "timing", "limits", "camera.front", "camera.side"])
def test_a_missing_section_is_named(tmp_path, section):
    lines, keep = [], True
    for line in TEXT.splitlines():
        keep = not line.startswith(f"[{section}]") if line.startswith("[") else keep
        if keep:
            lines.append(line)
    with pytest.raises(ConfigError, match=rf"section \[{section}\] missing"):
        load(tmp_path, "\n".join(lines))


SCALARS = [(s, k) for s, k, v in keys() if not isinstance(v, list)]
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
    with pytest.raises(ConfigError, match=rf"CameraCfg\.{key} = .*must be {len(value)} finite numbers"):
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


@pytest.mark.parametrize("cls", [CellCfg, CameraCfg, LimitsCfg, ProcessCfg, TimingCfg])
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
    ],
)
def test_wrong_types_and_sections_are_named(tmp_path, old, new, message):
    text = asset("ur5_sealgun", "cell.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "cell.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_cell(path)
