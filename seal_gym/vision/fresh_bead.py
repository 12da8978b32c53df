"""The fresh bead in the two views: hidden from the seam's tracker, measured behind the nozzle.

Plate and wall are grey, so the differences between their colour channels are near zero whatever the exposure;
a coloured sealant's are not.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import CameraCfg
from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.core.jit import kernel

# The bead is measured this far behind the tip, where the nozzle hides it no longer [m].
BEHIND_M = (5.2e-3, 3.6e-3)
_MIN_CONTRAST = 15.0  # grey levels between the sealant's colour and the part's
_MIN_OPPONENT = 0.2  # of an albedo, so that the contrast is reached in poor light too
_MARGIN_PX = 2  # that blur and edge masks reach beyond a pixel
_HIDDEN = 0.05  # share of a pixel that the nozzle may cover


class BeadWidth(NamedTuple):
    """The bead behind N nozzles.

    Attributes:
        width_m: Between its borders, across the seam in the tip frame, shape (N,), m; 0 where none is seen.
        seen: Whether a bead is seen, shape (N,).
    """

    width_m: Array
    seen: NDArray[np.bool_]


def colour_weights(rgb: tuple[float, float, float]) -> Array:
    """Weights of the channels whose sum is zero on grey and largest on a sealant.

    Args:
        rgb: The sealant's albedo, 3 numbers in 0..1.

    Returns:
        Shape (3,): R - G and G - B along the sealant's own direction.

    Raises:
        ConfigError: If the sealant is too grey to be told from the part.
    """
    opponent = np.array([rgb[0] - rgb[1], rgb[1] - rgb[2]])
    size = float(np.sqrt((opponent**2).sum()))
    require(
        size >= _MIN_OPPONENT,
        f"sealant of colour {tuple(rgb)}: its channels differ by {size:.2f}, at least {_MIN_OPPONENT} is "
        "needed to tell it from plate and wall; dye it (Sealant.rgb), or use perception='oracle'",
    )
    way = opponent / size
    return np.array([way[0], way[1] - way[0], -way[1]])


@kernel
def _hide(image: NDArray[np.uint8], weights: Array, view: int, mask: NDArray[np.bool_]) -> None:
    """Marks the sealant's pixels and those round them in a strip: front upside down, side transposed."""
    height, width = image.shape[0], image.shape[1]
    for i in range(height):
        for j in range(width):
            signal = weights[0] * image[i, j, 0] + weights[1] * image[i, j, 1] + weights[2] * image[i, j, 2]
            if signal <= _MIN_CONTRAST:
                continue
            for r in range(max(i - _MARGIN_PX, 0), min(i + _MARGIN_PX + 1, height)):
                for c in range(max(j - _MARGIN_PX, 0), min(j + _MARGIN_PX + 1, width)):
                    if view == 0:
                        mask[height - 1 - r, c] = True
                    else:
                        mask[c, r] = True


@kernel
def hide_sealant(
    images: NDArray[np.uint8], weights: Array, view: int, nozzle: NDArray[np.bool_], masks: NDArray[np.bool_]
) -> None:
    """What the tracker must not look at: nozzle and sealant.

    Args:
        images: Of one view, shape (N, height, width, 3).
        weights: Of ``colour_weights``.
        view: 0 front, 1 side.
        nozzle: The nozzle's strip, shape (length, width).
        masks: True where either may be, filled in place, shape (N, length, width).
    """
    for n in range(len(images)):
        masks[n] = nozzle
        _hide(images[n], weights, view, masks[n])


@kernel
def _span(signal: Array) -> float:
    """Extent of what exceeds half the signal's peak, with interpolated ends [px]; NaN if none or cut off."""
    peak = signal.max()
    if peak <= _MIN_CONTRAST:
        return np.nan
    half, first, last = 0.5 * peak, -1, -1
    for i in range(len(signal)):
        if signal[i] > half:
            first = i if first < 0 else first
            last = i
    if first == 0 or last == len(signal) - 1:
        return np.nan
    low = (signal[first] - half) / (signal[first] - signal[first - 1])
    high = (signal[last] - half) / (signal[last] - signal[last + 1])
    return float(last - first + low + high)


@kernel
def _measure(
    side: NDArray[np.uint8],
    weights: Array,
    columns: NDArray[np.int64],
    clear: NDArray[np.bool_],
    px_per_m: float,
    width: Array,
    seen: NDArray[np.bool_],
) -> None:
    """The median of the pixel columns' spans, if most of them have one."""
    signal, spans = np.empty(side.shape[1]), np.empty(len(columns))
    for n in range(len(side)):
        found = 0
        for m in range(len(columns)):
            for i in range(len(signal)):
                signal[i] = 0.0
                if clear[i, m]:
                    for c in range(3):
                        signal[i] += weights[c] * side[n, i, columns[m], c]
            span = _span(signal)
            if not np.isnan(span):
                spans[found] = span
                found += 1
        seen[n] = 2 * found > len(columns)
        width[n] = np.median(spans[:found]) / px_per_m if seen[n] else 0.0


class BeadGauge:
    """Measures beads in side views.

    Along a column of pixels behind the nozzle, the bead is where the sealant's signal exceeds half its peak.

    Args:
        camera: The side view.
        nozzle: The nozzle's coverage of its pixels, shape (height, width).
        rgb: The sealant's albedo, 3 numbers in 0..1.
    """

    def __init__(self, camera: CameraCfg, nozzle: Array, rgb: tuple[float, float, float]) -> None:
        self._weights = colour_weights(rgb)
        pixel = camera.project(np.array([[0.0, -b, 0.0] for b in BEHIND_M]))[:, 0]
        low, high = (int(np.clip(x, 0, camera.width - 1)) for x in (pixel.min(), pixel.max()))
        columns = np.arange(low, max(high, low + 1), dtype=np.int64)
        clear = nozzle[:, columns] <= _HIDDEN
        self._columns, self._clear = columns, np.ascontiguousarray(clear)
        # Along a row of the seam's frame the view's vertical is mostly x: px per metre across.
        step = camera.project(np.array([[0.0, -BEHIND_M[1], 0.0], [1e-3, -BEHIND_M[1], 0.0]]))
        self._px_per_m = 1e3 * float(np.abs(step[1, 1] - step[0, 1]))

    def measure(self, side: NDArray[np.uint8]) -> BeadWidth:
        """Measures the beads.

        Args:
            side: Side views, shape (N, height, width, 3).

        Returns:
            Widths: the median over the pixel columns behind the nozzle.
        """
        width, seen = np.empty(len(side)), np.empty(len(side), np.bool_)
        _measure(
            np.ascontiguousarray(side), self._weights, self._columns, self._clear, self._px_per_m, width, seen
        )
        return BeadWidth(width, seen)
