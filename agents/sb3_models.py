"""Models that Stable-Baselines3 saved, as policies, without running what may be in their files.

Stable-Baselines3's own ``load`` unpickles parts of the file, and a pickle can run any code. So only the
parameters are read here, by torch's reader that takes nothing but tensors, and the plain text of the
description; from these the policy is built anew. That covers ``MlpPolicy`` of PPO, A2C, SAC and TD3 on the
features, with any ``net_arch`` and the usual activations. Anything else needs the pickles, and a caller who
trusts the file.
"""

import io
import json
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from agents.policies import PolicyFileError, card_path, check_tensors
from seal_gym.core.errors import require
from seal_gym.envs.adapters import CONTROLS
from seal_gym.envs.core import FEATURES

_BY_SIZE = {6: "tip", 27: "rmp"}
# Entries of a saved model that only this algorithm has, first match wins.
_TELLTALES = {"clip_range": "PPO", "target_entropy": "SAC", "policy_delay": "TD3", "n_steps": "A2C"}
_LONGEST_DATA = 64 * 2**20
_LONGEST_PARAMETERS = 256 * 2**20
_TORCH = (2, 6)  # before, even the reader of tensors could be made to run code (CVE-2025-32434)
# The class of ``MlpPolicy`` for each algorithm, and its module, as the description names it.
_MLP_POLICIES = {
    "PPO": ("ActorCriticPolicy", "stable_baselines3.common.policies"),
    "A2C": ("ActorCriticPolicy", "stable_baselines3.common.policies"),
    "SAC": ("SACPolicy", "stable_baselines3.sac.policies"),
    "TD3": ("TD3Policy", "stable_baselines3.td3.policies"),
}
# Arguments of a policy that do not change what its mean action is, or only the optimiser.
_NO_MATTER = ("optimizer_class", "optimizer_kwargs", "log_std_init", "ortho_init")
_ACTIVATIONS = ("Tanh", "ReLU", "ELU", "GELU", "LeakyReLU", "SiLU", "Sigmoid", "Softplus")
# Schedules are pickled functions, which need not load on another Python and which only training needs.
_UNUSED = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.0, "clip_range_vf": None}


class Sb3Policy:
    """A model or policy of Stable-Baselines3 that knows its control mode.

    Attributes:
        model: The model, or the policy that was rebuilt from its file.
        control: The ``control`` its environment needs.
    """

    def __init__(self, model: Any, control: str) -> None:
        """Takes the model.

        Args:
            model: The model or the policy.
            control: What its actions mean.
        """
        self.model, self.control = model, control

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """As the model's ``predict``.

        Args:
            observation: Of one environment or of N.
            state: Of recurrent models.
            episode_start: Of recurrent models.
            deterministic: Whether to take the mean.

        Returns:
            Actions and the new state.
        """
        action, state = self.model.predict(observation, state, episode_start, deterministic)
        return action, state


def control_in(path: Path) -> str:
    """What the actions of a saved model mean.

    Args:
        path: ``NAME.zip``.

    Returns:
        The entry ``control`` of a card ``NAME.json`` beside it if there is one; else by the actions' number:
        27 are ``"rmp"``, 6 are ``"tip"`` (write a card if they are ``"joint"``).

    Raises:
        PolicyFileError: If the file is missing, damaged or no model, or its actions fit no control mode.
    """
    card = card_path(path)
    if card.is_file():
        try:
            control = json.loads(card.read_bytes())["control"]
        except (ValueError, KeyError, TypeError) as error:
            raise PolicyFileError(f"{card.name} is no card: it must say {{'control': ...}}") from error
        require(
            control in CONTROLS,
            f"{card.name} has control = {control!r}: must be one of {list(CONTROLS)}",
            PolicyFileError,
        )
        return str(control)
    shape = _read_data(path).get("action_space", {}).get("_shape")
    size = shape[0] if isinstance(shape, list) and len(shape) == 1 else None
    if size not in _BY_SIZE:
        raise PolicyFileError(
            f"{path.name} has actions of shape {shape}: no control mode takes them (6: 'tip', 27: 'rmp')"
        )
    return _BY_SIZE[size]


def load(path: Path, *, trust_zip: bool = False) -> Sb3Policy:
    """Loads a model.

    Args:
        path: ``NAME.zip``.
        trust_zip: Lets Stable-Baselines3 load the file, which can run any code that is in it.

    Returns:
        The policy.

    Raises:
        PolicyFileError: If the file is missing, damaged, no model of PPO, A2C, SAC or TD3, or cannot be
            rebuilt without running what is in it.
    """
    control, data = control_in(path), _read_data(path)
    name = next((algorithm for key, algorithm in _TELLTALES.items() if key in data), None)
    if name is None:
        raise PolicyFileError(
            f"{path.name} is of none of {sorted(_TELLTALES.values())}: load it yourself and use its predict"
        )
    return Sb3Policy(_unpickled(path, name) if trust_zip else _rebuilt(path, name, data), control)


def _unpickled(path: Path, algorithm: str) -> Any:
    """The model as Stable-Baselines3 loads it."""
    import stable_baselines3 as sb3

    try:
        return getattr(sb3, algorithm).load(path, device="cpu", custom_objects=_UNUSED)
    except Exception as error:  # whatever a damaged pickle raises
        raise PolicyFileError(
            f"{path.name} is damaged: Stable-Baselines3 cannot load it ({error})"
        ) from error


def _rebuilt(path: Path, algorithm: str, data: dict[str, Any]) -> Any:
    """The policy, from the description's plain text and the parameters."""
    policy = _fresh(path, algorithm, data)
    tensors = _parameters(path)
    check_tensors(tensors, policy.state_dict(), path)
    policy.load_state_dict(tensors)
    policy.set_training_mode(False)
    return policy


def _fresh(path: Path, algorithm: str, data: dict[str, Any]) -> Any:
    """A policy of the kind that the description names."""
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    name, module = _MLP_POLICIES[algorithm]
    written = _texts(data, "policy_class")
    ours = written.get("__module__") == module and f" {name}.__init__ " in str(written.get("__init__"))
    _plain(ours, path, f"its policy is not {algorithm}'s MlpPolicy")
    observation, action = _texts(data, "observation_space"), _texts(data, "action_space")
    _plain(observation.get("_shape") == [FEATURES], path, f"it does not take the {FEATURES} features alone")
    ends = (action.get("low_repr"), action.get("high_repr"))
    _plain(ends == ("-1.0", "1.0"), path, f"its actions end at {ends}, not at -1 and 1")
    _plain(data.get("use_sde") is False, path, "it explores by gSDE")
    kinds = {"ActorCriticPolicy": ActorCriticPolicy, "SACPolicy": SACPolicy, "TD3Policy": TD3Policy}
    try:
        return kinds[name](
            spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32),
            spaces.Box(-1.0, 1.0, tuple(action["_shape"]), np.float32),
            lambda _: 0.0,  # a learning rate, which nothing uses here
            **_arguments(path, _texts(data, "policy_kwargs")),
        )
    except (TypeError, ValueError, AssertionError, RuntimeError, KeyError) as error:
        raise PolicyFileError(f"{path.name} describes a policy that cannot be built ({error})") from error


def _texts(data: dict[str, Any], name: str) -> dict[str, Any]:
    """An entry of the description, or nothing."""
    entry = data.get(name)
    return entry if isinstance(entry, dict) else {}


def _arguments(path: Path, written: dict[str, Any]) -> dict[str, Any]:
    """What a policy is built with."""
    arguments: dict[str, Any] = {}
    for name, value in written.items():
        if name in _NO_MATTER or name in (":type:", ":serialized:") or (name, value) == ("use_sde", False):
            continue
        if name == "activation_fn":
            found = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", str(value))
            known = found is not None and found[1] in _ACTIVATIONS
            _plain(known, path, f"its activation is {value}")
            arguments[name] = getattr(nn, found[1]) if found else None
            continue
        _plain(name in ("net_arch", "n_critics"), path, f"its policy_kwargs have {name!r}")
        arguments[name] = value
    return arguments


def _plain(holds: bool, path: Path, why: str) -> None:
    """Refuses what cannot be rebuilt."""
    require(
        holds,
        f"{path.name} cannot be loaded without running the code that may be in it: {why}. Train with "
        "`python -m agents.train_sb3`, which writes policy.safetensors; or, if you trust where the file "
        "comes from, load_policy(..., trust_zip=True)",
        PolicyFileError,
    )


def _parameters(path: Path) -> dict[str, Tensor]:
    """The tensors of a saved model; nothing but tensors is read."""
    version = tuple(int(part) for part in re.findall(r"\d+", torch.__version__)[:2])
    require(
        version >= _TORCH,
        f"torch {torch.__version__} cannot read {path.name} safely: install torch >= 2.6",
        PolicyFileError,
    )
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("policy.pth").file_size > _LONGEST_PARAMETERS:
                raise PolicyFileError(f"{path.name} is no model of ours: it has too many parameters")
            data = io.BytesIO(archive.read("policy.pth"))
        if not zipfile.is_zipfile(data):  # torch's present format; the old one is a row of bare pickles
            raise zipfile.BadZipFile("not torch's format")
        data.seek(0)
        tensors = torch.load(data, map_location="cpu", weights_only=True)
    except OSError as error:
        raise PolicyFileError(f"{path} cannot be read ({error.strerror})") from error
    except (
        zipfile.BadZipFile,
        KeyError,
        ValueError,
        EOFError,
        RuntimeError,
        pickle.UnpicklingError,
    ) as error:
        raise PolicyFileError(
            f"{path.name}: its parameters are damaged, or hold more than tensors"
        ) from error
    if not isinstance(tensors, dict) or not all(isinstance(t, Tensor) for t in tensors.values()):
        raise PolicyFileError(f"{path.name}: its parameters are no tensors by name")
    return dict(tensors)


def _read_data(path: Path) -> dict[str, Any]:
    """The JSON part of a saved model."""
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("data").file_size > _LONGEST_DATA:
                raise PolicyFileError(f"{path.name} is no model of ours: its data are too long")
            data = json.loads(archive.read("data"))
    except OSError as error:
        raise PolicyFileError(f"{path} cannot be read ({error.strerror})") from error
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise PolicyFileError(
            f"{path.name} is no model that Stable-Baselines3 saved, or a damaged one ({error})"
        ) from error
    if not isinstance(data, dict):
        raise PolicyFileError(f"{path.name} is no model that Stable-Baselines3 saved")
    return data
