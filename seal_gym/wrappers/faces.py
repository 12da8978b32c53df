"""The disturbances as wrappers: each hands its configuration to the environment, which does the rest."""

from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from seal_gym.core.errors import ConfigError
from seal_gym.wrappers.actuation_delay import ActuationDelayCfg
from seal_gym.wrappers.base import DisturbanceCfg
from seal_gym.wrappers.cameras import CameraDropoutCfg, CameraLatencyCfg, CameraNoiseCfg, HandEyeErrorCfg
from seal_gym.wrappers.external_push import ExternalPushCfg
from seal_gym.wrappers.lighting import LightingCfg
from seal_gym.wrappers.moving_obstacle import MovingObstacleCfg
from seal_gym.wrappers.moving_workpiece import MovingWorkpieceCfg


class DisturbanceWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds a disturbance to a sealing environment; ``reset`` it afterwards.

    On a vector environment, native or Stable-Baselines3's, the disturbance is added to all rows and the
    vector itself comes back: it needs no wrapper around it. In any order the same wrappers give the same run.
    """

    kind: ClassVar[type[DisturbanceCfg]]

    def __new__(cls, env: Any = None, severity: float = 1.0, **kwargs: Any) -> Any:
        """Makes the wrapper, or disturbs a vector.

        Args:
            env: A sealing environment, single or vector; None where a wrapper is unpickled.
            severity: 0 is off, 1 the default.
            **kwargs: Further attributes of the configuration.

        Returns:
            The wrapper, or the vector.
        """
        # Gymnasium's vectors were environments until 1.0; Stable-Baselines3's never are.
        single = isinstance(env, gym.Env) and not isinstance(env, gym.vector.VectorEnv)
        if env is None or single:
            return super().__new__(cls)
        _disturb(env, cls.kind.of(severity=severity, **kwargs))
        return env

    def __init__(self, env: gym.Env[Any, Any], severity: float = 1.0, **kwargs: Any) -> None:
        """Disturbs the environment.

        Args:
            env: A sealing environment.
            severity: 0 is off, 1 the default.
            **kwargs: Further attributes of the configuration.

        Raises:
            ConfigError: If an argument is unknown or out of range, or the environment is none for sealing.
        """
        RecordConstructorArgs.__init__(self, severity=severity, **kwargs)
        gym.Wrapper.__init__(self, env)
        _disturb(env.unwrapped, self.kind.of(severity=severity, **kwargs))


def _disturb(env: Any, cfg: DisturbanceCfg) -> None:
    target = getattr(env, "unwrapped", env)
    if not hasattr(target, "disturb"):
        raise ConfigError(
            f"{cfg.name} around {type(target).__name__}: wrap a sealing environment, single or vector"
        )
    target.disturb(cfg)


class MovingWorkpiece(DisturbanceWrapper):
    """The part moves during the run; see ``MovingWorkpieceCfg``."""

    kind = MovingWorkpieceCfg


class MovingObstacle(DisturbanceWrapper):
    """A fist in the gun's way; see ``MovingObstacleCfg``."""

    kind = MovingObstacleCfg


class Lighting(DisturbanceWrapper):
    """Changing light; see ``LightingCfg``."""

    kind = LightingCfg


class CameraNoise(DisturbanceWrapper):
    """More noise; see ``CameraNoiseCfg``."""

    kind = CameraNoiseCfg


class CameraDropout(DisturbanceWrapper):
    """Lost frames; see ``CameraDropoutCfg``."""

    kind = CameraDropoutCfg


class CameraLatency(DisturbanceWrapper):
    """Late frames; see ``CameraLatencyCfg``."""

    kind = CameraLatencyCfg


class ExternalPush(DisturbanceWrapper):
    """Pushes on arm or gun; see ``ExternalPushCfg``."""

    kind = ExternalPushCfg


class HandEyeError(DisturbanceWrapper):
    """Cameras off their calibration; see ``HandEyeErrorCfg``."""

    kind = HandEyeErrorCfg


class ActuationDelay(DisturbanceWrapper):
    """Late actions; see ``ActuationDelayCfg``."""

    kind = ActuationDelayCfg
