"""How sealant is simulated in an environment."""

from dataclasses import dataclass, field

from seal_gym.core.errors import is_number, require
from seal_gym.sealant.pneumatics import GunCfg, Sealant, get_sealant


@dataclass(frozen=True, kw_only=True)
class SealantCfg:
    """The sealant, the gun that presses it out, and what bead is wanted.

    Attributes:
        sealant: A name (see ``SEALANTS``) or a ``Sealant``.
        gun: Nozzle, valve and line.
        section_mm2: Wanted section of the bead on a straight seam [mm^2]; around bends the same profile.
        variation: Half the range, relative, of yield stress and consistency from run to run: a cartridge is
            never the same twice, and the policy is not told.
        reward: Weight of the bead's term in the reward; 0: none.
        spacing_m: Between the columns of the bead's grid [m].
        half_width_m: How far the grid reaches to either side of the seam [m].
    """

    sealant: str | Sealant = "neutral_silicone"
    gun: GunCfg = field(default_factory=GunCfg)
    section_mm2: float = 7.0
    variation: float = 0.15
    reward: float = 0.0
    spacing_m: float = 0.5e-3
    half_width_m: float = 8e-3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        object.__setattr__(self, "sealant", get_sealant(self.sealant))
        require(isinstance(self.gun, GunCfg), f"SealantCfg.gun = {self.gun!r}: must be a GunCfg")
        for name, low, high in (
            ("section_mm2", 0.5, 40.0),
            ("variation", 0.0, 0.9),
            ("reward", 0.0, 100.0),
            ("spacing_m", 0.2e-3, 1e-3),
            ("half_width_m", 4e-3, 15e-3),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"SealantCfg.{name} = {value!r}: must be a number in {low:g}..{high:g}",
            )

    @property
    def fluid(self) -> Sealant:
        """The sealant at its nominal parameters."""
        return get_sealant(self.sealant)
