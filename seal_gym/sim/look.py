"""What varies in the sensor images from run to run: lamp, exposure, noise, blur and texture."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import require
from seal_gym.core.frames import Array
from seal_gym.sim.texture import PERIOD_M

Range = tuple[float, float]
MAX_BLUR_PX = 6.0
_DRAWS = 9


@dataclass(frozen=True, kw_only=True)
class LookCfg:
    """Ranges that a run's look is drawn from, uniformly.

    The lamp is fixed to the gun, so that the contrast at the seam stays as the gun goes round a part. By
    default it shines from above the plate: plate and wall then differ by 25 grey levels or more.

    Attributes:
        lamp_x: x / z of the direction towards the lamp in the tip frame; negative: plate brighter than wall.
        lamp_y: y / z of that direction.
        ambient: Light that reaches every face, as a fraction of full exposure.
        diffuse: Light of the lamp on a face that looks at it.
        contrast: Relative change of the grey levels' spread about the middle.
        brightness: Change of all grey levels, as a fraction of 255.
        texture: Factor on ``Material.texture``.
        noise_sigma: Standard deviation of the sensor noise, of 255.
        blur_px: Length of the motion blur along the travel [px].
        clip_fraction: The exposure is changed until at most this fraction of the ROI's pixels clips.
    """

    lamp_x: Range = (-0.8, -0.1)
    lamp_y: Range = (-0.35, 0.35)
    ambient: Range = (0.30, 0.40)
    diffuse: Range = (0.55, 0.75)
    contrast: Range = (-0.3, 0.3)
    brightness: Range = (-0.3, 0.3)
    texture: Range = (0.5, 1.5)
    noise_sigma: float = 8.0
    blur_px: float = 1.0
    clip_fraction: float = 0.02

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (
            ("lamp_x", -10.0, 10.0),
            ("lamp_y", -10.0, 10.0),
            ("ambient", 0.0, 1.0),
            ("diffuse", 0.0, 1.0),
            ("contrast", -0.9, 2.0),
            ("brightness", -1.0, 1.0),
            ("texture", 0.0, 5.0),
        ):
            value = getattr(self, name)
            require(
                len(value) == 2 and low <= value[0] <= value[1] <= high,
                f"LookCfg.{name} = {value!r}: must be (lowest, highest), both within {low}..{high}",
            )
        for name, high in (("noise_sigma", 128.0), ("blur_px", MAX_BLUR_PX), ("clip_fraction", 1.0)):
            value = getattr(self, name)
            require(0.0 <= value <= high, f"LookCfg.{name} = {value!r}: must be within 0..{high}")

    @classmethod
    def clean(cls) -> Self:
        """No noise, blur or texture and a neutral exposure, for geometry.

        Returns:
            The configuration; every draw from it is the same but for the unused texture offset and seed.
        """
        return cls(
            lamp_x=(-0.45, -0.45),
            lamp_y=(0.0, 0.0),
            ambient=(0.35, 0.35),
            diffuse=(0.65, 0.65),
            contrast=(0.0, 0.0),
            brightness=(0.0, 0.0),
            texture=(0.0, 0.0),
            noise_sigma=0.0,
            blur_px=0.0,
        )


class Look(NamedTuple):
    """The looks of N simulations; rows may be changed in place, which is how light disturbances work.

    Attributes:
        lamp: Unit direction towards the lamp in the tip frame, shape (N, 3).
        ambient: Shape (N,).
        diffuse: Shape (N,).
        contrast: Shape (N,).
        brightness: Shape (N,).
        texture: Factor on ``Material.texture``, shape (N,).
        texture_offset: Added to the texture coordinates, shape (N, 2), m.
        noise_sigma: Shape (N,), grey levels.
        blur_px: At most ``MAX_BLUR_PX``, shape (N,), px.
        clip_fraction: Shape (N,).
        seed: Seed of the noise, shape (N,).
        shadow: A band of shadow on the part: unit normal of its middle plane in the tip frame, the plane's
            distance from the tip [m], half the band's width [m], share of the light it takes; 0: no shadow,
            shape (N, 6).
        ball: An obstacle in the view: centre in the world frame and radius [m]; 0: none, shape (N, 4).
    """

    lamp: Array
    ambient: Array
    diffuse: Array
    contrast: Array
    brightness: Array
    texture: Array
    texture_offset: Array
    noise_sigma: Array
    blur_px: Array
    clip_fraction: Array
    seed: NDArray[np.uint64]
    shadow: Array
    ball: Array

    @classmethod
    def empty(cls, n: int) -> Self:
        """Room for N looks.

        Args:
            n: Number of simulations.

        Returns:
            All dark, until ``draw`` fills them.
        """
        lamp = np.zeros((n, 3))
        lamp[:, 2] = 1.0
        return cls(
            lamp=lamp,
            ambient=np.zeros(n),
            diffuse=np.zeros(n),
            contrast=np.zeros(n),
            brightness=np.zeros(n),
            texture=np.zeros(n),
            texture_offset=np.zeros((n, 2)),
            noise_sigma=np.zeros(n),
            blur_px=np.zeros(n),
            clip_fraction=np.zeros(n),
            seed=np.zeros(n, np.uint64),
            shadow=np.zeros((n, 6)),
            ball=np.zeros((n, 4)),
        )

    def draw(self, i: int, rng: np.random.Generator, cfg: LookCfg) -> None:
        """Fills row ``i``; takes the same number of draws whatever the configuration.

        Args:
            i: Row.
            rng: Source of randomness.
            cfg: Ranges.
        """
        u = rng.random(_DRAWS)
        self.seed[i] = rng.integers(2**64, dtype=np.uint64)
        ranges = (cfg.lamp_x, cfg.lamp_y, cfg.ambient, cfg.diffuse, cfg.contrast, cfg.brightness, cfg.texture)
        value = [low + (high - low) * float(x) for (low, high), x in zip(ranges, u[:7], strict=True)]
        # Slopes instead of angles: no sine, whose last bit differs between machines.
        x, y = value[:2]
        self.lamp[i] = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
        self.ambient[i], self.diffuse[i] = value[2:4]
        self.contrast[i], self.brightness[i], self.texture[i] = value[4:]
        self.texture_offset[i] = u[7:] * PERIOD_M
        self.noise_sigma[i], self.blur_px[i] = cfg.noise_sigma, cfg.blur_px
        self.clip_fraction[i] = cfg.clip_fraction
