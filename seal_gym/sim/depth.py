"""A laser profile sensor on the gun: depth across the seam, some millimetres ahead of the tip.

The classical sensor of adaptive sealing and welding (Manorathna et al. 2014, Zhou et al.'s reference 19;
with a depth sensor in Zhou et al., 4.3). It sees the part's real surfaces through MuJoCo's rays, and
nothing else.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from seal_gym.core.errors import is_number, require
from seal_gym.core.frames import Array, cross, normalise, quat_from_matrix, transform
from seal_gym.sim.scene import GROUP_FURNITURE, GROUP_PART, Scene

_MAX_POINTS = 4096


@dataclass(frozen=True, kw_only=True)
class DepthCfg:
    """The sensor.

    The defaults stand for a small laser seam tracker (a line of about 25 mm at a working distance of about
    100 mm, hundreds of points a profile), not for one maker's model. Makers state resolutions of micrometres
    on matt targets (Micro-Epsilon scanCONTROL 29xx-10: 1 um, 1280 points); bare metal scatters more, hence
    0.05 mm a point. The profile comes once a frame of the cameras; real sensors are faster.

    Attributes:
        points: In a profile.
        width_m: Of the line at the distance of the seam [m].
        look_ahead_m: Distance of the line ahead of the tip, where the seam should be [m]. Before the corner
            of a box the line runs off the wall unless the look-ahead is below the corner's radius; welding
            sensors look farther ahead, away from the arc, which a sealing gun does not have.
        origin_m: Where the fan of light leaves the sensor, in the tip frame [m]: by default in the front
            camera's place, from where it clears cartridge and nozzle.
        sigma_m: Standard deviation of a point's error along its ray [m].
        dropout: Probability that a point is missing, 0..1.
        max_incidence_rad: Faces met at a larger angle to their normal give no echo [rad].
        range_m: Farthest distance measured [m].
    """

    points: int = 160
    width_m: float = 0.025
    look_ahead_m: float = 0.003
    origin_m: tuple[float, float, float] = (0.0, 0.046, 0.095)
    sigma_m: float = 5e-5
    dropout: float = 0.02
    max_incidence_rad: float = float(np.deg2rad(80.0))
    range_m: float = 0.15

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            is_number(self.points) and int(self.points) == self.points and 8 <= self.points <= _MAX_POINTS,
            f"DepthCfg.points = {self.points!r}: must be a whole number in 8..{_MAX_POINTS}",
        )
        for name, low, high in (
            ("width_m", 1e-3, 0.5),
            ("look_ahead_m", 1e-3, 0.1),
            ("sigma_m", 0.0, 0.01),
            ("dropout", 0.0, 1.0),
            ("max_incidence_rad", 0.0, np.pi / 2),
            ("range_m", 1e-3, 2.0),
        ):
            value = getattr(self, name)
            require(
                is_number(value) and low <= value <= high,
                f"DepthCfg.{name} = {value!r}: must be a number in {low:g}..{high:.4g}",
            )
        origin = self.origin_m
        require(
            np.shape(origin) == (3,) and all(is_number(v) for v in origin) and origin[2] > 0.01,
            f"DepthCfg.origin_m = {origin!r}: must be 3 finite numbers, the last > 0.01 (above the mouth)",
        )


class Profile(NamedTuple):
    """Depth profiles of N simulations; NaN where no light came back.

    Attributes:
        across_m: To the right of the sensor's axis, shape (N, points), m; increasing where the surface is
            plain, as the rays go from left to right.
        depth_m: Along the sensor's axis, away from it, shape (N, points), m.
    """

    across_m: Array
    depth_m: Array


class DepthSensor:
    """Measures profiles of N simulations of one scene.

    Sensor frame: origin where the light leaves; x the tip's x, z the axis of the fan; the light stays in
    y = 0. Only the part and what it stands on are seen: the gun is out of the light's way.

    Attributes:
        T_tip_sensor: Shape (4, 4), m.
    """

    def __init__(self, scene: Scene, cfg: DepthCfg | None = None) -> None:
        """Mounts the sensor.

        Args:
            scene: The compiled scene.
            cfg: The sensor.
        """
        cfg = cfg or DepthCfg()
        self._cfg, self._model, self._data = cfg, scene.model, mujoco.MjData(scene.model)
        self._mocap = int(scene.model.body("part").mocapid[0])
        self._groups = np.zeros(mujoco.mjNGROUP, np.uint8)
        self._groups[[GROUP_FURNITURE, GROUP_PART]] = 1
        origin = np.array(cfg.origin_m, dtype=np.float64)
        aim = np.array([0.0, cfg.look_ahead_m, -scene.cell.process.stand_off_m])
        self.T_tip_sensor = _facing(origin, aim)
        slope = np.linspace(-0.5, 0.5, cfg.points) * cfg.width_m / float(np.linalg.norm(aim - origin))
        self._rays = normalise(np.column_stack((slope, np.zeros(cfg.points), np.ones(cfg.points))))
        self._least_cos = float(np.cos(cfg.max_incidence_rad))
        self._geom = np.zeros(cfg.points, np.int32)
        self._range = np.zeros(cfg.points)
        self._normal = np.zeros(3 * cfg.points)

    def measure(self, tip_pose: Array, part_pose: Array, rngs: Sequence[np.random.Generator]) -> Profile:
        """Takes one profile in each simulation.

        Args:
            tip_pose: ``T_base_tip``, shape (N, 4, 4), m.
            part_pose: ``T_base_part`` at this instant, shape (N, 4, 4), m.
            rngs: Source of each simulation's noise; each gives the same number of draws whatever is seen.

        Returns:
            The profiles, in the sensor frame.
        """
        ranges = np.stack([self._ranges(*row) for row in zip(tip_pose, part_pose, rngs, strict=True)])
        return Profile(ranges * self._rays[:, 0], ranges * self._rays[:, 2])

    def to_base(self, across_m: Array, depth_m: Array, tip_pose: Array) -> Array:
        """Points of profiles in the base frame.

        Args:
            across_m: Shape (...), m.
            depth_m: Shape (...), m.
            tip_pose: ``T_base_tip`` as the profile was taken, shape (4, 4), m.

        Returns:
            Shape (..., 3), m.
        """
        pose = tip_pose @ self.T_tip_sensor
        return np.asarray(pose[:3, 3] + across_m[..., None] * pose[:3, 0] + depth_m[..., None] * pose[:3, 2])

    def _ranges(self, tip_pose: Array, part_pose: Array, rng: np.random.Generator) -> Array:
        """Distances along the rays of one simulation, NaN without an echo, shape (points,), m."""
        cfg, model, data = self._cfg, self._model, self._data
        data.mocap_pos[self._mocap] = part_pose[:3, 3]
        data.mocap_quat[self._mocap] = quat_from_matrix(part_pose[:3, :3])
        mujoco.mj_kinematics(model, data)
        pose = tip_pose @ self.T_tip_sensor
        rays = self._rays @ pose[:3, :3].T
        mujoco.mj_multiRay(
            model,
            data,
            pose[:3, 3],
            rays.ravel(),
            self._groups,
            1,
            -1,
            self._geom,
            self._range,
            self._normal,
            cfg.points,
            cfg.range_m,
        )
        facing = np.abs(np.sum(rays * self._normal.reshape(-1, 3), axis=1))
        error = cfg.sigma_m * rng.standard_normal(cfg.points)
        lost = rng.random(cfg.points) < cfg.dropout
        echo = (self._geom >= 0) & (self._range <= cfg.range_m) & (facing >= self._least_cos) & ~lost
        return np.where(echo, self._range + error, np.nan)


def _facing(origin: Array, aim: Array) -> Array:
    """Pose of a frame at ``origin`` whose z points at ``aim`` and whose x is the tip's."""
    x, z = np.array([1.0, 0.0, 0.0]), normalise(aim - origin)
    y = normalise(cross(z, x))
    return transform(np.column_stack((cross(y, z), y, z)), origin)
