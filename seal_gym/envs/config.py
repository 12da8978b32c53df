"""The keyword arguments of every sealing environment, in one place."""

from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np

from seal_gym.core.cell import CellCfg, load_cell
from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.envs.adapters import CONTROLS, LeafFunction, check_leaf_function
from seal_gym.estimation.seam_rate import SEAM_RATE_GAIN
from seal_gym.rmp import SealingCfg
from seal_gym.sealant.config import SealantCfg
from seal_gym.sim.look import LookCfg
from seal_gym.tasks.progress import SealTaskCfg
from seal_gym.tasks.reward import RewardCfg
from seal_gym.vision.perception import PerceptionCfg
from seal_gym.workpieces import catalogue
from seal_gym.workpieces.workpiece import Workpiece
from seal_gym.wrappers.base import DisturbanceCfg
from seal_gym.wrappers.catalogue import disturbances

PERCEPTIONS = ("vision", "oracle")
OBSERVATIONS = ("features", "features+images")
RENDERERS = ("raycast", "gl")


def _whole(name: str, value: object, low: int, high: int) -> None:
    require(
        isinstance(value, int | np.integer) and low <= int(value) <= high,
        f"{name} = {value!r}: must be a whole number in {low}..{high}",
    )


def check_num_envs(num_envs: object) -> None:
    """Refuses a number of simulations that cannot be.

    Args:
        num_envs: Number of simulations.

    Raises:
        ConfigError: If it is not a whole number > 0.
    """
    _whole("num_envs", num_envs, 1, 65536)


def _one_of(name: str, value: object, allowed: tuple[str, ...]) -> None:
    require(value in allowed, f"{name} = {value!r}: must be one of {list(allowed)}")


class KeywordCfg:
    """The keyword arguments of an environment, for a dataclass of them."""

    @classmethod
    def of(cls, **kwargs: Any) -> Self:
        """Builds the configuration from an environment's keyword arguments.

        Args:
            **kwargs: The attributes above.

        Returns:
            The configuration.

        Raises:
            ConfigError: If a name is unknown or a value out of range.
        """
        names = [f.name for f in fields(cls)]  # type: ignore[arg-type]  # a dataclass
        unknown = sorted(set(kwargs) - set(names))
        if unknown:
            raise ConfigError(f"unknown keyword argument {unknown}: the environment takes {names}")
        return cls(**kwargs)


@dataclass(frozen=True, kw_only=True, eq=False)
class SealCfg(KeywordCfg):
    """How a sealing environment is put together.

    Attributes:
        workpiece: A name (``flat``, ``cylinder``, ``rectangular``) or a ``Workpiece``.
        control: ``"tip"`` (6 tip accelerations), ``"rmp"`` (6 f and 21 Cholesky entries of A) or ``"joint"``
            (6 joint accelerations); all in [-1, 1].
        perception: ``"vision"``: the ROI features from the sensor images; ``"oracle"``: from the true
            geometry through the calibrated cameras, without images.
        observation: ``"features"`` or ``"features+images"``.
        renderer: Of the sensor images: ``"raycast"`` (no GL) or ``"gl"``.
        sealant: ``True`` or a ``SealantCfg`` lays sealant: the action gains a pressure, the observation the
            bead that the side view shows, the metrics the bead; ``False``: the gun's motion only.
        leaves: Extra RMP leaves resolved with the policy's, with ``control="rmp"``.
        disturbances: What acts from outside, in any order (``seal_gym.wrappers``): configurations, names, or
            dictionaries as from JSON, e.g. ``{"name": "MovingWorkpiece", "severity": 1.0}``.
        task: Outcomes and displacements.
        reward: Weights of the reward.
        vision: Parameters of edge stage, line stage and tracker.
        seam_rate_gain: Share of a new difference in the estimate of the seam's motion, which policies and
            fixed leaves feed forward; 0 switches that off.
        sealing: Configuration of the fixed leaves, with ``control="rmp"``.
        look: Ranges of light, exposure, texture, blur and noise of the sensor images.
        cell: Calibration.
        threads: Threads for physics, images and vision of a vector of environments.
    """

    workpiece: str | Workpiece = "flat"
    control: str = "tip"
    perception: str = "vision"
    observation: str = "features"
    renderer: str = "raycast"
    sealant: bool | SealantCfg = False
    leaves: tuple[LeafFunction, ...] = ()
    disturbances: tuple[DisturbanceCfg, ...] = ()
    task: SealTaskCfg = field(default_factory=SealTaskCfg)
    reward: RewardCfg = field(default_factory=RewardCfg)
    vision: PerceptionCfg = field(default_factory=PerceptionCfg)
    seam_rate_gain: float = SEAM_RATE_GAIN
    sealing: SealingCfg = field(default_factory=SealingCfg)
    look: LookCfg = field(default_factory=LookCfg)
    cell: CellCfg = field(default_factory=load_cell)
    threads: int = 1

    def __post_init__(self) -> None:
        """Checks the choices."""
        catalogue.get(self.workpiece)
        kinds = {
            "task": SealTaskCfg,
            "reward": RewardCfg,
            "vision": PerceptionCfg,
            "sealing": SealingCfg,
            "look": LookCfg,
            "cell": CellCfg,
        }
        for name, kind in kinds.items():
            value = getattr(self, name)
            require(isinstance(value, kind), f"{name} = {value!r}: must be a {kind.__name__}")
        require(
            isinstance(self.leaves, tuple | list), f"leaves = {self.leaves!r}: must be a tuple of functions"
        )
        for leaf in self.leaves:
            check_leaf_function(leaf)
        require(
            isinstance(self.sealant, bool | SealantCfg),
            f"sealant = {self.sealant!r}: must be False, True or a SealantCfg",
        )
        if self.sealant is True:
            object.__setattr__(self, "sealant", SealantCfg())
        _one_of("control", self.control, CONTROLS)
        _one_of("perception", self.perception, PERCEPTIONS)
        _one_of("observation", self.observation, OBSERVATIONS)
        _one_of("renderer", self.renderer, RENDERERS)
        require(
            not self.leaves or self.control == "rmp",
            f"leaves with control = {self.control!r}: only control='rmp' resolves leaves; use it or leave "
            "them out",
        )
        require(
            not self.sealant or self.renderer == "raycast",
            f"renderer = {self.renderer!r} with sealant: its sensor images show no bead; use 'raycast'",
        )
        _whole("threads", self.threads, 1, 256)
        require(
            is_number(self.seam_rate_gain) and 0.0 <= self.seam_rate_gain <= 1.0,
            f"seam_rate_gain = {self.seam_rate_gain!r}: must be a number in 0..1",
        )
        object.__setattr__(self, "disturbances", disturbances(self.disturbances))
        object.__setattr__(self, "leaves", tuple(self.leaves))
