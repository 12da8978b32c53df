"""Ways to name the pixels of a palette's picture: Hopfield networks, plain thresholds, nearest neighbours."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments import palette_pictures
from experiments.palette_pictures import LightCfg
from seal_gym.vision import hopfield, palette_segments
from seal_gym.vision.hopfield import HopfieldNetwork
from seal_gym.vision.palette_observer import PaletteObserverCfg, name_pixels
from seal_gym.vision.palette_regions import NamedPixels
from seal_gym.vision.palette_segments import (
    CABLE_CODE,
    CODES,
    CONNECTOR_CODE,
    PALETTE_CODE,
    RIVET_CODE,
    TARGET_CODE,
    Bytes,
    Levels,
    PaletteClass,
)

FIXED: Levels = (120, 120, 120)  # between dark and bright of the undisturbed colours
NEIGHBOURS = 5
_BITS = 5  # colours are looked up in a table of 2^5 a channel
_TAUGHT, _PIXELS = 8, 60  # pictures, pixels of each class of each
# Lights of the second k-NN's training pictures.
_LIGHTS = {"level": (0.5, 1.4), "contrast": (0.5, 1.0), "slope": (0.0, 0.4), "noise": (2.0, 16.0)}

Method = Callable[[Bytes], NamedPixels]

NAMES = (
    "Hopfield, exact",
    "Hopfield, exact, fixed thresholds",
    "Hopfield, Hebb as printed",
    "Hopfield, Hebb, best reading",
    "thresholds + components",
    "thresholds + components, fixed",
    "k-NN",
    "k-NN, many lights",
)


def _hopfield(rgb: Bytes, *, network: HopfieldNetwork, levels: Levels | None) -> NamedPixels:
    return name_pixels(rgb, network, PaletteObserverCfg(levels=levels))


def _plain(rgb: Bytes, *, levels: Levels | None) -> NamedPixels:
    """Each pixel by its own row of Table I."""
    names = np.full(CODES, PaletteClass.UNKNOWN, dtype=np.uint8)
    names[[CABLE_CODE, CONNECTOR_CODE, RIVET_CODE]] = (
        PaletteClass.CABLE,
        PaletteClass.CONNECTOR,
        PaletteClass.RIVET,
    )
    names[[TARGET_CODE, PALETTE_CODE]] = PaletteClass.TARGET, PaletteClass.PALETTE
    classes = names[palette_segments.codes(rgb, levels or palette_segments.otsu_levels(rgb))]
    return NamedPixels(classes=classes, conflict=np.zeros(classes.shape, dtype=np.bool_))


def _taught(lights: bool, seed: int) -> NDArray[np.uint8]:
    """Class of each colour by its nearest neighbours among labelled pixels, shape (2^5, 2^5, 2^5)."""
    rng = np.random.default_rng(seed)
    colours, labels = [], []
    for _ in range(_TAUGHT):
        palette = palette_pictures.draw(palette_pictures.layout(rng), rng)
        light = LightCfg(**{k: rng.uniform(*v) for k, v in _LIGHTS.items()}) if lights else LightCfg()
        rgb = palette_pictures.photograph(palette, light, rng)
        for kind in PaletteClass:
            rows = np.flatnonzero(palette.labels.ravel() == kind)
            if kind == PaletteClass.UNKNOWN or len(rows) == 0:  # it is taught no strangers
                continue
            chosen = rng.choice(rows, _PIXELS)
            colours.append(rgb.reshape(-1, 3)[chosen])
            # White is white: whether it is a tie its place decides.
            name = PaletteClass.PALETTE if kind == PaletteClass.TIE else kind
            labels.append(np.full(_PIXELS, name, dtype=np.uint8))
    known = np.concatenate(labels)
    steps = (np.arange(2**_BITS) + 0.5) * 2 ** (8 - _BITS)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
    _, near = cKDTree(np.concatenate(colours).astype(np.float64)).query(grid, k=NEIGHBOURS)
    votes = (known[near][..., None] == np.arange(len(PaletteClass))).sum(axis=-2)
    return np.asarray(votes.argmax(axis=-1), dtype=np.uint8)


def _nearest(rgb: Bytes, *, table: NDArray[np.uint8]) -> NamedPixels:
    cell = rgb >> (8 - _BITS)
    classes = table[cell[..., 0], cell[..., 1], cell[..., 2]]
    return NamedPixels(classes=classes, conflict=np.zeros(classes.shape, dtype=np.bool_))


def methods(seed: int = 0) -> dict[str, Method]:
    """What is compared; all but the fixed ones take Otsu's thresholds of each picture.

    Args:
        seed: Of the k-NN's training pictures.

    Returns:
        By name, in the order of ``NAMES``.
    """
    exact = hopfield.exact()
    found: tuple[Method, ...] = (
        partial(_hopfield, network=exact, levels=None),
        partial(_hopfield, network=exact, levels=FIXED),
        partial(_hopfield, network=hopfield.printed(), levels=None),
        partial(_hopfield, network=hopfield.best_hebbian(), levels=None),
        partial(_plain, levels=None),
        partial(_plain, levels=FIXED),
        partial(_nearest, table=_taught(False, seed)),
        partial(_nearest, table=_taught(True, seed)),
    )
    return dict(zip(NAMES, found, strict=True))
