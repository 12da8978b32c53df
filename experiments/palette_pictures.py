"""Drawn pictures of palettes of cables with known labels: random layouts, light, contrast and noise."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.vision.palette_seen import deproject
from seal_gym.vision.palette_segments import Bytes, PaletteClass

# As the cell's overhead camera, with a window of the board's size.
CAMERA = OverheadCfg(
    position_mm=(430.0, 0.0, 950.0),
    target_mm=(430.0, 0.0, 0.0),
    up=(1.0, 0.0, 0.0),
    frame_px=(832, 624),
    focal_px=1800.0,
)
COLOURS: dict[PaletteClass, tuple[int, int, int]] = {
    PaletteClass.PALETTE: (205, 200, 190),
    PaletteClass.CABLE: (26, 26, 30),
    PaletteClass.CONNECTOR: (35, 70, 190),
    PaletteClass.RIVET: (60, 165, 75),
    PaletteClass.TARGET: (200, 45, 40),
    PaletteClass.TIE: (245, 245, 238),
    PaletteClass.UNKNOWN: (225, 200, 45),  # something yellow that does not belong there
}
_HEIGHT_MM = {
    PaletteClass.PALETTE: 0.0,
    PaletteClass.TARGET: 0.0,
    PaletteClass.RIVET: 2.0,
    PaletteClass.CABLE: 6.0,
    PaletteClass.TIE: 7.5,
    PaletteClass.UNKNOWN: 8.0,
    PaletteClass.CONNECTOR: 12.0,
}
_BOARD_TOP_MM, _CENTRE_MM = 20.0, (430.0, 0.0)
_FINE = 5  # supersampling, odd so that pixels have a middle; cv2 takes 4 binary digits of sub-pixels besides
_SHIFT = 4
_JITTER, _GRAIN = 8.0, 1.5  # of an element's colour, and of every pixel [grey levels]


@dataclass(frozen=True, kw_only=True)
class LightCfg:
    """Light and noise of a picture.

    Attributes:
        level: Factor of all grey levels.
        contrast: Factor of the distance from mid grey, before.
        slope: Light falls from ``1 + slope`` to ``1 - slope`` times the level across the picture, in a random
            direction.
        noise: Standard deviation of every channel of every pixel [grey levels].
    """

    level: float = 1.0
    contrast: float = 1.0
    slope: float = 0.0
    noise: float = 2.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, high in (("level", 4.0), ("contrast", 2.0), ("slope", 1.0), ("noise", 128.0)):
            value = getattr(self, name)
            require(0.0 <= value <= high, f"LightCfg.{name} = {value!r}: must be within 0..{high:g}")


class Element(NamedTuple):
    """An element of a layout.

    Attributes:
        kind: Its class.
        outline_mm: On the board, x away from the robot and y to its left from the middle, shape (n, 2), mm.
    """

    kind: PaletteClass
    outline_mm: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Palette:
    """A drawn palette.

    Attributes:
        colour: Undisturbed, shape (H, W, 3), grey levels.
        depth_m: Along the optical axis, shape (H, W), m.
        labels: ``PaletteClass`` of each pixel's middle, shape (H, W).
        classes: Of the elements, shape (n,).
        centroids_px: Shape (n, 2), px; cables' of what is seen of them.
        positions_m: In the world frame, shape (n, 3), m.
        open_targets: Elements that are target zones without a tie, shape (k,).
    """

    colour: Array
    depth_m: Array
    labels: Bytes
    classes: NDArray[np.int8]
    centroids_px: Array
    positions_m: Array
    open_targets: NDArray[np.intp]


def rectangle(centre: Array, along: Array, length: float, width: float) -> Array:
    """Corners of a rectangle, shape (4, 2).

    Args:
        centre: Shape (2,).
        along: Unit direction of its length, shape (2,).
        length: Along it.
        width: Across it.

    Returns:
        In order.
    """
    across = np.array([-along[1], along[0]])
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.stack([centre + 0.5 * (i * length * along + j * width * across) for i, j in signs])


def circle(centre: Array, diameter: float) -> Array:
    """A circle's outline, shape (64, 2).

    Args:
        centre: Shape (2,).
        diameter: In the same unit.

    Returns:
        In order.
    """
    angle = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
    return np.asarray(centre + 0.5 * diameter * np.stack((np.cos(angle), np.sin(angle)), axis=1))


def _cable(rng: np.random.Generator, lane_mm: float) -> tuple[Array, Array]:
    """Centre line of a cable, from left to right, and its unit tangents, shapes (n, 2)."""
    ends = rng.uniform(110.0, 160.0, 2)
    y = np.linspace(-ends[0], ends[1], 241)
    wave = 2 * np.pi / rng.uniform(160.0, 320.0)
    height, phase = rng.uniform(2.0, 10.0), rng.uniform(0.0, 2 * np.pi)
    points = np.stack((lane_mm + height * np.sin(wave * y + phase), y), axis=1)
    tangents = np.gradient(points, axis=0)
    return points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def layout(rng: np.random.Generator) -> list[Element]:
    """A random layout: cables with connectors, target zones, most with a tie, rivets, perhaps a stranger.

    Args:
        rng: Source of chance.

    Returns:
        In the order in which they lie upon one another, lowest first.
    """
    zones, cables, ties, parts, kept_clear = [], [], [], [], []
    lanes = np.array([-90.0, -30.0, 30.0, 90.0])[: rng.integers(3, 5)] + rng.uniform(-6.0, 6.0)
    for lane in lanes:
        points, tangents = _cable(rng, float(lane))
        normal = 3.5 * np.stack((-tangents[:, 1], tangents[:, 0]), axis=1)
        outline = np.concatenate((points + normal, (points - normal)[::-1]))
        cables.append(Element(PaletteClass.CABLE, outline))
        kept_clear.append(points)
        for end in (0, -1)[: rng.integers(1, 3)]:
            plug = rectangle(points[end], tangents[end], 26.0, 16.0)
            parts.append(Element(PaletteClass.CONNECTOR, plug))
            kept_clear.append(plug)
        for part in range(int(rng.integers(1, 4))):
            k = int(rng.integers(45, 75)) + 60 * part
            zones.append(Element(PaletteClass.TARGET, rectangle(points[k], tangents[k], 20.0, 26.0)))
            if rng.random() < 0.6:
                ties.append(Element(PaletteClass.TIE, rectangle(points[k], tangents[k], 5.0, 17.0)))
    clear = np.concatenate(kept_clear)
    wanted = [PaletteClass.RIVET] * int(rng.integers(4, 8))
    wanted += [PaletteClass.UNKNOWN] * int(rng.integers(0, 2))
    while wanted:
        spot = rng.uniform((-125.0, -180.0), (125.0, 180.0))
        if np.linalg.norm(clear - spot, axis=1).min() < 26.0:
            continue
        kind = wanted.pop()
        turn = rng.uniform(0.0, np.pi)
        outline = (
            circle(spot, 8.0)
            if kind == PaletteClass.RIVET
            else rectangle(spot, np.array([np.cos(turn), np.sin(turn)]), 16.0, 12.0)
        )
        parts.append(Element(kind, outline))
        clear = np.concatenate((clear, spot[None]))
    return [*zones, *cables, *ties, *parts]


def _world_m(points_mm: Array, kind: PaletteClass) -> Array:
    flat = points_mm + np.array(_CENTRE_MM)
    height = np.full((*flat.shape[:-1], 1), _BOARD_TOP_MM + _HEIGHT_MM[kind])
    return np.asarray(1e-3 * np.concatenate((flat, height), axis=-1))


def project(points_m: Array, camera: OverheadCfg = CAMERA) -> Array:
    """Where points of the world are seen.

    Args:
        points_m: Shape (..., 3), m.
        camera: The camera.

    Returns:
        Shape (..., 2), px.
    """
    p = (points_m - camera.pose[:3, 3]) @ camera.pose[:3, :3] @ camera.matrix.T
    return np.asarray(p[..., :2] / p[..., 2:])


def draw(elements: list[Element], rng: np.random.Generator) -> Palette:
    """Draws a layout as ``CAMERA`` sees it: flat colours, smooth edges.

    Args:
        elements: Lowest first.
        rng: Of the colours.

    Returns:
        The palette.
    """
    width, height = CAMERA.frame_px
    index = np.zeros((_FINE * height, _FINE * width), dtype=np.uint8)
    kinds = [PaletteClass.PALETTE, *(e.kind for e in elements)]
    for k, element in enumerate(elements, start=1):
        # A pixel's middle is a whole number to cv2.
        at = _FINE * project(_world_m(element.outline_mm, element.kind)) - 0.5
        cv2.fillPoly(index, [np.round(at * 2**_SHIFT).astype(np.int32)], k, lineType=8, shift=_SHIFT)
    paint = np.array([COLOURS[k] for k in kinds]) + rng.uniform(-_JITTER, _JITTER, (len(kinds), 3))
    fine = np.clip(paint, 0, 255).astype(np.float32)[index]
    colour = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
    colour += rng.normal(0.0, _GRAIN, (height, width, 1))
    middle = index[_FINE // 2 :: _FINE, _FINE // 2 :: _FINE]
    depths = 1e-3 * (CAMERA.position_mm[2] - _BOARD_TOP_MM - np.array([_HEIGHT_MM[k] for k in kinds]))
    centroids, positions = [], []
    for k, element in enumerate(elements, start=1):
        if element.kind == PaletteClass.CABLE:
            rows, columns = np.nonzero(index == k)
            centroid = (np.array([columns.mean(), rows.mean()]) + 0.5) / _FINE
            position = deproject(centroid, float(depths[k]), CAMERA)
        else:
            position = _world_m(element.outline_mm.mean(axis=0), element.kind)
            centroid = project(position)
        centroids.append(centroid)
        positions.append(position)
    classes = np.array([e.kind for e in elements], dtype=np.int8)
    middles = np.array([e.outline_mm.mean(axis=0) for e in elements])
    ties = middles[classes == PaletteClass.TIE]
    open_targets = [
        k
        for k in np.flatnonzero(classes == PaletteClass.TARGET)
        if not (np.linalg.norm(ties - middles[k], axis=1) < 5.0).any()
    ]
    return Palette(
        colour=colour,
        depth_m=depths[middle],
        labels=np.array(kinds, dtype=np.uint8)[middle],
        classes=classes,
        centroids_px=np.stack(centroids),
        positions_m=np.stack(positions),
        open_targets=np.array(open_targets, dtype=np.intp),
    )


def photograph(palette: Palette, light: LightCfg, rng: np.random.Generator) -> Bytes:
    """A picture of a palette in some light.

    Args:
        palette: The palette.
        light: Light and noise.
        rng: Of the noise, and of the direction from which the light falls.

    Returns:
        Shape (H, W, 3).
    """
    height, width = palette.labels.shape
    angle = rng.uniform(0.0, 2 * np.pi)
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    across = np.cos(angle) * x + np.sin(angle) * y
    fall = 1.0 + light.slope * across / np.abs(across).max()
    seen = (128.0 + light.contrast * (palette.colour - 128.0)) * light.level * fall[..., None]
    seen += rng.normal(0.0, light.noise, seen.shape)
    return np.asarray(np.clip(np.round(seen), 0, 255), dtype=np.uint8)
