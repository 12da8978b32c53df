"""What the seam vision saw in a frame, for people: the marks of each view, and pictures with them drawn in.

For looking only: everything is computed anew from images and lines, and nothing here feeds back into a run.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.vision.edges import EdgeCfg, EdgeMap, EdgeTables, edge_image, grey_sum
from seal_gym.vision.features import SeamLines, ViewGeometry
from seal_gym.vision.seam_line import LineCfg, dilated, ransac_line, strips

Bytes = NDArray[np.uint8]
Rgb = tuple[int, int, int]

# Told apart by colour-blind readers, in grey too by their shapes (after Okabe and Ito).
CANDIDATE_RGB: Rgb = (240, 150, 0)
RANSAC_RGB: Rgb = (40, 130, 255)
LINE_RGB: Rgb = (255, 255, 255)
ATTRACTION_RGB: Rgb = (255, 0, 190)
STAND_OFF_RGB: Rgb = (250, 235, 60)
_EDGE_RGB: Rgb = (10, 10, 10)
_TEXT_RGB: Rgb = (235, 235, 235)
_BACK_RGB: Rgb = (28, 30, 34)
_SHIFT = 4  # OpenCV draws to 1/16 px
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class ViewMarks(NamedTuple):
    """What there is to see in one view of one simulation, in pixels of the ROI.

    Attributes:
        candidates: Centres of the edge pixels that RANSAC chose from, shape (n, 2).
        ransac: Ends of RANSAC's line within the ROI, shape (2, 2); None without one.
        line: Ends of the tracked (or true) line within the ROI, shape (2, 2); None without one.
        attraction: Foot of the stand-off point's image on the tracked line, shape (2,); None without a line.
        stand_off: Image of the point one stand-off before the nozzle mouth, shape (2,).
    """

    candidates: Array
    ransac: Array | None
    line: Array | None
    attraction: Array | None
    stand_off: Array


class Stage(NamedTuple):
    """What edge and line stage say about one view on its own.

    Attributes:
        candidates: Centres of the edge pixels that RANSAC chose from, shape (n, 2), px.
        ransac: A point on its line and the line's direction, shape (2, 2), px; None without a line.
    """

    candidates: Array
    ransac: Array | None


def clip_line(point: Array, direction: Array, size: Array) -> Array | None:
    """The part of a line that lies in the ROI (Liang and Barsky).

    Args:
        point: On the line, shape (2,), px.
        direction: Of any length, shape (2,).
        size: Width and height of the ROI, shape (2,), px.

    Returns:
        Its two ends in the direction's order, shape (2, 2); None if it misses the ROI.
    """
    enter, leave = -np.inf, np.inf
    for p, d, top in zip(point, direction, size, strict=True):
        if d == 0.0:
            if not 0.0 <= p <= top:
                return None
            continue
        first, last = sorted((-p / d, (top - p) / d))
        enter, leave = max(enter, first), min(leave, last)
    if not np.isfinite(enter) or leave <= enter:
        return None
    return np.stack((point + enter * direction, point + leave * direction))


def foot(reference: Array, point: Array, direction: Array) -> Array:
    """The attraction point: the foot of a point on a line (Zhou et al., section 2.1).

    Args:
        reference: The point, shape (2,), px.
        point: On the line, shape (2,), px.
        direction: Of any length but zero, shape (2,).

    Returns:
        Shape (2,), px.
    """
    along = (reference - point) @ direction / (direction @ direction)
    return np.asarray(point + along * direction)


def _edge_map(strip: Bytes, mask: NDArray[np.bool_], cfg: EdgeCfg) -> EdgeMap:
    """The edge stage on one strip, the nozzle masked as the line stage masks it."""
    size, tables = strip.shape[:2], EdgeTables.of(cfg)
    grey, padded = np.empty(size, np.int64), np.empty((size[0] + 2 * tables.pad, size[1] + 2 * tables.pad))
    ex, ey, work, bins = np.empty(size), np.empty(size), np.empty(size), np.empty(512, np.int64)
    magnitude, orientation, intensity = np.empty(size), np.empty(size), np.empty(size)
    edge = np.empty(size, np.bool_)
    grey_sum(strip, grey)
    edge_image(
        grey, mask, *tables, padded, work, bins, ex, ey, magnitude, orientation, intensity, edge
    )  # fmt: skip
    return EdgeMap(np.stack((ex, ey), axis=-1), magnitude, orientation, intensity, edge)


def _strip_stage(
    strip: Bytes, mask: NDArray[np.bool_], t_ref: float, edges: EdgeCfg, line: LineCfg
) -> tuple[Array, Array | None]:
    """Candidates (t, o) and RANSAC's p, q of one strip."""
    found = _edge_map(strip, mask, edges)
    ex, ey = (np.ascontiguousarray(found.vector[..., k]) for k in (0, 1))
    # The same choice as ``ransac_line``: inside the border, off the nozzle, brighter on the expected side.
    across, along = (cv2.boxFilter(x, -1, (3, 3), normalize=False) for x in (ex, ey))
    chosen = found.edge & ~mask & (line.bright_side * across > 0.5 * np.abs(along))
    chosen[[0, -1]] = chosen[:, [0, -1]] = False
    raw = np.zeros(2)
    seen = ransac_line(found.edge, mask, found.intensity, ex, ey, t_ref, line.numbers, raw)
    return np.argwhere(chosen).astype(np.float64) + 0.5, raw if seen else None


def line_stage(
    front: Bytes,
    side: Bytes,
    nozzle: tuple[Array, Array],
    views: ViewGeometry,
    edges: EdgeCfg | None = None,
    line: LineCfg | None = None,
) -> tuple[Stage, Stage]:
    """Runs edge stage and RANSAC on both views, as a search without any memory does.

    Args:
        front: Shape (height, width, 3).
        side: Shape (height, width, 3).
        nozzle: The nozzle's coverage of each pixel, front and side, shape (height, width).
        views: The calibrated cameras.
        edges: Parameters of the edge stage.
        line: Parameters of the line stage.

    Returns:
        Of the front and the side view.
    """
    edges, line = edges or EdgeCfg(), line or LineCfg()
    height = float(views.size[0, 1])
    t_refs = (height - float(views.reference[0, 1]), float(views.reference[1, 0]))
    out = []
    for v, (strip, mask) in enumerate(zip(strips(front[None], side[None]), dilated(nozzle), strict=True)):
        where, raw = _strip_stage(strip[0], mask, t_refs[v], edges, line)
        ransac = None
        if raw is not None:
            p, q = raw
            ends = _from_strip(np.array([[t_refs[v], p], [t_refs[v] + 1.0, p + q]]), v, height)
            ransac = np.stack((ends[0], ends[1] - ends[0]))
        out.append(Stage(_from_strip(where, v, height), ransac))
    return out[0], out[1]


def _from_strip(t_o: Array, view: int, height: float) -> Array:
    """Points (t, o) of a strip in pixels of its view: the front view was upside down, the side transposed."""
    t, o = t_o[:, 0], t_o[:, 1]
    return np.stack((o, height - t) if view == 0 else (t, o), axis=1)


def view_marks(
    lines: SeamLines, views: ViewGeometry, i: int = 0, stages: tuple[Stage, Stage] | None = None
) -> tuple[ViewMarks, ViewMarks]:
    """Collects what there is to draw of one simulation.

    Args:
        lines: Tracked or true lines of N simulations.
        views: The calibrated cameras.
        i: Which simulation.
        stages: From ``line_stage``; without, there are neither candidates nor RANSAC's line.

    Returns:
        Of the front and the side view.
    """
    out = []
    for v in range(2):
        stage = stages[v] if stages else Stage(np.empty((0, 2)), None)
        point, direction, size = lines.point[i, v], lines.direction[i, v], views.size[v]
        known = bool(lines.valid[i, v]) and bool(direction @ direction > 0.0)
        out.append(
            ViewMarks(
                candidates=stage.candidates,
                ransac=None if stage.ransac is None else clip_line(stage.ransac[0], stage.ransac[1], size),
                line=clip_line(point, direction, size) if known else None,
                attraction=foot(views.reference[v], point, direction) if known else None,
                stand_off=views.reference[v].copy(),
            )
        )
    return out[0], out[1]


def draw(image: Bytes, marks: ViewMarks, scale: int = 5) -> Bytes:
    """An ROI enlarged, pixel by pixel, with its marks drawn over it.

    Args:
        image: Shape (H, W, 3), RGB; left as it is.
        marks: What to draw.
        scale: Size of a pixel.

    Returns:
        Shape (scale H, scale W, 3).
    """
    require(int(scale) == scale and 1 <= scale <= 32, f"scale = {scale!r}: must be a whole number in 1..32")
    out = np.ascontiguousarray(image.repeat(scale, axis=0).repeat(scale, axis=1))

    def place(points: Array) -> Array:
        # OpenCV's integers are the centres of pixels, the ROI's the corners.
        return np.asarray(points) * scale - 0.5

    for p in place(marks.candidates):
        _dot(out, p, max(0.28 * scale, 1.0), CANDIDATE_RGB)
    if marks.line is not None:
        _solid(out, place(marks.line))
    if marks.ransac is not None:
        _dashes(out, place(marks.ransac))
    _ring(out, place(marks.stand_off))
    if marks.attraction is not None:
        _segment(out, place(np.stack((marks.stand_off, marks.attraction))), ATTRACTION_RGB, 2)
        _disc(out, place(marks.attraction))
    return out


def legend(width: int, *, vision: bool, columns: int = 2) -> Bytes:
    """Explains the marks.

    Args:
        width: Of the picture [px].
        vision: With the candidates and RANSAC's line, or of a true line only.
        columns: Of entries.

    Returns:
        RGB, shape (23 a row, width, 3).
    """
    entries: list[tuple[Callable[[Bytes, Array], None], str]] = [
        (_ring, "stand-off point before the mouth"),
        (_disc, "attraction point: its foot on the line"),
    ]
    if vision:
        entries = [
            (_candidates_sample, "edge pixels RANSAC chose from"),
            (lambda out, at: _dashes(out, _sample(at)), "RANSAC's line, this frame alone"),
            (lambda out, at: _solid(out, _sample(at)), "tracked line"),
            *entries,
        ]
    else:
        entries.insert(0, (lambda out, at: _solid(out, _sample(at)), "true line (oracle)"))
    rows = -(-len(entries) // columns)
    out = np.full((23 * rows, width, 3), _BACK_RGB, np.uint8)
    for k, (symbol, text) in enumerate(entries):
        left, middle = (k // rows) * width // columns, 23 * (k % rows) + 12
        symbol(out, np.array([left + 17.0, middle]))
        write(out, text, (left + 40, middle + 5))
    return out


def write(out: Bytes, text: str, where: tuple[int, int], rgb: Rgb = _TEXT_RGB, size: float = 0.45) -> None:
    """Writes text into a picture.

    Args:
        out: The picture, changed.
        text: ASCII: OpenCV's font has no more.
        where: Left end of the base line, px.
        rgb: Colour.
        size: Of the font; 0.45 is legible in a video.
    """
    cv2.putText(out, text, where, _FONT, size, rgb, 1, cv2.LINE_AA)


def _fixed(p: Array) -> tuple[int, int]:
    """A point in the fixed-point numbers that OpenCV draws at."""
    x, y = np.round(np.asarray(p) * 2**_SHIFT).astype(int)
    return int(x), int(y)


def _segment(out: Bytes, ends: Array, rgb: Rgb, thickness: int) -> None:
    cv2.line(out, _fixed(ends[0]), _fixed(ends[1]), rgb, thickness, cv2.LINE_AA, _SHIFT)


def _dot(out: Bytes, p: Array, radius: float, rgb: Rgb) -> None:
    cv2.circle(out, _fixed(p), round(radius * 2**_SHIFT), rgb, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def _solid(out: Bytes, ends: Array) -> None:
    _segment(out, ends, _EDGE_RGB, 4)
    _segment(out, ends, LINE_RGB, 2)


def _dashes(out: Bytes, ends: Array, dash: float = 9.0, gap: float = 7.0) -> None:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    unit = (ends[1] - ends[0]) / max(length, 1e-9)
    for start in np.arange(0.0, length, dash + gap):
        piece = np.stack((ends[0] + start * unit, ends[0] + min(start + dash, length) * unit))
        _segment(out, piece, RANSAC_RGB, 3)


def _disc(out: Bytes, p: Array) -> None:
    _dot(out, p, 5.0, _EDGE_RGB)
    _dot(out, p, 4.0, ATTRACTION_RGB)


def _ring(out: Bytes, p: Array) -> None:
    for rgb, thickness in ((_EDGE_RGB, 4), (STAND_OFF_RGB, 2)):
        cv2.circle(out, _fixed(p), 8 * 2**_SHIFT, rgb, thickness, cv2.LINE_AA, _SHIFT)


def _sample(at: Array) -> Array:
    return np.asarray(at + np.array([[-15.0, 0.0], [15.0, 0.0]]))


def _candidates_sample(out: Bytes, at: Array) -> None:
    for x, y in ((-10.0, 2.0), (-5.0, -2.0), (0.0, 2.0), (5.0, -2.0), (10.0, 2.0)):
        _dot(out, at + np.array([x, y]), 1.6, CANDIDATE_RGB)
