"""A fixed RGB-D camera without OpenGL: MuJoCo's rays give shape and depth, Lambert's law the colour."""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from seal_gym.core.cell import OverheadCfg
from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, normalise
from seal_gym.sim import texture
from seal_gym.sim.look import Look
from seal_gym.sim.scene import GROUP_FURNITURE, GROUP_PART, GROUP_ROBOT

_TEXTURE = 0.08  # amplitude of grain and scratches on every surface, as ``Material.texture``
_CLIP_SIGMAS = 2.0
_MAX_CLIP_MARGIN = 40.0


@dataclass(frozen=True, kw_only=True)
class DepthNoiseCfg:
    """Errors of the depth picture.

    Attributes:
        sigma_m: Standard deviation of a pixel's error [m].
        dropout: Probability that a pixel has no depth, 0..1.
        range_m: Farthest distance measured [m].
    """

    sigma_m: float = 1e-3
    dropout: float = 0.01
    range_m: float = 2.0

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (("sigma_m", 0.0, 0.05), ("dropout", 0.0, 0.9), ("range_m", 0.1, 20.0)):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"DepthNoiseCfg.{name} = {value!r}: must be a number in {low:g}..{high:g}",
            )


class Picture(NamedTuple):
    """What an RGB-D camera gives.

    Attributes:
        rgb: Shape (H, W, 3).
        depth_m: Along the optical axis, NaN where there is none, shape (H, W), m.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


class Ideal(NamedTuple):
    """A picture before the sensor.

    Attributes:
        rgb: Grey levels 0..255, shape (H, W, 3).
        depth_m: Along the optical axis, infinite where nothing is, shape (H, W), m.
        geom: Number of the geom seen, -1 for none, shape (H, W).
    """

    rgb: Array
    depth_m: Array
    geom: NDArray[np.int32]


class RgbdCamera:
    """Takes pictures of one model.

    Attributes:
        cfg: Where it hangs and how it looks.
    """

    def __init__(self, model: mujoco.MjModel, cfg: OverheadCfg) -> None:
        """Hangs the camera up.

        Args:
            model: The MuJoCo model.
            cfg: Where it hangs and how it looks.
        """
        self.cfg, self._model = cfg, model
        width, height = cfg.frame_px
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = (u - width / 2) / cfg.focal_px, (v - height / 2) / cfg.focal_px
        rays = np.stack((x, y, np.ones_like(x)), axis=-1).reshape(-1, 3)
        self._forward = 1.0 / np.linalg.norm(rays, axis=1)
        self._rays = np.ascontiguousarray(normalise(rays) @ cfg.pose[:3, :3].T)
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[[GROUP_FURNITURE, GROUP_PART, GROUP_ROBOT]] = 1
        colour, material = model.geom_rgba[:, :3].astype(np.float64), model.geom_matid
        colour[material >= 0] = model.mat_rgba[material[material >= 0], :3]
        self._colour = 255.0 * colour

    def ideal(self, data: mujoco.MjData, look: Look) -> Ideal:
        """The picture before noise and exposure.

        Args:
            data: State with positions up to date.
            look: One look; its lamp shines along the world's axes.

        Returns:
            See ``Ideal``.
        """
        width, height = self.cfg.frame_px
        count, origin = len(self._rays), self.cfg.pose[:3, 3].copy()
        geom, distance, normal = np.zeros(count, np.int32), np.zeros(count), np.zeros(3 * count)
        rays = self._rays.ravel()
        mujoco.mj_multiRay(
            self._model, data, origin, rays, self._groups, 1, -1, geom, distance, normal, count, np.inf
        )
        hit = geom >= 0
        point = origin + distance[:, None] * self._rays
        cosine = np.maximum(normal.reshape(-1, 3) @ look.lamp[0], 0.0)
        light = look.ambient[0] + look.diffuse[0] * cosine
        light *= 1.0 + _TEXTURE * look.texture[0] * _grain(point[:, :2] + look.texture_offset[0])
        rgb = np.where(hit[:, None], self._colour[geom] * light[:, None], 0.0)
        depth = np.where(hit, distance * self._forward, np.inf)
        shape = (height, width)
        return Ideal(rgb.reshape(*shape, 3), depth.reshape(shape), geom.reshape(shape))

    def sense(self, ideal: Ideal, look: Look, noise: DepthNoiseCfg, rng: np.random.Generator) -> Picture:
        """What the sensor makes of it: exposure, noise in every channel, rounding, and depth with gaps.

        The camera stands still, so nothing blurs.

        Args:
            ideal: From ``ideal``.
            look: One look.
            noise: Errors of the depth.
            rng: Source of the noise.

        Returns:
            The picture.
        """
        gain, offset = exposure(ideal.rgb, look)
        grey = gain * ideal.rgb + offset + look.noise_sigma[0] * rng.standard_normal(ideal.rgb.shape)
        depth = ideal.depth_m + noise.sigma_m * rng.standard_normal(ideal.depth_m.shape)
        lost = (rng.random(depth.shape) < noise.dropout) | (ideal.depth_m > noise.range_m)
        rgb = np.clip(np.floor(grey + 0.5), 0.0, 255.0).astype(np.uint8)
        return Picture(rgb, np.where(lost, np.nan, depth).astype(np.float32))


def _grain(point: Array) -> Array:
    """The texture's factor at points of the world's plane, shape (n,)."""
    texel = np.floor(np.where(np.isfinite(point), point, 0.0) / texture.TEXEL_M).astype(np.int64)
    texel %= texture.SIZE
    return texture.modulation()[texel[:, 1], texel[:, 0]]


def exposure(rgb: Array, look: Look) -> tuple[float, float]:
    """Gain and offset of the grey levels: contrast and brightness, less what would clip too many pixels.

    As the sealing gun's cameras expose (``raycast``): up to ``clip_fraction`` of the pixels may clip.

    Args:
        rgb: Grey levels 0..255, shape (H, W, 3).
        look: One look.

    Returns:
        Gain and offset [grey levels].
    """
    gain = 1.0 + float(look.contrast[0])
    offset = 127.5 * (1.0 - gain) + 255.0 * float(look.brightness[0])
    share = float(look.clip_fraction[0])
    if share >= 1.0:
        return gain, offset
    margin = min(_CLIP_SIGMAS * float(look.noise_sigma[0]), _MAX_CLIP_MARGIN)
    low = float(np.quantile(rgb.min(axis=2), 0.4 * share))
    high = float(np.quantile(rgb.max(axis=2), 1.0 - 0.4 * share))
    space = 255.0 - 2.0 * margin
    if gain * (high - low) > space:
        smaller = space / (high - low)
        offset += (gain - smaller) * 127.5
        gain = smaller
    offset = min(offset, 255.0 - margin - gain * high)
    return gain, max(offset, margin - gain * low)
