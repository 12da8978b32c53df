"""Seams of other shape than the nominal parts', by name: how far what was learned carries."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array
from seal_gym.workpieces.workpiece import Workpiece

_UP = np.array([0.0, 0.0, 1.0])
_RUN_ON_M = 0.03  # a seam goes on so far past its ends: a ramp must not dive below the plate there
_WALL_M, _GROOVE_M = 0.03, 2e-3

Joint = Literal["fillet", "groove"]
Side = Literal["left", "right"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """What ``Workpiece.from_polyline`` takes.

    Attributes:
        name: Of the shape.
        points: In order of travel, in the part's frame, shape (n, 3), m.
        approach: Unit directions from the seam back along the nozzle, shape (n, 3).
        joint: ``"fillet"`` or ``"groove"``.
        corner_radius: Rounds the polyline's corners [m].
        wall_height: Of a fillet's wall [m].
        groove_width: Of a groove [m].
    """

    name: str
    points: Array
    approach: Array
    joint: Joint = "fillet"
    corner_radius: float = 5e-3
    wall_height: float = _WALL_M
    groove_width: float = _GROOVE_M

    def workpiece(self) -> Workpiece:
        """Builds the part.

        Returns:
            The workpiece.

        Raises:
            SeamError: See ``Workpiece.from_polyline``.
        """
        return Workpiece.from_polyline(
            self.points,
            self.approach,
            joint=self.joint,
            corner_radius=self.corner_radius,
            name=self.name,
            wall_height=self.wall_height,
            groove_width=self.groove_width,
        )

    def spec(self) -> dict[str, Any]:
        """Everything that ``of_spec`` needs, ready for JSON.

        Returns:
            Lengths in m, without rounding.
        """
        return {
            "name": self.name,
            "points_m": self.points.tolist(),
            "approach": self.approach.tolist(),
            "joint": self.joint,
            "corner_radius_m": self.corner_radius,
            "wall_height_m": self.wall_height,
            "groove_width_m": self.groove_width,
        }

    @classmethod
    def of_spec(cls, spec: dict[str, Any]) -> Self:
        """The shape that ``spec`` describes.

        Args:
            spec: As ``spec`` gives it; what is missing has the default.

        Returns:
            The shape.

        Raises:
            SeamError: If a name is unknown or the points are missing.
        """
        names = {
            "name": "name",
            "points_m": "points",
            "approach": "approach",
            "joint": "joint",
            "corner_radius_m": "corner_radius",
            "wall_height_m": "wall_height",
            "groove_width_m": "groove_width",
        }
        wrong = sorted((set(spec) - set(names)) | ({"name", "points_m", "approach"} - set(spec)))
        require(
            not wrong,
            f"workpiece has {sorted(spec)}: {wrong} unknown or missing; it has {list(names)}",
            SeamError,
        )
        given = {names[key]: value for key, value in spec.items()}
        for key in ("points", "approach"):
            given[key] = np.asarray(given[key], dtype=np.float64)
        return cls(**given)


def seam_of(
    points: ArrayLike, *, name: str, lean_deg: float = 45.0, wall: Side = "left", **options: Any
) -> Shape:
    """A seam along a polyline at a constant lean.

    Args:
        points: In order of travel, shape (n, 3), m.
        name: Of the shape.
        lean_deg: Of the nozzle from the normal of the floor [deg].
        wall: Side of travel on which it stands; the gun leans to the other.
        **options: Further attributes of ``Shape``.

    Returns:
        The shape.
    """
    p = np.asarray(points, dtype=np.float64)
    require(wall in get_args(Side), f"wall = {wall!r}: must be one of {list(get_args(Side))}", SeamError)
    u = np.diff(p, axis=0) / np.linalg.norm(np.diff(p, axis=0), axis=1, keepdims=True)
    along = np.concatenate((u[:1], u[:-1] + u[1:], u[-1:]))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right = np.cross(along, _UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    angle = np.deg2rad(lean_deg) * (1.0 if wall == "left" else -1.0)
    approach = np.cos(angle) * np.cross(right, along) + np.sin(angle) * right
    return Shape(name=name, points=p, approach=approach, **options)


def _wave(amplitude_m: float, period_m: float, **options: Any) -> Shape:
    x = np.linspace(-0.12, 0.12, 49)
    return seam_of(np.column_stack((x, amplitude_m * np.sin(2 * np.pi * x / period_m), 0.0 * x)), **options)


def _ellipse(a_m: float, b_m: float, **options: Any) -> Shape:
    """Half of one, travelled counter-clockwise on its outside."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 91)
    return seam_of(np.column_stack((a_m * np.cos(t), b_m * np.sin(t), 0.0 * t)), **options)


def _zigzag(amplitude_m: float, **options: Any) -> Shape:
    y = amplitude_m * np.array([0.0, 1.0, 0.0, 1.0, 0.0])
    return seam_of(np.column_stack((np.linspace(-0.12, 0.12, 5), y, 0.0 * y)), **options)


def _hexagon(side_m: float, **options: Any) -> Shape:
    """Three sides of one."""
    t = np.deg2rad([-90.0, -30.0, 30.0, 90.0])
    return seam_of(side_m * np.column_stack((np.cos(t), np.sin(t), 0.0 * t)), **options)


def _corner(turn_deg: float, **options: Any) -> Shape:
    """Turns left by an angle; with the wall on the left, a turn to the right is the wall's inner corner."""
    a = np.deg2rad(turn_deg)
    return seam_of(0.08 * np.array([[-1, 0, 0], [0, 0, 0], [np.cos(a), np.sin(a), 0]]), **options)


def _ramp(slope_deg: float, **options: Any) -> Shape:
    """Level, then up."""
    rise = np.tan(np.deg2rad(slope_deg))
    z = np.array([0.0, 0.0, 0.08 * rise]) + _RUN_ON_M * rise
    return seam_of(np.column_stack(([-0.08, 0.0, 0.08], np.zeros(3), z)), **options)


def _line(length_m: float, **options: Any) -> Shape:
    return seam_of([[-length_m / 2, 0, 0], [length_m / 2, 0, 0]], **options)


_SHAPES: dict[str, Callable[..., Shape]] = {
    "s_curve": partial(_wave, 0.02, 0.24, wall_height=0.04),
    "ellipse": partial(_ellipse, 0.06, 0.04),
    "zigzag": partial(_zigzag, 0.01, corner_radius=0.02),
    "hexagon": partial(_hexagon, 0.05, corner_radius=5e-3),
    "inner_corner": partial(_corner, -90.0, corner_radius=0.03, wall_height=0.025),
    "ramp": partial(_ramp, 10.0),
    "wall_right": partial(_line, 0.2, wall="right"),
    "groove": partial(_line, 0.2, joint="groove", lean_deg=0.0),
    "groove_curve": partial(_wave, 0.02, 0.24, joint="groove", lean_deg=0.0),
}
NAMES = tuple(_SHAPES)
TITLES = {
    "s_curve": "S-curve, 20 mm amplitude",
    "ellipse": "half an ellipse, 60 x 40 mm",
    "zigzag": "zig-zag, corners of 20 mm radius",
    "hexagon": "three sides of a hexagon, 5 mm radius",
    "inner_corner": "inner corner, 30 mm radius",
    "ramp": "ramp of 10 deg",
    "wall_right": "straight, wall on the right",
    "groove": "groove, straight",
    "groove_curve": "groove, S-curve",
}


@lru_cache
def get(name: str) -> Shape:
    """A shape by name.

    Args:
        name: One of ``NAMES``.

    Returns:
        The shape.

    Raises:
        SeamError: If there is no such name.
    """
    require(name in _SHAPES, f"shape = {name!r}: must be one of {list(NAMES)}", SeamError)
    return _SHAPES[name](name=name)
