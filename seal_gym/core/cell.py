"""The cell's calibration: process constants, cameras, markers, timing and limits, from one file."""

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, normalise, transform
from seal_gym.core.paths import asset

VIEWS = ("front", "side")
OVERHEAD = "overhead"
_MAX_PIXELS = 4096
Vector = tuple[float, float, float]


def _positive(cfg: Any, *names: str) -> None:
    for name in names:
        value = getattr(cfg, name)
        require(
            is_number(value) and value > 0,
            f"{type(cfg).__name__}.{name} = {value!r}: must be a finite number > 0",
        )


def _at_most(cfg: Any, **highest: float) -> None:
    """Catches slips of the unit: 3 for 3 mm where metres are asked for."""
    for name, high in highest.items():
        value = getattr(cfg, name)
        require(
            value <= high,
            f"{type(cfg).__name__}.{name} = {value!r}: must be at most {high:g}; check the unit",
        )


def _vectors(cfg: Any, **lengths: int) -> None:
    for name, length in lengths.items():
        value = getattr(cfg, name)
        require(
            isinstance(value, tuple) and len(value) == length and all(map(is_number, value)),
            f"{type(cfg).__name__}.{name} = {value!r}: must be {length} finite numbers",
        )


def _whole_pair(cfg: Any, name: str, low: int, high: int) -> None:
    _vectors(cfg, **{name: 2})
    value = getattr(cfg, name)
    require(
        all(int(n) == n and low <= n <= high for n in value),
        f"{type(cfg).__name__}.{name} = {value!r}: width and height must be whole numbers in {low}..{high}",
    )


def _check_gaze(cfg: Any) -> None:
    forward = np.subtract(cfg.target_mm, cfg.position_mm)
    require(
        bool(np.linalg.norm(np.cross(forward, cfg.up)) > 1e-6),
        f"{type(cfg).__name__}.up = {cfg.up!r}: must not be parallel to the optical axis {tuple(forward)!r}",
    )


def _look_at(position_mm: Vector, target_mm: Vector, up: Vector) -> Array:
    """Rotation from the camera's frame (x right, y down, z forward) to the one it is mounted in."""
    forward = normalise(np.subtract(target_mm, position_mm).astype(np.float64))
    right = normalise(np.cross(forward, np.asarray(up, dtype=np.float64)))
    return np.stack((right, np.cross(forward, right), forward), axis=-1)


@dataclass(frozen=True, kw_only=True)
class ProcessCfg:
    """Process constants.

    Attributes:
        stand_off_m: Nozzle mouth to seam along the approach direction [m].
        speed_m_s: Nominal tip speed [m/s].
        mouth_radius_m: Outer radius of the nozzle mouth [m].
    """

    stand_off_m: float
    speed_m_s: float
    mouth_radius_m: float

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, *(f.name for f in fields(self)))
        _at_most(self, stand_off_m=0.05, speed_m_s=1.0, mouth_radius_m=0.02)


@dataclass(frozen=True, kw_only=True)
class CameraCfg:
    """A pinhole camera fixed to the tip, of which only the region of interest (ROI) is read.

    The camera frame is OpenCV's: x right, y down, z forward. Pixel coordinates are continuous, (0, 0)
    is the ROI's upper left corner and the first pixel's centre is (0.5, 0.5).

    Attributes:
        name: ``"front"`` or ``"side"``.
        position_mm: Optical centre in the tip frame [mm], 3 numbers.
        target_mm: A point on the optical axis in the tip frame [mm], 3 numbers.
        up: Direction in the tip frame that is up in the image, 3 numbers.
        roi_px: Width and height of the ROI [px].
        focal_px: Focal length [px].
        tip_px: Where the tip frame's origin is seen [px]; fixes the principal point.
    """

    name: str
    position_mm: tuple[float, float, float]
    target_mm: tuple[float, float, float]
    up: tuple[float, float, float]
    roi_px: tuple[int, int]
    focal_px: float
    tip_px: tuple[float, float]

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "focal_px")
        _vectors(self, position_mm=3, target_mm=3, up=3, tip_px=2)
        _whole_pair(self, "roi_px", 8, 1024)
        _check_gaze(self)
        forward = np.subtract(self.target_mm, self.position_mm)
        require(
            bool(forward @ np.negative(self.position_mm) > 0),
            f"CameraCfg.position_mm = {self.position_mm!r}: the nozzle mouth is behind the camera",
        )
        require(
            all(0.0 <= x <= n for x, n in zip(self.tip_px, self.roi_px, strict=True)),
            f"CameraCfg.tip_px = {self.tip_px!r}: must lie in the ROI of {self.roi_px!r} pixels",
        )

    @property
    def width(self) -> int:
        """ROI width [px]."""
        return int(self.roi_px[0])

    @property
    def height(self) -> int:
        """ROI height [px]."""
        return int(self.roi_px[1])

    @cached_property
    def position_m(self) -> Array:
        """Optical centre in the tip frame, shape (3,), m."""
        return np.asarray(self.position_mm, dtype=np.float64) * 1e-3

    @cached_property
    def rotation(self) -> Array:
        """``R_tip_camera``, shape (3, 3): columns are the camera's x, y, z axes in the tip frame."""
        return _look_at(self.position_mm, self.target_mm, self.up)

    @cached_property
    def centre_px(self) -> Array:
        """Principal point in ROI pixel coordinates, shape (2,), px; puts the tip at ``tip_px``."""
        tip = -self.rotation.T @ self.position_m
        return np.asarray(np.asarray(self.tip_px, np.float64) - self.focal_px * tip[:2] / tip[2])

    def project(self, points_tip: Array) -> Array:
        """Projects points of the tip frame into the ROI.

        Args:
            points_tip: Shape (..., 3), m, in front of the camera.

        Returns:
            Pixel coordinates, shape (..., 2).
        """
        p = (points_tip - self.position_m) @ self.rotation
        return np.asarray(self.centre_px + self.focal_px * p[..., :2] / p[..., 2:])

    def window(self, size_px: tuple[int, int]) -> Self:
        """The same camera read in a window of another size about the same middle.

        Calibration reads the whole frame, the controller its ROI: focal length and mount are the same,
        pixels count from another corner.

        Args:
            size_px: Width and height of the window [px].

        Returns:
            The camera with that window for an ROI.
        """
        # Truncation towards zero, so that a window and back again is where it was.
        shift = [int((new - old) / 2) for new, old in zip(size_px, self.roi_px, strict=True)]
        return replace(self, roi_px=size_px, tip_px=(self.tip_px[0] + shift[0], self.tip_px[1] + shift[1]))


@dataclass(frozen=True, kw_only=True)
class OverheadCfg:
    """A pinhole camera fixed above the cell, its principal point in the middle of its picture.

    Camera frame and pixel coordinates are ``CameraCfg``'s.

    Attributes:
        position_mm: Optical centre in the world frame (the robot's base) [mm], 3 numbers.
        target_mm: A point on the optical axis in the world frame [mm], 3 numbers.
        up: Direction in the world frame that is up in the image, 3 numbers.
        frame_px: Width and height of the picture [px].
        focal_px: Focal length [px].
    """

    position_mm: Vector
    target_mm: Vector
    up: Vector
    frame_px: tuple[int, int]
    focal_px: float

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "focal_px")
        _vectors(self, position_mm=3, target_mm=3, up=3)
        _whole_pair(self, "frame_px", 8, _MAX_PIXELS)
        _check_gaze(self)

    @cached_property
    def pose(self) -> Array:
        """``T_world_camera``, shape (4, 4), m."""
        rotation = _look_at(self.position_mm, self.target_mm, self.up)
        return transform(rotation, np.asarray(self.position_mm, np.float64) * 1e-3)

    @cached_property
    def matrix(self) -> Array:
        """Intrinsic matrix for continuous pixel coordinates, shape (3, 3), px."""
        width, height = self.frame_px
        f = self.focal_px
        return np.array([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True)
class CalibrationCfg:
    """What the sensor cameras are calibrated with: their whole frame and a ChArUco board.

    Attributes:
        frame_px: Width and height of the sensor's frame, whose middle is the ROI's [px].
        squares: Squares of the board in a row and in a column.
        square_mm: Side of a square [mm].
        marker_mm: Side of the ArUco marker in a white square [mm].
    """

    frame_px: tuple[int, int]
    squares: tuple[int, int]
    square_mm: float
    marker_mm: float

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "square_mm", "marker_mm")
        _whole_pair(self, "frame_px", 8, 1024)
        _whole_pair(self, "squares", 3, 20)
        require(
            self.marker_mm < self.square_mm,
            f"CalibrationCfg.marker_mm = {self.marker_mm!r}: must be smaller than square_mm = "
            f"{self.square_mm!r}",
        )


@dataclass(frozen=True, kw_only=True)
class MarkerCfg:
    """The AR code on a part, by which the overhead camera finds it.

    Attributes:
        id: Number of the code in OpenCV's dictionary 4X4_50, 0..49.
        size_mm: Side of the code's black square [mm].
    """

    id: int
    size_mm: float

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "size_mm")
        require(
            is_number(self.id) and int(self.id) == self.id and 0 <= self.id < 50,
            f"MarkerCfg.id = {self.id!r}: must be a whole number in 0..49",
        )


@dataclass(frozen=True, kw_only=True)
class TimingCfg:
    """Rates.

    Attributes:
        frame_rate_hz: Cameras and policy [Hz].
        substeps: Physics steps in a frame.
    """

    frame_rate_hz: int
    substeps: int

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, "frame_rate_hz", "substeps")
        require(
            int(self.substeps) == self.substeps,
            f"TimingCfg.substeps = {self.substeps!r}: must be a whole number: frames and steps line up",
        )

    @property
    def frame_s(self) -> float:
        """Duration of a frame [s]."""
        return 1.0 / self.frame_rate_hz

    @property
    def step_s(self) -> float:
        """Duration of a physics step [s]."""
        return self.frame_s / self.substeps


@dataclass(frozen=True, kw_only=True)
class LimitsCfg:
    """What an action of magnitude 1 means.

    Attributes:
        linear_m_s2: Tip acceleration [m/s^2].
        angular_rad_s2: Tip angular acceleration [rad/s^2].
        joint_rad_s2: Joint acceleration [rad/s^2].
    """

    linear_m_s2: float
    angular_rad_s2: float
    joint_rad_s2: float

    def __post_init__(self) -> None:
        """Checks the ranges."""
        _positive(self, *(f.name for f in fields(self)))


@dataclass(frozen=True, kw_only=True)
class CellCfg:
    """All of the cell's constants.

    Attributes:
        process: Process constants.
        front: Forward-view camera.
        side: Side-view camera.
        overhead: Camera above the cell, which sees the part's AR code.
        calibration: What the sensor cameras are calibrated with.
        marker: The part's AR code.
        timing: Rates.
        limits: Action limits.
    """

    process: ProcessCfg
    front: CameraCfg
    side: CameraCfg
    overhead: OverheadCfg
    calibration: CalibrationCfg
    marker: MarkerCfg
    timing: TimingCfg
    limits: LimitsCfg

    @property
    def cameras(self) -> tuple[CameraCfg, CameraCfg]:
        """The two sensor cameras, front first."""
        return (self.front, self.side)


def _build(cls: type[Any], table: dict[str, Any], where: str, **given: str) -> Any:
    require(isinstance(table, dict), f"{where}: must be a section with keys, not {table!r}")
    names = {f.name for f in fields(cls)} - set(given)
    unknown, missing = sorted(set(table) - names), sorted(names - set(table))
    require(not unknown, f"{where}: unknown {unknown}; the keys are {sorted(names)}")
    require(not missing, f"{where}: {missing} missing; the keys are {sorted(names)}")
    return cls(**given, **{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


@lru_cache(maxsize=8)
def load_cell(path: Path | None = None) -> CellCfg:
    """Reads and checks a cell file.

    Args:
        path: A TOML file with the sections of ``assets/ur5_sealgun/cell.toml`` (the default).

    Returns:
        The cell.

    Raises:
        ConfigError: If the file is not valid TOML, a key is missing or unknown, or a value is out of
            its range; the message names it.
        FileNotFoundError: If there is no such file.
    """
    path = path or asset("ur5_sealgun", "cell.toml")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path.name} is not valid TOML: {error}") from error
    sections = {
        "process": ProcessCfg,
        "calibration": CalibrationCfg,
        "marker": MarkerCfg,
        "timing": TimingCfg,
        "limits": LimitsCfg,
    }
    unknown = sorted(set(table) - {*sections, "camera"})
    require(not unknown, f"{path.name}: unknown {unknown}; the sections are {[*sections, 'camera']}")
    cameras = table.get("camera", {})
    require(isinstance(cameras, dict), f"{path.name} [camera]: must be a section with keys, not {cameras!r}")
    names = [*VIEWS, OVERHEAD]
    unknown = sorted(set(cameras) - set(names))
    require(not unknown, f"{path.name} [camera]: unknown {unknown}; the cameras are {names}")
    for section in sections:
        require(section in table, f"{path.name}: section [{section}] missing")
    for name in names:
        require(name in cameras, f"{path.name}: section [camera.{name}] missing")
    parts = {k: _build(cls, table[k], f"{path.name} [{k}]") for k, cls in sections.items()}
    views = {v: _build(CameraCfg, cameras[v], f"{path.name} [camera.{v}]", name=v) for v in VIEWS}
    overhead = _build(OverheadCfg, cameras[OVERHEAD], f"{path.name} [camera.{OVERHEAD}]")
    return CellCfg(**parts, **views, overhead=overhead)


def with_cameras(text: str, cameras: Iterable[CameraCfg]) -> str:
    """A cell file with the values of sensor cameras replaced, comments and all else left alone.

    Args:
        text: The file's text; it holds a section ``[camera.<name>]`` for each camera.
        cameras: The cameras to write, e.g. as calibrated.

    Returns:
        The new text.
    """
    values = {
        f"[camera.{camera.name}]": {
            f.name: getattr(camera, f.name) for f in fields(camera) if f.name != "name"
        }
        for camera in cameras
    }
    section, found = "", set()
    out = []
    for line in text.splitlines():
        code = line.split("#")[0].strip()
        if code.startswith("["):
            section = code
            found.add(section)
        key = code.split("=")[0].strip()
        new = values.get(section, {})
        out.append(_with_value(line, key, new[key]) if key in new else line)
    missing = sorted(set(values) - found)
    require(not missing, f"the cell file has no section {missing}: add it, or calibrate the cameras it has")
    return "\n".join(out) + "\n"


def _with_value(line: str, key: str, value: Any) -> str:
    """A line of a cell file with another value and its old comment."""
    _, mark, comment = line.partition("#")
    return f"{key} = {_toml(value)}".ljust(26 if mark else 0) + (f" #{comment}" if mark else "")


def _toml(value: Any) -> str:
    """A number or a tuple of numbers in TOML, to the last bit."""
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, tuple) else repr(value)
