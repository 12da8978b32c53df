"""The keyword arguments of the palette environment."""

from dataclasses import dataclass, field

import numpy as np

from seal_gym.core.cell import CellCfg, OverheadCfg, load_cell
from seal_gym.core.errors import is_number, require
from seal_gym.envs.config import KeywordCfg
from seal_gym.sim.look import LookCfg
from seal_gym.sim.palette_scene import BOARD_TOP_M
from seal_gym.sim.rgbd import DepthNoiseCfg
from seal_gym.tasks.pressing import PressRewardCfg, PressTaskCfg
from seal_gym.vision.palette_seen import Observer
from seal_gym.vision.palette_ties import TieObserver
from seal_gym.workpieces.palette import LayoutCfg

CONTROLS = ("tip", "joint")
PERCEPTIONS = ("vision", "oracle")
OBSERVATIONS = ("features", "features+images")


@dataclass(frozen=True, kw_only=True)
class PlacementCfg:
    """Where palette and tool are at first (world frame: the robot's base).

    Attributes:
        palette_x_m: Nominal distance of the board's middle before the robot [m].
        shift_m: Largest displacement of the palette in x and y [m].
        yaw_rad: Largest rotation of the palette [rad].
        home_m: Middle of the tool's start: beside the board, out of the camera's view [m].
        spread_m: Half size of the box round it that the start is drawn from [m].
    """

    palette_x_m: float = 0.45
    shift_m: float = 0.02
    yaw_rad: float = float(np.deg2rad(15.0))
    home_m: tuple[float, float, float] = (0.22, -0.40, 0.16)
    spread_m: tuple[float, float, float] = (0.06, 0.04, 0.05)

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("palette_x_m", 0.35, 0.55),
            ("shift_m", 0.0, 0.05),
            ("yaw_rad", 0.0, float(np.deg2rad(30.0))),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"PlacementCfg.{name} = {value!r}: must be a number in {low}..{high:.3g}",
            )
        for name in ("home_m", "spread_m"):
            value = getattr(self, name)
            require(
                np.shape(value) == (3,) and all(map(is_number, value)),
                f"PlacementCfg.{name} = {value!r}: must be 3 finite numbers",
            )


def _overhead() -> OverheadCfg:
    """Above the palette, about 1 mm a pixel."""
    return OverheadCfg(
        position_mm=(450.0, 0.0, 850.0),
        target_mm=(450.0, 0.0, 0.0),
        up=(1.0, 0.0, 0.0),
        frame_px=(400, 480),
        focal_px=830.0,
    )


def _light() -> LookCfg:
    """Of the room: a lamp from any side, not the gun's."""
    return LookCfg(lamp_x=(-0.6, 0.6), lamp_y=(-0.6, 0.6), blur_px=0.0)


def _observer() -> TieObserver:
    """What is clearly above the table is the palette."""
    return TieObserver(floor_m=BOARD_TOP_M - 0.03)


@dataclass(frozen=True, kw_only=True, eq=False)
class PaletteCfg(KeywordCfg):
    """How the palette environment is put together.

    Attributes:
        control: ``"tip"`` (6 tip accelerations) or ``"joint"`` (6 joint accelerations), in [-1, 1].
        perception: ``"vision"``: the features tell where ``observer`` saw the targets in the picture taken at
            the start; ``"oracle"``: where they are.
        observation: ``"features"`` or ``"features+images"``.
        observer: see ``seal_gym.vision.palette_seen.Observer``; the Hopfield
            observer by default.
        layout: Ranges of the palettes.
        placement: Where palette and tool are at first.
        task: What counts as done, and when an episode ends.
        reward: Weights of the reward.
        look: Ranges of light, exposure, texture and noise of the pictures; the lamp shines from the room.
        depth_noise: Errors of the depth pictures.
        camera: The RGB-D camera above.
        cell: Timing and limits.
    """

    control: str = "tip"
    perception: str = "vision"
    observation: str = "features"
    observer: Observer = field(default_factory=_observer)
    layout: LayoutCfg = field(default_factory=LayoutCfg)
    placement: PlacementCfg = field(default_factory=PlacementCfg)
    task: PressTaskCfg = field(default_factory=PressTaskCfg)
    reward: PressRewardCfg = field(default_factory=PressRewardCfg)
    look: LookCfg = field(default_factory=_light)
    depth_noise: DepthNoiseCfg = field(default_factory=DepthNoiseCfg)
    camera: OverheadCfg = field(default_factory=_overhead)
    cell: CellCfg = field(default_factory=load_cell)

    def __post_init__(self) -> None:
        """Checks the choices."""
        choices = (("control", CONTROLS), ("perception", PERCEPTIONS), ("observation", OBSERVATIONS))
        for name, allowed in choices:
            value = getattr(self, name)
            ok = isinstance(value, str) and value in allowed
            require(ok, f"{name} = {value!r}: must be one of {list(allowed)}")
        kinds = {
            "layout": LayoutCfg,
            "placement": PlacementCfg,
            "task": PressTaskCfg,
            "reward": PressRewardCfg,
            "look": LookCfg,
            "depth_noise": DepthNoiseCfg,
            "camera": OverheadCfg,
            "cell": CellCfg,
        }
        for name, kind in kinds.items():
            value = getattr(self, name)
            require(isinstance(value, kind), f"{name} = {value!r}: must be a {kind.__name__}")
        require(
            callable(self.observer),
            f"observer = {self.observer!r}: must be a function of a picture, its depth and the camera",
        )
