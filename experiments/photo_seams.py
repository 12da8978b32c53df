"""Seams of known place laid into photographs that come with scikit-image.

Two stretches of photographs are the plate and the wall of a fillet: a straight line parts them, with a ramp
of a few pixels between. What the camera does to a rendered picture (blur, exposure, noise) is done to these.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError
from seal_gym.core.frames import Array
from seal_gym.sim.look import Look, LookCfg
from seal_gym.sim.raycast import apply_sensor
from seal_gym.vision.features import ViewGeometry

# Functions of skimage.data whose pictures are in the wheel: nothing is downloaded.
TEXTURES = ("brick", "grass", "gravel")
SCENES = ("astronaut", "camera", "chelsea", "clock", "coffee", "coins", "moon", "rocket")
PHOTOS = TEXTURES + SCENES
LENGTH, WIDTH = 100, 50
_FINE = 8


class PhotoSeams(NamedTuple):
    """N strips (see ``seam_line``) cut from photographs.

    Attributes:
        strip: Shape (N, LENGTH, WIDTH, 3).
        truth: p and q of the line, shape (N, 2), px.
        reference: Its t_ref and the o that offsets are measured from, shape (2,), px.
        snr_db: Shape (N,), dB.
    """

    strip: NDArray[np.uint8]
    truth: Array
    reference: Array
    snr_db: Array


def photo(name: str) -> Array:
    """A photograph that comes with scikit-image.

    Args:
        name: One of ``PHOTOS``.

    Returns:
        Grey levels, shape (height, width, 3).

    Raises:
        ConfigError: Without scikit-image.
    """
    try:
        from skimage import data
    except ImportError as error:
        raise ConfigError(f"the photographs need scikit-image: pip install scikit-image ({error})") from error
    picture = np.asarray(getattr(data, name)(), dtype=np.float64)
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture[..., :3]


def _stretch(picture: Array, level: float, spread: float, rng: np.random.Generator) -> Array:
    """A crop turned at random, brought to a mean grey level and a standard deviation."""
    top = rng.integers(0, picture.shape[0] - LENGTH + 1)
    left = rng.integers(0, picture.shape[1] - WIDTH + 1)
    crop = picture[top : top + LENGTH, left : left + WIDTH]
    crop = crop[:: rng.choice((-1, 1)), :: rng.choice((-1, 1))]
    grey = crop.mean(axis=2)
    gain = min(spread / max(float(grey.std()), 1e-6), 2.0)
    return np.asarray(level + gain * (crop - grey.mean()))


def cover(p: float, q: float, t_ref: float, ramp_px: float) -> Array:
    """How much of each pixel is plate.

    Args:
        p: The line's o at the reference [px].
        q: Its slope.
        t_ref: The reference's t [px].
        ramp_px: Length of the linear change across the line [px].

    Returns:
        0..1, shape (LENGTH, WIDTH).
    """
    t, o = (np.mgrid[: LENGTH * _FINE, : WIDTH * _FINE] + 0.5) / _FINE
    beside = (o - p - q * (t - t_ref)) / np.sqrt(1.0 + q * q)
    share = np.clip(0.5 + beside / ramp_px, 0.0, 1.0)
    return np.asarray(share.reshape(LENGTH, _FINE, WIDTH, _FINE).mean(axis=(1, 3)))


def draw(name: str, count: int, seed: int, cfg: LookCfg | None = None) -> PhotoSeams:
    """Lays seams into a photograph: it is the plate, another one is the wall.

    Args:
        name: One of ``PHOTOS``.
        count: How many.
        seed: Of the first; each has the next.
        cfg: What the camera does.

    Returns:
        The strips.
    """
    cfg, view = cfg or LookCfg(), ViewGeometry.of(load_cell())
    reference = np.array([view.size[0, 1] - view.reference[0, 1], view.reference[0, 0]])
    plate = photo(name)
    pictures = np.empty((count, LENGTH, WIDTH, 3))
    truth, look = np.empty((count, 2)), Look.empty(count)
    for k in range(count):
        rng = np.random.default_rng([seed + k, PHOTOS.index(name)])
        p, q = rng.uniform(15.0, 35.0), rng.uniform(-0.15, 0.15)
        step, middle = rng.uniform(25.0, 60.0), rng.uniform(100.0, 150.0)
        spread, ramp = rng.uniform(3.0, 12.0, 2), rng.uniform(1.0, 3.0)
        wall = photo(str(rng.choice(PHOTOS)))
        bright = _stretch(plate, middle + 0.5 * step, spread[0], rng)
        dark = _stretch(wall, middle - 0.5 * step, spread[1], rng)
        share = cover(p, q, reference[0], ramp)[..., None]
        pictures[k], truth[k] = share * bright + (1.0 - share) * dark, (p, q)
        look.draw(k, rng, cfg)
    pictures = np.clip(pictures, 0.0, 255.0)
    seen = apply_sensor(pictures, pictures, look, np.zeros(count, np.uint64))
    return PhotoSeams(seen.front, truth, reference, seen.snr_db[:, 0])
