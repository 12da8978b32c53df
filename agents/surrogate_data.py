"""Simulated beads for the surrogate: read from files, split by centre path."""

import hashlib
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from seal_gym.core.errors import SealGymError, require
from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.paths import TRAINING, VALIDATION
from seal_gym.sealant.surrogate import Features, features, joined

OBSTACLE_COURSE = tuple(p.name for p in VALIDATION)
_HELD_OUT = 5  # one centre path in so many
_SPLIT_SEED = 0  # one split for every model and training seed
_TRIES, _PAUSE_S = 5, 1.0
_ARRAYS = ("arc_m", "linear_mps", "angular_radps", "gravity_mps2", "heights_m", "image")


class SurrogateDataError(SealGymError, ValueError):
    """A folder holds no data for the surrogate, or damaged ones."""


@dataclass(frozen=True)
class Bead:
    """One simulated bead; its stations are ``seal_gym.sealant.surrogate.StationsLike``.

    Attributes:
        path: Name of the centre path.
        draw: Number of the path drawn around it.
        arcs_m: Along the tip's path, shape (n,) [m].
        linear_mps: Of the tip, in its frame, shape (n, 3) [m/s].
        angular_radps: Likewise, shape (n, 3) [rad/s].
        gravity_mps2: In the tip's frame, shape (n, 3) [m/s2].
        heights_m: Shape (n, 41) [m].
        images: Shares of sealant in [0, 1], shape (n, 20, 40).
    """

    path: str
    draw: int
    arcs_m: Array
    linear_mps: Array
    angular_radps: Array
    gravity_mps2: Array
    heights_m: Array
    images: Array


@dataclass(frozen=True)
class Set:
    """Sections to learn from or to be judged by.

    Attributes:
        beads: They are of.
        inputs: Of all sections.
        images: Of all sections, shape (n, 20, 40).
    """

    beads: tuple[Bead, ...]
    inputs: Features
    images: Array


def _read(path: Path) -> dict[str, Any]:
    """A file that another process may be replacing."""
    for tries in range(_TRIES):
        try:
            # np.load leaves a file open that it opened itself and cannot read
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                return {k: data[k] for k in ("draw", *_ARRAYS)}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            if tries + 1 == _TRIES:
                raise SurrogateDataError(
                    f"{path} cannot be read ({error}): make it anew with `python -m experiments.laydown runs`"
                ) from error
            time.sleep(_PAUSE_S)
    raise AssertionError


def read_beads(folder: Path) -> list[Bead]:
    """The beads of a folder.

    Args:
        folder: With ``<centre path>.npz`` of ``python -m experiments.laydown runs``.

    Returns:
        The beads in order of centre path and draw; of paths without a file there are none.

    Raises:
        SurrogateDataError: If there are no files, or one is damaged.
    """
    beads = []
    for name in (p.name for p in TRAINING + VALIDATION):
        file = folder / f"{name}.npz"
        if not file.exists():
            continue
        data = _read(file)
        for draw in np.unique(data["draw"]):
            chosen = data["draw"] == draw
            arcs, linear, angular, gravity, heights, image = (data[k][chosen].astype(float) for k in _ARRAYS)
            beads.append(Bead(name, int(draw), arcs, linear, angular, gravity, heights, image / 255.0))
    if not beads:
        raise SurrogateDataError(
            f"{folder} holds no data: make them with `python -m experiments.laydown runs --out {folder}`"
        )
    return beads


def digest(beads: Sequence[Bead]) -> str:
    """What tells data apart.

    Args:
        beads: The data.

    Returns:
        SHA-256 of names and numbers.
    """
    found = hashlib.sha256()
    for bead in beads:
        found.update(f"{bead.path} {bead.draw}".encode())
        for values in (bead.arcs_m, bead.linear_mps, bead.heights_m, bead.images):
            found.update(values.astype(np.float32).tobytes())
    return found.hexdigest()


def split(beads: Sequence[Bead]) -> tuple[list[Bead], list[Bead], list[Bead]]:
    """Beads to learn from, to stop and choose by, and of the obstacle course; never two of a centre path.

    Args:
        beads: From ``read_beads``.

    Returns:
        Training, held-out and obstacle-course beads.

    Raises:
        ConfigError: If there are fewer than two training centre paths.
    """
    order = np.random.default_rng(_SPLIT_SEED).permutation([p.name for p in TRAINING]).tolist()
    there = {b.path for b in beads}
    known = [name for name in order if name in there]
    require(len(known) >= 2, f"the data hold {len(known)} training centre paths: at least 2 are needed")
    held = set(known[: max(len(known) // _HELD_OUT, 1)])
    train = [b for b in beads if b.path in known and b.path not in held]
    return train, [b for b in beads if b.path in held], [b for b in beads if b.path in OBSTACLE_COURSE]


def prepared(beads: Sequence[Bead], neighbours: int) -> Set:
    """Features and images of beads.

    Args:
        beads: At least one.
        neighbours: N_m.

    Returns:
        Their sections, one bead after the other.
    """
    inputs = joined([features(b, neighbours) for b in beads])
    return Set(tuple(beads), inputs, np.concatenate([b.images for b in beads]))
