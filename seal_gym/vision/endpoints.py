"""From lines in strips to lines in the images and their end points on the ROI's border (Zhou et al., 2.1)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.vision.features import SeamLines, ViewGeometry

# Travel in the images: up in the front view, to the right in the side view.
TRAVEL = np.array([[0.0, -1.0], [1.0, 0.0]])


class EndPoints(NamedTuple):
    """Where lines enter and leave the ROI.

    Attributes:
        ends: x1, y1, x2, y2, the second ahead of the first, NaN without, shape (N, 2, 4), px.
        length: Of the line's part in the ROI, 0 without, shape (N, 2), px.
    """

    ends: Array
    length: Array


def strip_references(views: ViewGeometry) -> Array:
    """Where the point one stand-off before the nozzle mouth is in the strips.

    Args:
        views: The calibrated cameras.

    Returns:
        t and o of either view, shape (2, 2), px.
    """
    (x, y), side = views.reference
    return np.array([[views.size[0, 1] - y, x], side])


def image_lines(line: Array, valid: NDArray[np.bool_], views: ViewGeometry) -> SeamLines:
    """Lines of the strips in pixels of the images.

    Args:
        line: p [px] and q of ``o = p + q (t - t_ref)``, shape (N, 2, 2).
        valid: Whether there is a line, shape (N, 2).
        views: The calibrated cameras.

    Returns:
        The lines, pointing along the travel.
    """
    p, q = line[..., 0], line[..., 1]
    point, direction = np.empty((len(line), 2, 2)), np.empty((len(line), 2, 2))
    # The front view's strip is upside down, the side view's is transposed.
    point[:, 0, 0], point[:, 0, 1] = p[:, 0], views.reference[0, 1]
    direction[:, 0, 0], direction[:, 0, 1] = q[:, 0], -1.0
    point[:, 1, 0], point[:, 1, 1] = views.reference[1, 0], p[:, 1]
    direction[:, 1, 0], direction[:, 1, 1] = 1.0, q[:, 1]
    return SeamLines(point, direction, valid.copy())


def end_points(lines: SeamLines, size: Array) -> EndPoints:
    """Clips lines to the ROI and sorts their end points along the travel.

    The order along the travel keeps the labels where they are as a line passes the ROI's corner; sorted by x
    or by y alone they would swap in one of the views.

    Args:
        lines: Lines of N simulations in both views.
        size: Widths and heights of the ROIs, shape (2, 2), px.

    Returns:
        The end points.
    """
    ahead = np.sum(lines.direction * TRAVEL, axis=-1, keepdims=True)
    d = np.where(ahead < 0.0, -lines.direction, lines.direction)
    flat = d == 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = -lines.point / d, (size - lines.point) / d
    within = (lines.point >= 0.0) & (lines.point <= size)
    # A line parallel to a side is between the two for ever, or never.
    enter = np.where(flat, np.where(within, -np.inf, np.inf), np.minimum(a, b)).max(axis=-1)
    leave = np.where(flat, np.where(within, np.inf, -np.inf), np.maximum(a, b)).min(axis=-1)
    ok = lines.valid & ~flat.all(axis=-1) & (leave > enter)
    span = np.where(ok[..., None], np.stack((enter, leave), axis=-1), np.nan)
    ends = lines.point[..., None, :] + span[..., None] * d[..., None, :]
    length = np.where(ok, (span[..., 1] - span[..., 0]) * np.linalg.norm(d, axis=-1), 0.0)
    return EndPoints(ends.reshape(len(d), 2, 4), length)
