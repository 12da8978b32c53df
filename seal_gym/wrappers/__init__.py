"""Disturbances: what a sealing run may meet, as wrappers and as the environments' ``disturbances``.

``MovingWorkpiece(env, severity=1.0)`` and ``gym.make(..., disturbances=["MovingWorkpiece"])`` are the same.
"""

from seal_gym.wrappers.catalogue import NAMES, disturbance, dynamic_regime
from seal_gym.wrappers.faces import (
    ActuationDelay,
    CameraDropout,
    CameraLatency,
    CameraNoise,
    DisturbanceWrapper,
    ExternalPush,
    HandEyeError,
    Lighting,
    MovingObstacle,
    MovingWorkpiece,
)

__all__ = [
    "NAMES",
    "ActuationDelay",
    "CameraDropout",
    "CameraLatency",
    "CameraNoise",
    "DisturbanceWrapper",
    "ExternalPush",
    "HandEyeError",
    "Lighting",
    "MovingObstacle",
    "MovingWorkpiece",
    "disturbance",
    "dynamic_regime",
]
