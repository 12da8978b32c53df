"""Policies: the RMP expert, what has learned from it, and classical baselines."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import ConfigError

if TYPE_CHECKING:
    from seal_gym.core.cell import CellCfg

__all__ = ["POLICIES", "WEIGHTS", "NamedPolicy", "Policy", "control_of", "load_policy"]

WEIGHTS = Path(__file__).parent / "weights"
"""The weights of the learned policies, ``NAME.safetensors`` with their cards ``NAME.json``."""
_FILES = (".safetensors", ".zip")


class Policy(Protocol):
    """What an evaluator needs of a policy: Stable-Baselines3's ``predict``, and the control mode.

    Attributes:
        control: The ``control`` its environment needs.
    """

    control: str

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Gives the actions for observations, of one environment or of N."""


@dataclass(frozen=True)
class NamedPolicy:
    """A policy that can be asked for.

    Attributes:
        control: The ``control`` its environment needs.
        make: Builds it for a cell (None: the one it was made for); if it senses, for an environment.
        senses: Whether it has a sensor of its own, to be mounted in the environment.
    """

    control: str
    make: Callable[[Any], Policy]
    senses: bool = False


def _adaptive(env: Any) -> Policy:
    from agents.adaptive import Adaptive  # imports mujoco

    return Adaptive.of(env)


# Imported when asked for: what they import takes MuJoCo with it, whose OpenGL backend is chosen by then.
def _expert(cell: "CellCfg | None") -> Policy:
    from agents.expert import RmpExpert

    return RmpExpert(cell)


def _pid_servo(cell: "CellCfg | None") -> Policy:
    from agents.pid_servo import PidServo

    return PidServo(cell)


def _learned(name: str, dagger: int = 0) -> Callable[["CellCfg | None"], Policy]:
    """Makes a shipped policy; its kind is its name, without ``_dagger``."""
    kind = name.removesuffix("_dagger")
    rounds = f" --dagger {dagger} --dagger-episodes 50 --dagger-epochs 6" if dagger else ""

    def make(cell: "CellCfg | None") -> Policy:
        path = WEIGHTS / f"{name}.safetensors"
        if not path.is_file():
            raise ConfigError(
                f"policy {name!r} has no weights in {WEIGHTS.parent.name}/{WEIGHTS.name} yet: collect "
                "demonstrations with `python -m agents.collect --out DATA`, train with `python -m "
                f"agents.train_bc --policy {kind} --seed 0{rounds} --data DATA --out RUN`, and load_policy"
                f"('RUN/{kind}-seed0.safetensors'), or copy that file and its .json there as {path.name}"
            )
        return _from_weights(path, cell, kind)

    return make


def _from_weights(path: Path, cell: "CellCfg | None", kind: str | None = None) -> Policy:
    from agents import policies  # needs torch: only when asked for

    policy = policies.load(path)
    if kind not in (None, policy.cfg.kind):
        raise policies.PolicyFileError(
            f"{path.name} holds a policy of kind {policy.cfg.kind!r}: must be {kind!r}; copy the right file"
        )
    if cell is not None:
        policy.check_cell(cell)
    return policy


POLICIES: dict[str, NamedPolicy] = {
    "rmp_expert": NamedPolicy("rmp", _expert),
    "pid_servo": NamedPolicy("tip", _pid_servo),
    "adaptive": NamedPolicy("tip", _adaptive, senses=True),
    "neural_rmp": NamedPolicy("rmp", _learned("neural_rmp")),
    "neural_rmp_identity": NamedPolicy("rmp", _learned("neural_rmp_identity")),
    "neural_control": NamedPolicy("tip", _learned("neural_control")),
    "neural_rmp_dagger": NamedPolicy("rmp", _learned("neural_rmp_dagger", 3)),
    "neural_control_dagger": NamedPolicy("tip", _learned("neural_control_dagger", 3)),
}


def _find(name: str, trust_zip: bool = False) -> NamedPolicy:
    """The policy of a name or of a file."""
    if name in POLICIES:
        return POLICIES[name]
    path = Path(name)
    if path.suffix == ".safetensors":
        return _in_weights(path)
    if path.suffix == ".zip":
        from agents import sb3_models

        return NamedPolicy(sb3_models.control_in(path), lambda _: sb3_models.load(path, trust_zip=trust_zip))
    raise ConfigError(
        f"policy = {name!r}: must be one of {sorted(POLICIES)}, or the path of a file {' or '.join(_FILES)}"
    )


def _in_weights(path: Path) -> NamedPolicy:
    """The policy of a file that ``agents.train_bc`` or ``agents.train_sb3`` wrote; its card says which."""
    from agents import policies, sb3_policies

    if sb3_policies.is_ours(path):
        trained = sb3_policies.load(path)
        return NamedPolicy(trained.control, lambda _: trained)
    return NamedPolicy(policies.control_in(path), lambda cell: _from_weights(path, cell))


def control_of(name: str) -> str:
    """The control mode that a policy needs.

    Args:
        name: Of the policy, as ``load_policy`` takes it.

    Returns:
        The environment's ``control``.

    Raises:
        ConfigError: If there is no such policy.
        PolicyFileError: If a file is missing, damaged or no policy.
    """
    return _find(name).control


def load_policy(
    name: str, env: Any = None, *, trust_zip: bool = False, pressure: str = "regulated"
) -> Policy:
    """A policy by name, or from a file. Nothing in a file is executed.

    Args:
        name: One of ``POLICIES``; or the path of weights that ``agents.train_bc`` or ``agents.train_sb3``
            wrote (``NAME.safetensors``); or of a model that Stable-Baselines3 saved (``NAME.zip``), of which
            the parameters are read and the policy built anew.
        env: The environment it will act in, single or vectorised: checked against the policy's control mode,
            and the source of the cell's calibration. A policy with a sensor of its own (``adaptive``) needs
            it, and acts in no other.
        trust_zip: Lets Stable-Baselines3 load a ``.zip``, which can run any code that is in it: for models
            that cannot be built anew (custom policies, images), from a source you trust.
        pressure: In an environment with sealant, who presses the gun (``agents.pressure.PRESSURES``).

    Returns:
        The policy.

    Raises:
        ConfigError: If there is no such policy, it has no weights yet, the environment's control mode or
            cell is another, or a policy that senses is given no environment.
        PolicyFileError: If a file is missing, damaged or no policy.
    """
    found = _find(name, trust_zip)
    if env is None:
        return found.make(None)
    core = getattr(getattr(env, "unwrapped", env), "core", None)
    if core is None:
        raise ConfigError(
            f"policy {name!r} seals, and {env} is no sealing environment; for palettes there is "
            "agents.palette_expert.PaletteExpert"
        )
    cfg = core.cfg
    if cfg.control != found.control:
        raise ConfigError(
            f"policy {name!r} acts with control={found.control!r}, the environment has {cfg.control!r}: "
            f"make it with control={found.control!r}"
        )
    policy = found.make(env if found.senses else cfg.cell)
    if not cfg.sealant:
        return policy
    from agents.pressure import with_pressure

    return with_pressure(policy, cfg.cell, cfg.sealant, pressure)
