"""seal_gym: Gymnasium environments for vision-guided robotic sealing.

Importing this package registers the environment ids and nothing else: physics, compiler and renderers load
with the first environment.
"""

from typing import TYPE_CHECKING, Any

import gymnasium as _gym

__version__ = "0.1.0"
__all__ = ["ENV_IDS", "PALETTE_ID", "Workpiece", "__version__"]

if TYPE_CHECKING:
    from seal_gym.workpieces.workpiece import Workpiece

ENV_IDS = ("SealGym/Flat-v0", "SealGym/Cylinder-v0", "SealGym/Rectangular-v0", "SealGym/Seal-v0")
"""The sealing environments."""
PALETTE_ID = "SealGym/Palette-v0"
"""Ties on a cable-harness palette; one environment at a time."""


def _register() -> None:
    for env_id in ENV_IDS:
        if env_id in _gym.registry:
            continue
        part = env_id.removeprefix("SealGym/").removesuffix("-v0").lower()
        _gym.register(
            env_id,
            entry_point="seal_gym.envs.seal_env:SealEnv",
            vector_entry_point="seal_gym.envs.vector:SealVectorEnv",
            kwargs={"workpiece": "flat" if part == "seal" else part},
        )
    if PALETTE_ID not in _gym.registry:
        _gym.register(PALETTE_ID, entry_point="seal_gym.envs.palette_env:PaletteEnv")


def __getattr__(name: str) -> Any:
    if name == "Workpiece":
        from seal_gym.workpieces.workpiece import Workpiece  # loads MuJoCo: on demand

        return Workpiece
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


_register()
