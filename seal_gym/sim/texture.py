"""The surface texture every renderer uses: machined metal's grain and scratches, tileable.

Integers and ``+ - * / sqrt`` only (no Fourier transform), so that the bytes are the same everywhere.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.frames import Array

SIZE = 512
TEXEL_M = 0.25e-3
PERIOD_M = SIZE * TEXEL_M
MID = 128

_SEED = 20_240_117
_SCRATCHES = 140


def _box(image: NDArray[np.int64], radius: int) -> NDArray[np.int64]:
    """Periodic (2 radius + 1)-square sum; integer, hence exact."""
    for axis in (0, 1):
        image = sum((np.roll(image, k, axis) for k in range(-radius, radius + 1)), np.zeros_like(image))
    return image


def _grain(rng: np.random.Generator, radius: int) -> Array:
    """White noise through two box filters (nothing left beyond a quarter of the texel rate), rms 1."""
    noise = rng.integers(-1024, 1025, size=(SIZE, SIZE), dtype=np.int64)
    smooth = _box(_box(noise, radius), radius)
    smooth -= int(smooth.sum()) // SIZE**2
    rms = np.sqrt(float((smooth * smooth).sum()) / SIZE**2)
    return np.asarray(smooth / rms, dtype=np.float64)


def _scratch(image: Array, rng: np.random.Generator) -> None:
    """Draws one straight scratch of 2-40 mm along a rough machining direction, over the tile's seams."""
    start = rng.random(2) * SIZE
    along = np.array([1.0, 0.9 * rng.random() - 0.2])
    along /= np.sqrt(along[0] * along[0] + along[1] * along[1])
    half_length = 4.0 + 76.0 * rng.random()
    half_width = 1.2 + 0.8 * rng.random()
    height = (1.0 + 1.5 * rng.random()) * (1.0 if rng.random() < 0.5 else -1.0)
    # Only the scratch's own box, wrapped round the tile: the whole tile each time would take a second.
    columns, rows = (
        np.arange(int(c - reach), int(c + reach) + 1)
        for c, reach in zip(start, half_length * np.abs(along) + 3.0, strict=True)
    )
    dx, dy = columns[None, :] + 0.5 - start[0], rows[:, None] + 0.5 - start[1]
    s, t = dx * along[0] + dy * along[1], dy * along[0] - dx * along[1]
    across = np.maximum(0.0, 1.0 - np.abs(t) / half_width)
    ends = np.clip((half_length - np.abs(s)) / 4.0, 0.0, 1.0)
    image[np.ix_(rows % SIZE, columns % SIZE)] += height * across * ends


@lru_cache(maxsize=1)
def _tile() -> NDArray[np.uint8]:
    rng = np.random.default_rng(_SEED)
    image = 0.8 * _grain(rng, 1) + 0.5 * _grain(rng, 4)
    for _ in range(_SCRATCHES):
        _scratch(image, rng)
    levels = np.floor(MID + 42.0 * image + 0.5)
    return np.clip(levels, 1, 255).astype(np.uint8)


def tile() -> NDArray[np.uint8]:
    """The grey tile, ``MID`` on average.

    Returns:
        A copy, shape (512, 512); rows run along v, columns along u, ``TEXEL_M`` a texel.
    """
    return _tile().copy()


def modulation() -> Array:
    """The tile as a zero-mean factor in -1..1, by which ``Material.texture`` is multiplied.

    Returns:
        Shape (512, 512).
    """
    return (_tile().astype(np.float64) - MID) / (MID - 1)


def albedo_map(amplitude: float) -> NDArray[np.uint8]:
    """The tile as an RGB picture that multiplies a material's colour in MuJoCo.

    MuJoCo's factor cannot exceed 1, so white is ``1 + amplitude``: scale the material's colour by that.

    Args:
        amplitude: ``Material.texture`` times the look's texture factor, 0..1.

    Returns:
        Shape (512, 512, 3).
    """
    factor = (1.0 + amplitude * modulation()) / (1.0 + amplitude)
    grey = np.floor(255.0 * factor + 0.5).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
