"""What a bead path can be refined on: evaluators that give the heights of its bead at both edges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter1d
from scipy.spatial import cKDTree

from experiments import bead_laydown
from experiments.bead_laydown import Places
from experiments.bead_substrates import simulation
from seal_gym.core.errors import ConfigError, require
from seal_gym.core.frames import Array
from seal_gym.planning.bead_cases import BeadCase
from seal_gym.planning.bead_curves import Edges
from seal_gym.planning.bead_geometry import BeadPath
from seal_gym.planning.bead_refine import Evaluator, shares
from seal_gym.sealant.laydown.config import GridCfg
from seal_gym.sealant.laydown.jet import emit
from seal_gym.sealant.laydown.pieces import trace
from seal_gym.sealant.laydown.sections import COLUMNS, PIXEL_M, Stations, stations
from seal_gym.sealant.laydown.substrates import SUBSTRATES
from seal_gym.sealant.strip import Strip
from seal_gym.sealant.surrogate import load_surrogate

_PIXEL_M = 0.5e-3
_BLUR_M = 1e-3
_EMIT_S = 4e-3  # four emissions in each
_POSES = 600
_SMOOTH = 9  # places, 1 mm apart
_NEAR = 9  # samples of sections around a place


def place_points(strip: Strip, at: Array) -> Array:
    """Where places of a planar strip are.

    Args:
        strip: With rows along y, see ``bead_laydown.strip_of``.
        at: Arc lengths and offsets, shape (n, 2), m.

    Returns:
        x and y in the case's frame, shape (n, 2), m.
    """
    first = strip.base[0, len(strip.across) // 2]
    middle = strip.across[len(strip.across) // 2]
    return np.stack((first[0] + at[:, 0] - strip.arc[0], first[1] - (at[:, 1] - middle)), axis=-1)


def thinned(path: BeadPath) -> BeadPath:
    """A path with fewer poses, which suffice between smooth corrections.

    Args:
        path: The path.

    Returns:
        At most some 600 of its poses, first and last among them.
    """
    keep = np.unique(np.linspace(0, len(path.time_s) - 1, min(_POSES, len(path.time_s))).round().astype(int))
    return BeadPath(
        time_s=path.time_s[keep],
        position_m=path.position_m[keep],
        rotation=path.rotation[keep],
        flow_m3_per_s=path.flow_m3_per_s[keep],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Ballistic:
    """The jet flies with the tip's velocity added and stays where it lands on the plane, blurred by 1 mm.

    Attributes:
        left: x and y of the places inside the left edge, shape (n, 2), m.
        right: Inside the right edge, shape (n, 2), m.
        fan_angle_rad: theta [rad].
    """

    left: Array
    right: Array
    fan_angle_rad: float

    def __call__(self, paths: Sequence[BeadPath]) -> Array:
        """Heights of beads; see ``bead_refine.Evaluator``."""
        return np.array([self._one(path) for path in paths])

    def _one(self, path: BeadPath) -> Array:
        plane, grid = SUBSTRATES["plane"], GridCfg(inlet_dt_s=_EMIT_S)
        cfg = simulation(plane, thinned(path), self.fan_angle_rad, grid)
        jet, fall = emit(cfg), -cfg.gravity_mps2[2]
        down = -jet.velocities[:, 2]
        flight = (-down + np.sqrt(down**2 + 2.0 * fall * jet.positions[:, 2])) / fall
        landed = jet.positions[:, :2] + flight[:, None] * jet.velocities[:, :2]
        places = np.stack((self.left, self.right))
        low = np.minimum(landed.min(0), places.min((0, 1))) - 6 * _BLUR_M
        size = np.ceil((np.maximum(landed.max(0), places.max((0, 1))) - low) / _PIXEL_M).astype(int) + 12
        pixel = (landed - low) / _PIXEL_M
        first = np.floor(pixel).astype(int)
        share = pixel - first
        pile = np.zeros(size.prod())
        for i in (0, 1):
            for j in (0, 1):
                weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
                index = (first[:, 0] + i) * size[1] + first[:, 1] + j
                pile += np.bincount(index, weights=jet.volumes_m3 * weight, minlength=len(pile))
        height = gaussian_filter(pile.reshape(size) / _PIXEL_M**2, _BLUR_M / _PIXEL_M, mode="constant")
        return np.asarray(map_coordinates(height, np.moveaxis((places - low) / _PIXEL_M, -1, 0), order=1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Sections:
    """Cross-sections of the bead by their stations, as a surrogate predicts them.

    Attributes:
        predict: Volume fractions, shape (n, 20, 40), from n stations.
        left: x and y of the places inside the left edge, shape (m, 2), m.
        right: Inside the right edge, shape (m, 2), m.
        fan_angle_rad: theta [rad].
    """

    predict: Callable[[Stations], Array]
    left: Array
    right: Array
    fan_angle_rad: float

    def __call__(self, paths: Sequence[BeadPath]) -> Array:
        """Heights of beads; see ``bead_refine.Evaluator``."""
        return np.array([self._one(path) for path in paths])

    def _one(self, path: BeadPath) -> Array:
        plane = SUBSTRATES["plane"]
        at = stations(simulation(plane, thinned(path), self.fan_angle_rad, GridCfg()))
        # A column leans with the tip: what stands in it is so much lower.
        upright = at.tips[:, 2, 2]
        height = self.predict(at).sum(axis=1) * PIXEL_M * upright[:, None]
        across = (np.arange(COLUMNS) + 0.5 - COLUMNS / 2) * PIXEL_M
        spot = at.hits[:, None, :2] + across[:, None] * at.tips[:, None, :2, 0]
        tree = cKDTree(spot.reshape(-1, 2))
        away, near = tree.query(np.concatenate((self.left, self.right)), k=_NEAR)
        weight = np.exp(-0.5 * (away / (0.5 * PIXEL_M)) ** 2) + 1e-12
        found = np.sum(weight * height.reshape(-1)[near], axis=1) / weight.sum(axis=1)
        return np.asarray(found.reshape(2, -1))


@dataclass(frozen=True, kw_only=True, eq=False)
class FastTier:
    """Straight rays on columns, see ``seal_gym.sealant.fan``.

    Attributes:
        strip: Under the bead.
        places: Where heights are wanted.
        fan_angle_rad: theta [rad].
    """

    strip: Strip
    places: Places
    fan_angle_rad: float

    def __call__(self, paths: Sequence[BeadPath]) -> Array:
        """Heights of beads; see ``bead_refine.Evaluator``."""
        out = []
        for path in paths:
            laid = bead_laydown.lay(self.strip, path, self.fan_angle_rad)
            sides = self.places.left, self.places.right
            out.append([bead_laydown.heights_at(self.strip, laid, side) for side in sides])
        return np.array(out)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scaled:
    """An evaluator that has been set right where a better one was asked.

    Attributes:
        evaluate: The evaluator.
        factor: By which its heights are multiplied, shape (2, n).
    """

    evaluate: Evaluator
    factor: Array

    def __call__(self, paths: Sequence[BeadPath]) -> Array:
        """Heights of beads; see ``bead_refine.Evaluator``."""
        return np.asarray(self.evaluate(paths) * self.factor)


def scaled(evaluate: Evaluator, path: BeadPath, heights: Array) -> Scaled:
    """Sets an evaluator right at one path, smoothly along the edges.

    Args:
        evaluate: The evaluator.
        path: The path.
        heights: What a better one says of it, shape (2, n), m.

    Returns:
        The evaluator with factors that are means over 9 places.
    """
    factor = heights / evaluate([path])[0]
    return Scaled(evaluate=evaluate, factor=uniform_filter1d(factor, _SMOOTH, axis=1, mode="nearest"))


def place_shares(edges: Edges, path: BeadPath, at: Places, fan_angle_rad: float) -> Array:
    """How far along its way the nozzle is when it passes places of a planar case.

    Args:
        edges: The edges.
        path: The path.
        at: The places.
        fan_angle_rad: theta [rad].

    Returns:
        See ``bead_refine.shares``, shape (n,).
    """
    cfg = simulation(SUBSTRATES["plane"], path, fan_angle_rad, GridCfg())
    _, landed = trace(cfg)
    _, nearest = cKDTree(landed).query(bead_laydown.centre_line(edges)(at.along_m))
    return np.asarray(shares(path)[nearest])


EVALUATORS = ("ballistic", "fast", "surrogate")


def evaluator(
    name: str, case: BeadCase, strip: Strip, at: Places, fan_angle_rad: float, weights: str | None = None
) -> Evaluator:
    """An evaluator for a case.

    Args:
        name: Of ``EVALUATORS``.
        case: The case; in a plane.
        strip: Under it.
        at: Where heights are wanted.
        fan_angle_rad: theta [rad].
        weights: The surrogate's file, see ``load_surrogate``.

    Returns:
        The evaluator.

    Raises:
        ConfigError: If the case is not in a plane, or the surrogate has no weights.
        SurrogateFileError: If they cannot be read.
    """
    require(
        case.name not in bead_laydown.SURFACES,
        f"case {case.name!r}: does not lie in a plane, which the evaluators ask for",
        ConfigError,
    )
    if name == "fast":
        return FastTier(strip=strip, places=at, fan_angle_rad=fan_angle_rad)
    left, right = place_points(strip, at.left), place_points(strip, at.right)
    if name == "ballistic":
        return Ballistic(left=left, right=right, fan_angle_rad=fan_angle_rad)
    require(weights is not None, "evaluator 'surrogate': needs a file of weights", ConfigError)
    predict = load_surrogate(str(weights)).predict
    return Sections(predict=predict, left=left, right=right, fan_angle_rad=fan_angle_rad)
