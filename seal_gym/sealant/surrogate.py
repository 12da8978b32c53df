"""A surrogate of laydown simulations: cross-sections of a bead from what is known along the tip's path.

Paper B 3.2: at a station of the path the tip's linear and angular velocity, gravity and 41 heights over the
substrate, all in the tip's frame, tell what the bead looks like in a window of 40 x 20 pixels of 1 mm.
``load_surrogate`` reads weights that ``agents.train_surrogate`` wrote; ``Surrogate.predict`` uses them.

Features and the fast tier (``Features.fan``) need no weights; models need torch and safetensors.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.core.frames import Array
from seal_gym.sealant.fan_section import SLAB_M, check, filled, surface_m, swept_thickness_m
from seal_gym.sealant.laydown.sections import RAYS

if TYPE_CHECKING:
    from seal_gym.sealant.surrogate_net import SectionNet

KINDS = ("linear", "mlp_cnn")
FORMAT, VERSION = "seal_gym surrogate", 1
SPACING_M = 10e-3  # between neighbours, paper B 3.2.3
KINEMATIC = 9
PLANES_M = tuple(k * SLAB_M for k in (-2.0, -1.0, 0.0, 1.0, 2.0))
_WINDOW = PLANES_M.index(0.0)
_MOST_NEIGHBOURS = 8
_LONGEST_FILE = 64 * 2**20
# Seen in a mirror at x = 0: a velocity is a vector, an angular velocity a pseudovector.
_MIRROR = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0, 1.0])


class SurrogateFileError(SealGymError, ValueError):
    """A file holds no surrogate of ours, or a damaged one."""


class StationsLike(Protocol):
    """What ``laydown.sections.Stations`` has."""

    @property
    def arcs_m(self) -> Array:
        """Along the tip's path, shape (n,) [m]."""

    @property
    def linear_mps(self) -> Array:
        """Of the tip, in its frame, shape (n, 3) [m/s]."""

    @property
    def angular_radps(self) -> Array:
        """Of the tip, in its frame, shape (n, 3) [rad/s]."""

    @property
    def gravity_mps2(self) -> Array:
        """In the tip's frame, shape (n, 3) [m/s2]."""

    @property
    def heights_m(self) -> Array:
        """Along 41 rays, shape (n, 41) [m]."""


@dataclass(frozen=True, kw_only=True)
class SurrogateCfg:
    """What a surrogate is, besides its weights.

    Attributes:
        kind: ``"linear"``: the glass box y = W x + b; ``"mlp_cnn"``: backbones, merge, convolutions.
        neighbours: N_m, stations before and after that it is told of as well, half of them each, 10 mm apart.
        on_fan: Whether it predicts what to add to the fast tier's section. It then sees the substrate in the
            window and what the fast tier lays there, 6 and 12 mm before and behind.
        hidden: Width of the fully connected layers.
        channels: Of the convolutions.
    """

    kind: str
    neighbours: int = 0
    on_fan: bool = False
    hidden: int = 64
    channels: int = 12

    def __post_init__(self) -> None:
        """Checks the choices."""
        require(self.kind in KINDS, f"kind = {self.kind!r}: must be one of {list(KINDS)}")
        even = range(0, _MOST_NEIGHBOURS + 1, 2)
        require(
            type(self.neighbours) is int and self.neighbours in even,
            f"neighbours = {self.neighbours!r}: must be one of {list(even)}",
        )
        require(isinstance(self.on_fan, bool), f"on_fan = {self.on_fan!r}: must be True or False")
        for name, value in (("hidden", self.hidden), ("channels", self.channels)):
            require(
                type(value) is int and 4 <= value <= 512 and value % 4 == 0,
                f"{name} = {value!r}: must be a multiple of 4 in 4..512",
            )


@dataclass(frozen=True)
class Features:
    """The inputs of n sections.

    Attributes:
        kinematic: Linear, angular velocity and gravity of the station and its neighbours, then for each
            neighbour whether the path goes on so far: shape (n, 9 (N + 1) + N).
        spatial: Heights of the station and its neighbours, shape (n, 41 (N + 1)) [m].
        surface: Of the substrate over the window's lower edge, column by column, shape (n, 40) [m].
        laid: What the fast tier lays in the planes ``PLANES_M`` around the window's, shape (n, 5, 40) [m].
    """

    kinematic: Array
    spatial: Array
    surface: Array
    laid: Array

    def __len__(self) -> int:
        """The number of sections."""
        return len(self.kinematic)

    def rows(self, rows: Any) -> "Features":
        """Some of the sections.

        Args:
            rows: An index into the first axis.

        Returns:
            Their features.
        """
        return Features(*(getattr(self, f.name)[rows] for f in fields(self)))

    def fan(self) -> Array:
        """The fast tier's sections.

        Returns:
            Shares of sealant in [0, 1], shape (n, 20, 40).
        """
        return filled(self.surface + self.laid[:, _WINDOW]) - filled(self.surface)

    def flat(self) -> Array:
        """The input vector x of the linear model.

        Returns:
            Kinematic and spatial inputs, shape (n, k).
        """
        return np.concatenate((self.kinematic, self.spatial), 1)

    def mirrored(self) -> "Features":
        """The same stations seen in a mirror at x = 0; sections are then mirrored too.

        Returns:
            The features.
        """
        places = self.spatial.shape[1] // RAYS
        signs = np.append(np.tile(_MIRROR, places), np.ones(places - 1))
        heights = self.spatial.reshape(-1, places, RAYS)[:, :, ::-1].reshape(self.spatial.shape)
        return Features(self.kinematic * signs, heights, self.surface[:, ::-1], self.laid[..., ::-1])


def joined(parts: list[Features]) -> Features:
    """The sections of several beads.

    Args:
        parts: At least one.

    Returns:
        One after the other.
    """
    return Features(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Features)))


def features(at: StationsLike, neighbours: int = 0) -> Features:
    """What a surrogate is told along one bead.

    Args:
        at: Stations of one path, in order, less than 10 mm apart.
        neighbours: N_m, even. Beyond an end of the path its last station stands in.

    Returns:
        The features of each station.

    Raises:
        ConfigError: If shapes do not fit, a number is not finite or the arc lengths do not rise, or there are
            fewer than two stations.
    """
    heights = check("heights_m", at.heights_m, RAYS)
    n = len(heights)
    arcs = check("arcs_m", np.asarray(at.arcs_m)[:, None], 1, n)[:, 0]
    names = ("linear_mps", "angular_radps", "gravity_mps2")
    linear, angular, gravity = (check(name, getattr(at, name), 3, n) for name in names)
    own = np.concatenate((linear, angular, gravity), 1)
    half = neighbours // 2
    shifts = [k * SPACING_M for k in (*range(-half, 0), *range(1, half + 1))]
    wanted = arcs + np.array(shifts)[:, None] if shifts else np.zeros((0, n))
    index = [np.abs(arcs - row[:, None]).argmin(1) for row in wanted]
    slack = 0.5e-3  # a station is where it should be to within rounding
    there = [((row > arcs[0] - slack) & (row < arcs[-1] + slack)).astype(float) for row in wanted]
    kinematic = np.concatenate([own, *(own[i] for i in index), *(t[:, None] for t in there)], 1)
    spatial = np.concatenate([heights, *(heights[i] for i in index)], 1)
    laid = swept_thickness_m(arcs, linear, angular, heights, PLANES_M)
    return Features(kinematic, spatial, surface_m(heights), laid)


class Surrogate:
    """A model with its weights.

    Attributes:
        cfg: What it is.
        net: The layers.
        card: Where the weights are from; empty for a model that was not loaded.
    """

    def __init__(
        self, cfg: SurrogateCfg, net: "SectionNet | None" = None, card: Mapping[str, Any] | None = None
    ) -> None:
        """Takes the layers.

        Args:
            cfg: What it is.
            net: The layers; new ones, with torch's global generator, by default.
            card: Where the weights are from.
        """
        from seal_gym.sealant.surrogate_net import SectionNet  # imports torch

        self.cfg, self.net, self.card = cfg, net or SectionNet(cfg), dict(card or {})
        self.net.eval()

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return sum(p.numel() for p in self.net.parameters())

    def predict(self, at: StationsLike) -> Array:
        """Cross-sections along one bead.

        Args:
            at: Its stations, as ``laydown.sections.stations`` makes them.

        Returns:
            Shares of sealant in [0, 1], shape (n, 20, 40), as ``laydown.sections.cut`` gives them.

        Raises:
            ConfigError: If a shape or a number is out of range.
        """
        return self.sections(features(at, self.cfg.neighbours))

    def sections(self, inputs: Features) -> Array:
        """Cross-sections of features.

        Args:
            inputs: Of the model's ``neighbours``.

        Returns:
            Shares of sealant in [0, 1], shape (n, 20, 40).
        """
        return np.clip(self.net.run(inputs), 0.0, 1.0)


def _both(path: str | Path) -> tuple[Path, Path]:
    path = Path(path)
    require(
        path.suffix == ".safetensors", f"path = {str(path)!r}: a surrogate's weights are in NAME.safetensors"
    )
    return path, path.with_suffix(".json")


def save_surrogate(model: Surrogate, path: str | Path, card: Mapping[str, Any]) -> None:
    """Writes a surrogate: ``NAME.safetensors`` with the weights, ``NAME.json`` with the card.

    Args:
        model: To write.
        path: ``NAME.safetensors``; its folder must be there.
        card: Where it comes from, ready for JSON. ``format``, ``version``, ``config``, ``parameters`` and
            ``sha256`` are added.

    Raises:
        ConfigError: If the path ends otherwise or a weight is not finite.
    """
    from safetensors.numpy import save as write_tensors

    weights, about = _both(path)
    tensors = model.net.arrays()
    finite = all(bool(np.isfinite(t).all()) for t in tensors.values())
    require(finite, "the model has weights that are not finite: train it anew")
    data = write_tensors(tensors)
    written = {
        **card,
        "format": FORMAT,
        "version": VERSION,
        "config": asdict(model.cfg),
        "parameters": model.parameters,
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    weights.write_bytes(data)
    text = json.dumps(written, indent=2, sort_keys=True, allow_nan=False) + "\n"
    about.write_text(text, encoding="utf-8")


def load_surrogate(path: str | Path) -> Surrogate:
    """Reads a surrogate that ``save_surrogate`` wrote. Nothing in the files is executed.

    Args:
        path: ``NAME.safetensors``; the card ``NAME.json`` stands beside it.

    Returns:
        The surrogate.

    Raises:
        ConfigError: If the path ends otherwise.
        SurrogateFileError: If a file is missing, truncated, damaged or not a surrogate's.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load as read_tensors

    weights, about = _both(path)
    try:
        if weights.stat().st_size > _LONGEST_FILE:
            raise SurrogateFileError(f"{weights.name}: no surrogate of ours is so large")
        data, text = weights.read_bytes(), about.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SurrogateFileError(
            f"{weights} cannot be read ({error}): a surrogate is NAME.safetensors with NAME.json beside it"
        ) from error
    card = _card(text, about.name)
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        raise SurrogateFileError(
            f"{weights.name} is not the file that {about.name} describes (its SHA-256 differs): "
            "copy both again"
        )
    try:
        model = Surrogate(SurrogateCfg(**card["config"]), card=card)
        model.net.take(read_tensors(data))
    except (ConfigError, SafetensorError, RuntimeError, TypeError, KeyError, ValueError) as error:
        raise SurrogateFileError(f"{weights.name} or {about.name} is damaged: {error}") from error
    return model


def _card(text: str, name: str) -> dict[str, Any]:
    try:
        card = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SurrogateFileError(f"{name} is no card of a surrogate: not JSON ({error})") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        raise SurrogateFileError(f"{name} is no card of a surrogate: it does not say format = {FORMAT!r}")
    if card.get("version") != VERSION:
        raise SurrogateFileError(f"{name} has version {card.get('version')!r}: this release reads {VERSION}")
    return card
