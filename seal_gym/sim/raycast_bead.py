"""The bead in the raycaster's pictures: its columns' tops, shaded, fading out where they are thin."""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel
from seal_gym.sealant.strip import Strip
from seal_gym.sim.look import Look

# Sealant thinner than this lets the part show through.
_OPAQUE_M = 0.25e-3
_NEAR_M = 1e-3


class BeadView(NamedTuple):
    """What the raycaster draws of N beads.

    Attributes:
        strip: The columns, in the part's frame.
        height: Of each column, shape (N, S, U), m.
        window: First row and last row + 1 that may be in the picture, shape (N, 2).
        rgb: Diffuse albedo, shape (3,), 0..1.
    """

    strip: Strip
    height: Array
    window: NDArray[np.int64]
    rgb: Array

    @classmethod
    def none(cls) -> Self:
        """No beads at all.

        Returns:
            What ``draw_bead`` is not called for.
        """
        line, grid = np.zeros((0, 3)), np.zeros((0, 0))
        none = np.zeros(0)
        strip = Strip(none, none, np.zeros((0, 0, 3)), line, line, grid, grid, grid, grid, grid, np.zeros(3))
        return cls(strip, np.zeros((0, 0, 0)), np.zeros((0, 2), np.int64), np.zeros(3))


@kernel
def _top(strip: Strip, height: Array, k: int, j: int, rot: Array, eye: Array, view: Any, out: Array) -> None:
    """One column's top: in the part's frame, then where the camera sees it (column, row [px], 1 / z)."""
    x = strip.base[k, j, 0] + height[k, j] * strip.column[k, 0]
    y = strip.base[k, j, 1] + height[k, j] * strip.column[k, 1]
    z = strip.base[k, j, 2] + height[k, j] * strip.column[k, 2]
    out[0], out[1], out[2] = x, y, z
    x, y, z = x - eye[0], y - eye[1], z - eye[2]
    depth = rot[0, 2] * x + rot[1, 2] * y + rot[2, 2] * z
    out[5] = 0.0
    if depth > _NEAR_M:
        out[5] = 1.0 / depth
        out[3] = ((rot[0, 0] * x + rot[1, 0] * y + rot[2, 0] * z) / depth - view.ray_x[0]) * view.focal
        out[4] = ((rot[0, 1] * x + rot[1, 1] * y + rot[2, 1] * z) / depth - view.ray_y[0]) * view.focal


@kernel
def _light(top: Array, k: int, j: int, lamp: Array, ambient: float, diffuse: float) -> float:
    """Brightness of the surface at a column."""
    a, b = max(k - 1, 0), min(k + 1, top.shape[0] - 1)
    c, d = max(j - 1, 0), min(j + 1, top.shape[1] - 1)
    # Right of travel times travel is the way back along the nozzle.
    rx, ry, rz = top[k, d, 0] - top[k, c, 0], top[k, d, 1] - top[k, c, 1], top[k, d, 2] - top[k, c, 2]
    ax, ay, az = top[b, j, 0] - top[a, j, 0], top[b, j, 1] - top[a, j, 1], top[b, j, 2] - top[a, j, 2]
    nx, ny, nz = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
    square = nx * nx + ny * ny + nz * nz
    if square <= 0.0:
        return ambient
    cosine = (nx * lamp[0] + ny * lamp[1] + nz * lamp[2]) / np.sqrt(square)
    return float(ambient + diffuse * max(cosine, 0.0))


@kernel
def _fill(
    top: Array,
    a: tuple[int, int],
    b: tuple[int, int],
    c: tuple[int, int],
    near: Array,
    layer: Array,
) -> None:
    """One triangle of the bead into its layer: nearest wins, and what the part hides is not seen."""
    height, width = near.shape
    wa, wb, wc = top[a[0], a[1], 5], top[b[0], b[1], 5], top[c[0], c[1], 5]
    if min(wa, min(wb, wc)) <= 0.0:  # noqa: PLW3301 - two arguments are what numba inlines
        return
    xa, xb, xc = top[a[0], a[1], 3], top[b[0], b[1], 3], top[c[0], c[1], 3]
    ya, yb, yc = top[a[0], a[1], 4], top[b[0], b[1], 4], top[c[0], c[1], 4]
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    low_x, high_x = min(xa, min(xb, xc)), max(xa, max(xb, xc))  # noqa: PLW3301
    low_y, high_y = min(ya, min(yb, yc)), max(ya, max(yb, yc))  # noqa: PLW3301
    if abs(area) < 1e-9 or high_x < 0.0 or high_y < 0.0 or low_x > width - 1.0 or low_y > height - 1.0:
        return
    for i in range(max(int(np.ceil(low_y)), 0), min(int(high_y) + 1, height)):
        for j in range(max(int(np.ceil(low_x)), 0), min(int(high_x) + 1, width)):
            sb = ((j - xa) * (yc - ya) - (xc - xa) * (i - ya)) / area
            sc = ((xb - xa) * (i - ya) - (j - xa) * (yb - ya)) / area
            sa = 1.0 - sb - sc
            if min(sa, min(sb, sc)) < 0.0:  # noqa: PLW3301
                continue
            depth = sa * wa + sb * wb + sc * wc
            # Half a percent of slack: a film lies as far away as the part under it.
            if depth < 0.995 * near[i, j] or depth <= layer[i, j, 0]:
                continue
            layer[i, j, 0] = depth
            for m in (1, 2):
                layer[i, j, m] = (
                    sa * top[a[0], a[1], 5 + m] + sb * top[b[0], b[1], 5 + m] + sc * top[c[0], c[1], 5 + m]
                )


@kernel
def _wet_columns(height: Array, first: int, last: int) -> tuple[int, int]:
    """First and last + 1 of the columns with sealant, and their dry neighbours."""
    left, right = height.shape[1], 0
    for k in range(first, last):
        for j in range(height.shape[1]):
            if height[k, j] > 0.0:
                left, right = min(left, j), max(right, j + 1)
    return max(left - 1, 0), min(right + 1, height.shape[1])


@kernel
def draw_bead(  # noqa: PLR0912  # loops over rows and columns
    bead: BeadView,
    row: int,
    rot: Array,
    eye: Array,
    lamp: Array,
    view: Any,
    look: Look,
    near: Array,
    picture: Array,
) -> None:
    """Draws one simulation's bead over the part.

    Args:
        bead: The beads.
        row: Which of them.
        rot: ``R_part_camera``, shape (3, 3).
        eye: Optical centre in the part's frame, shape (3,), m.
        lamp: Direction towards the lamp in the part's frame, shape (3,).
        view: The raycaster's camera.
        look: The looks, of the same rows.
        near: 1 / depth of the part in each pixel, shape (height, width), 1/m.
        picture: Grey levels, changed in place, shape (height, 3 width).
    """
    strip, height = bead.strip, bead.height[row]
    first, last = bead.window[row, 0], bead.window[row, 1]
    while first < last and height[first].max() <= 0.0:
        first += 1
    while last > first and height[last - 1].max() <= 0.0:
        last -= 1
    first, last = max(first - 1, 0), min(last + 1, len(strip.arc))
    if last - first < 3:
        return
    left, right = _wet_columns(height, first, last)
    rows, columns = last - first, right - left
    top = np.empty((rows, columns, 8))  # point, pixel, 1 / z, brightness, cover
    for k in range(rows):
        for j in range(columns):
            _top(strip, height, first + k, left + j, rot, eye, view, top[k, j])
            top[k, j, 7] = height[first + k, left + j] / _OPAQUE_M
    for k in range(rows):
        for j in range(columns):
            top[k, j, 6] = _light(top, k, j, lamp, look.ambient[row], look.diffuse[row])
    layer = np.zeros((near.shape[0], near.shape[1], 3))  # 1 / z, brightness, cover
    for k in range(rows - 1):
        for j in range(columns - 1):
            if top[k, j, 7] + top[k + 1, j, 7] + top[k, j + 1, 7] + top[k + 1, j + 1, 7] > 0.0:
                _fill(top, (k, j), (k, j + 1), (k + 1, j + 1), near, layer)
                _fill(top, (k, j), (k + 1, j + 1), (k + 1, j), near, layer)
    for i in range(near.shape[0]):
        for j in range(near.shape[1]):
            cover = min(layer[i, j, 2], 1.0)
            if cover > 0.0:
                for c in range(3):
                    below = picture[i, 3 * j + c]
                    picture[i, 3 * j + c] = below + cover * (255.0 * bead.rgb[c] * layer[i, j, 1] - below)
