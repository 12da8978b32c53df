"""The cell's calibration: process constants, sensor cameras, timing and limits, from one file."""

import tomllib
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.core.frames import Array, normalise
from seal_gym.core.paths import asset

VIEWS = ("front", "side")


def _positive(cfg: Any, *names: str) -> None:
    for name in names:
        value = getattr(cfg, name)
        require(
            is_number(value) and value > 0,
            f"{type(cfg).__name__}.{name} = {value!r}: must be a finite number > 0",
        )


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
        for field, length in (("position_mm", 3), ("target_mm", 3), ("up", 3), ("roi_px", 2), ("tip_px", 2)):
            value = getattr(self, field)
            require(
                isinstance(value, tuple) and len(value) == length and all(map(is_number, value)),
                f"CameraCfg.{field} = {value!r}: must be {length} finite numbers",
            )
        require(
            all(int(n) == n and 8 <= n <= 1024 for n in self.roi_px),
            f"CameraCfg.roi_px = {self.roi_px!r}: width and height must be whole numbers in 8..1024",
        )
        forward = np.subtract(self.target_mm, self.position_mm)
        require(
            bool(np.linalg.norm(np.cross(forward, self.up)) > 1e-6),
            f"CameraCfg.up = {self.up!r}: must not be parallel to the optical axis {tuple(forward)!r}",
        )
        require(
            bool(forward @ np.negative(self.position_mm) > 0),
            f"CameraCfg.position_mm = {self.position_mm!r}: the nozzle mouth is behind the camera",
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
        forward = normalise(np.subtract(self.target_mm, self.position_mm).astype(np.float64))
        right = normalise(np.cross(forward, np.asarray(self.up, dtype=np.float64)))
        return np.stack((right, np.cross(forward, right), forward), axis=-1)

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
        timing: Rates.
        limits: Action limits.
    """

    process: ProcessCfg
    front: CameraCfg
    side: CameraCfg
    timing: TimingCfg
    limits: LimitsCfg

    @property
    def cameras(self) -> tuple[CameraCfg, CameraCfg]:
        """The two sensor cameras, front first."""
        return (self.front, self.side)


def _build(cls: type[Any], table: dict[str, Any], where: str) -> Any:
    require(isinstance(table, dict), f"{where}: must be a section with keys, not {table!r}")
    names = {f.name for f in fields(cls)}
    unknown, missing = sorted(set(table) - names), sorted(names - set(table))
    require(not unknown, f"{where}: unknown {unknown}; the keys are {sorted(names)}")
    require(not missing, f"{where}: {missing} missing; the keys are {sorted(names)}")
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


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
    sections = {"process": ProcessCfg, "timing": TimingCfg, "limits": LimitsCfg}
    unknown = sorted(set(table) - {*sections, "camera"})
    require(not unknown, f"{path.name}: unknown {unknown}; the sections are {[*sections, 'camera']}")
    cameras = table.get("camera", {})
    for section in sections:
        require(section in table, f"{path.name}: section [{section}] missing")
    for view in VIEWS:
        require(view in cameras, f"{path.name}: section [camera.{view}] missing")
    parts = {k: _build(cls, table[k], f"{path.name} [{k}]") for k, cls in sections.items()}
    views = {v: _build(CameraCfg, {"name": v, **cameras[v]}, f"{path.name} [camera.{v}]") for v in VIEWS}
    return CellCfg(**parts, **views)
