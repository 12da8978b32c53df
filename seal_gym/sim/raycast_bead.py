"""The bead in the raycaster's pictures: its columns' tops as a shaded surface that fades out where it is thin."""

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
        strip = Strip(
            np.zeros(0), np.zeros(0), np.zeros((0, 0, 3)), line, line, grid, grid, grid, grid, grid, np.zeros(3)
        )
        return cls(strip, np.zeros((0, 0, 0)), np.zeros((0, 2), np.int64), np.zeros(3))


@kernel
def _tops(
    strip: Strip,
    height: Array,
    first: int,
    last: int,
    rot: Array,
    eye: Array,
    view: Any,
    top: Array,
    seen: Array,
) -> None:
    """The columns' tops: in the part's frame, and where the camera sees them (u, v in px, 1 / z)."""
    left, upper = view.ray_x[0] * view.focal, view.ray_y[0] * view.focal
    for k in range(first, last):
        for j in range(strip.area.shape[1]):
            offset, local = np.empty(3), np.empty(3)
            for a in range(3):
                top[k - first, j, a] = strip.base[k, j, a] + height[k, j] * strip.column[k, a]
                offset[a] = top[k - first, j, a] - eye[a]
            for a in range(3):
                local[a] = rot[0, a] * offset[0] + rot[1, a] * offset[1] + rot[2, a] * offset[2]
            z = max(local[2], _NEAR_M)
            seen[k - first, j, 0] = local[0] / z * view.focal - left
            seen[k - first, j, 1] = local[1] / z * view.focal - upper
            seen[k - first, j, 2] = 1.0 / z if local[2] > _NEAR_M else 0.0


@kernel
def _light(top: Array, k: int, j: int, lamp: Array, ambient: float, diffuse: float) -> float:
    """Brightness of the surface at a column."""
    rows, columns = top.shape[0], top.shape[1]
    a, b = max(k - 1, 0), min(k + 1, rows - 1)
    c, d = max(j - 1, 0), min(j + 1, columns - 1)
    normal, square = np.empty(3), 0.0
    for i in range(3):
        m, n = (i + 1) % 3, (i + 2) % 3
        # Right of travel times travel is the way back along the nozzle.
        normal[i] = (top[k, d, m] - top[k, c, m]) * (top[b, j, n] - top[a, j, n])
        normal[i] -= (top[k, d, n] - top[k, c, n]) * (top[b, j, m] - top[a, j, m])
        square += normal[i] * normal[i]
    cosine = 0.0
    if square > 0.0:
        for i in range(3):
            cosine += normal[i] * lamp[i] / np.sqrt(square)
    return float(ambient + diffuse * max(cosine, 0.0))


@kernel
def _fill(
    seen: Array,
    shade: Array,
    cover: Array,
    corners: NDArray[np.int64],
    near: Array,
    layer_near: Array,
    layer_shade: Array,
    layer_cover: Array,
) -> None:
    """One triangle of the bead into its layer: nearest wins, and what the part hides is not seen."""
    height, width = near.shape
    x, y, w = np.empty(3), np.empty(3), np.empty(3)
    for m in range(3):
        x[m], y[m], w[m] = (
            seen[corners[m, 0], corners[m, 1], 0],
            seen[corners[m, 0], corners[m, 1], 1],
            seen[corners[m, 0], corners[m, 1], 2],
        )
        if w[m] <= 0.0:
            return
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    if abs(area) < 1e-9:
        return
    low_x, high_x = min(x[0], min(x[1], x[2])), max(x[0], max(x[1], x[2]))  # noqa: PLW3301 - for numba
    low_y, high_y = min(y[0], min(y[1], y[2])), max(y[0], max(y[1], y[2]))  # noqa: PLW3301
    if high_x < 0.0 or high_y < 0.0 or low_x > width - 1.0 or low_y > height - 1.0:
        return
    for i in range(max(int(np.ceil(low_y)), 0), min(int(high_y) + 1, height)):
        for j in range(max(int(np.ceil(low_x)), 0), min(int(high_x) + 1, width)):
            b = ((j - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (i - y[0])) / area
            c = ((x[1] - x[0]) * (i - y[0]) - (j - x[0]) * (y[1] - y[0])) / area
            a = 1.0 - b - c
            if a < 0.0 or b < 0.0 or c < 0.0:
                continue
            depth = a * w[0] + b * w[1] + c * w[2]
            # Half a percent of slack: a film lies as far away as the part under it.
            if depth < 0.995 * near[i, j] or depth <= layer_near[i, j]:
                continue
            layer_near[i, j] = depth
            bright, opaque = 0.0, 0.0
            for m, share in enumerate((a, b, c)):
                bright += share * shade[corners[m, 0], corners[m, 1]]
                opaque += share * cover[corners[m, 0], corners[m, 1]]
            layer_shade[i, j], layer_cover[i, j] = bright, min(opaque, 1.0)


@kernel
def draw_bead(
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
    columns = strip.area.shape[1]
    while first < last and height[first].max() <= 0.0:
        first += 1
    while last > first and height[last - 1].max() <= 0.0:
        last -= 1
    first, last = max(first - 1, 0), min(last + 1, len(strip.arc))
    if last - first < 3:
        return
    rows = last - first
    top, seen = np.empty((rows, columns, 3)), np.empty((rows, columns, 3))
    shade, cover = np.zeros((rows, columns)), np.zeros((rows, columns))
    _tops(strip, height, first, last, rot, eye, view, top, seen)
    for k in range(rows):
        for j in range(columns):
            if height[first + k, j] > 0.0:
                cover[k, j] = height[first + k, j] / _OPAQUE_M
            wet = height[first + k, max(j - 1, 0)] + height[first + k, min(j + 1, columns - 1)]
            wet += height[max(first + k - 1, 0), j] + height[min(first + k + 1, len(strip.arc) - 1), j]
            if wet + height[first + k, j] > 0.0:
                shade[k, j] = _light(top, k, j, lamp, look.ambient[row], look.diffuse[row])
    shape = near.shape
    layer_near, layer_shade, layer_cover = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    corners = np.empty((3, 2), np.int64)
    for k in range(rows - 1):
        for j in range(columns - 1):
            if cover[k, j] + cover[k + 1, j] + cover[k, j + 1] + cover[k + 1, j + 1] <= 0.0:
                continue
            for half in range(2):
                corners[0, 0], corners[0, 1] = k, j
                corners[1, 0], corners[1, 1] = k + half, j + 1
                corners[2, 0], corners[2, 1] = k + 1, j + 1 - half
                _fill(seen, shade, cover, corners, near, layer_near, layer_shade, layer_cover)
    for i in range(shape[0]):
        for j in range(shape[1]):
            a = layer_cover[i, j]
            if a > 0.0:
                for c in range(3):
                    below = picture[i, 3 * j + c]
                    picture[i, 3 * j + c] = below + a * (255.0 * bead.rgb[c] * layer_shade[i, j] - below)
