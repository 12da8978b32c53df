"""How close predicted cross-sections come to the reference, by section, by bead, over beads."""

from typing import Any

import numpy as np
from contourpy import contour_generator
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from agents.surrogate_data import Bead
from experiments import results
from seal_gym.core.frames import Array
from seal_gym.sealant import fan_section
from seal_gym.sealant.laydown import sections

END_M = 10e-3  # of a bead, where flow / speed does not hold
KEYS = {
    "mse": 5,
    "iou": 3,
    "area_error_pct": 1,
    "ideal_error_pct": 1,
    "width_error_mm": 2,
    "height_error_mm": 2,
    "contour_mm": 2,
}
_MM, _MM2 = 1e3, 1e6

Row = dict[str, Any]


def _contour(image: Array) -> Array:
    """Points of the half-full line, shape (n, 2), in pixels."""
    lines = contour_generator(z=np.pad(image, 1)).lines(0.5)
    return np.concatenate([np.asarray(line) for line in lines]) if lines else np.zeros((0, 2))


def contour_distance_m(one: Array, two: Array) -> float | None:
    """Mean distance from the points of each half-full line to the nearest of the other's.

    Args:
        one: Shares of sealant, shape (20, 40).
        two: Likewise.

    Returns:
        The mean of both directions [m]; None if a section is nowhere half full.
    """
    a, b = _contour(one), _contour(two)
    if not len(a) or not len(b):
        return None
    there, back = cKDTree(b).query(a)[0].mean(), cKDTree(a).query(b)[0].mean()
    return float(0.5 * (there + back)) * sections.PIXEL_M


def inner(bead: Bead) -> NDArray[np.bool_]:
    """Which sections are not near an end of the bead.

    Args:
        bead: The bead.

    Returns:
        Those at least 10 mm along the tip's path from both ends, shape (n,).
    """
    return np.asarray((bead.arcs_m >= END_M) & (bead.arcs_m <= bead.arcs_m[-1] - END_M))


def scores(images: Array, bead: Bead) -> Row:
    """How well one bead is predicted.

    Args:
        images: Predicted sections, shape (n, 20, 40).
        bead: The reference.

    Returns:
        By ``KEYS``: means over its sections; errors of areas as shares of the mean area (``area``: of the
        reference, ``ideal``: flow over speed, away from the bead's ends). None where nothing can be said.
    """
    area, true = sections.area_m2(images), sections.area_m2(bead.images)
    ideal = fan_section.ideal_area_m2(bead.linear_mps, bead.angular_radps, bead.heights_m)
    away = inner(bead)
    lines = [contour_distance_m(a, b) for a, b in zip(images, bead.images, strict=True)]
    known = [line for line in lines if line is not None]
    width, height = sections.width_m, sections.height_m
    return {
        "path": bead.path,
        "draw": bead.draw,
        "sections": len(images),
        "mse": float(np.mean((images - bead.images) ** 2)),
        "iou": float(sections.iou(images, bead.images).mean()),
        "area_error_pct": 100.0 * float(np.abs(area - true).mean() / true.mean()),
        "ideal_error_pct": 100.0 * float(np.abs(area - ideal)[away].mean() / ideal[away].mean())
        if away.any()
        else None,
        "width_error_mm": _MM * float(np.abs(width(images) - width(bead.images)).mean()),
        "height_error_mm": _MM * float(np.abs(height(images) - height(bead.images)).mean()),
        "contour_mm": _MM * float(np.mean(known)) if known else None,
        "no_contour": len(lines) - len(known),
    }


def summary(trials: list[Row]) -> Row:
    """Means over beads.

    Args:
        trials: From ``scores``, one a bead.

    Returns:
        Mean and bootstrap 95 % interval by ``KEYS``, and the number of beads.
    """
    row: Row = {"beads": len(trials), "paths": len({t["path"] for t in trials})}
    for key in KEYS:
        values = [t[key] for t in trials if t[key] is not None]
        row[key] = float(np.mean(values)) if values else None
        row[f"{key.removesuffix('_pct')}_ci"] = results.bootstrap(values)
    return row


def difference(trials: list[Row], others: list[Row], key: str) -> tuple[float, tuple[float, float] | None]:
    """How much one model differs from another on the same beads.

    Args:
        trials: Of the one, from ``scores``.
        others: Of the other, in the same order.
        key: Of ``KEYS``.

    Returns:
        Mean difference and its bootstrap 95 % interval over beads.
    """
    values = [a[key] - b[key] for a, b in zip(trials, others, strict=True)]
    return float(np.mean(values)), results.bootstrap(values)


def effects(weights: Array, mean: Array) -> list[Row]:
    """What each input of a linear model does to the bead.

    Args:
        weights: Change of the section with each input, shape (k, 20, 40).
        mean: The section at mean inputs, shape (20, 40).

    Returns:
        Changes of the area [mm2], of its centroid to the right and up [mm], of the thickest column [mm], and
        of the bead's slope, up to the right [deg].
    """
    x = (np.arange(sections.COLUMNS) + 0.5) * sections.PIXEL_M
    z = (np.arange(sections.ROWS) + 0.5) * sections.PIXEL_M
    area = mean.sum()
    centre = np.array([(mean.sum(0) * x).sum(), (mean.sum(1) * z).sum()]) / area
    thick = int(mean.sum(0).argmax())
    lever = (z - centre[1])[:, None] * (x - centre[0])
    spread = float(np.sum(mean.sum(0) * (x - centre[0]) ** 2))  # slope: the regression of z on x
    rows = []
    for w in weights:
        moved = [(w.sum(0) * (x - centre[0])).sum() / area, (w.sum(1) * (z - centre[1])).sum() / area]
        rows.append(
            {
                "area_mm2": _MM2 * float(w.sum()) * sections.PIXEL_M**2,
                "right_mm": _MM * float(moved[0]),
                "up_mm": _MM * float(moved[1]),
                "height_mm": _MM * float(w[:, thick].sum()) * sections.PIXEL_M,
                "slope_deg": float(np.degrees(np.sum(w * lever) / spread)),
            }
        )
    return rows
