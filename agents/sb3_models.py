"""Models that Stable-Baselines3 saved, as policies.

Their files hold pickles, which run code as they are loaded: load only models that you trust. What stands
here about a file before it is loaded is read without executing anything.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policies import PolicyFileError, card_path
from seal_gym.core.errors import require
from seal_gym.envs.adapters import CONTROLS

_BY_SIZE = {6: "tip", 27: "rmp"}
# Entries of a saved model that only this algorithm has, first match wins.
_TELLTALES = {"clip_range": "PPO", "target_entropy": "SAC", "policy_delay": "TD3", "n_steps": "A2C"}
_LONGEST_DATA = 64 * 2**20
# Schedules are pickled functions, which need not load on another Python and which only training needs.
_UNUSED = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.0, "clip_range_vf": None}


class Sb3Policy:
    """A model of Stable-Baselines3 that knows its control mode.

    Attributes:
        model: The model.
        control: The ``control`` its environment needs.
    """

    def __init__(self, model: Any, control: str) -> None:
        """Takes the model.

        Args:
            model: The model.
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


def load(path: Path) -> Sb3Policy:
    """Loads a model; its file can run code.

    Args:
        path: ``NAME.zip``.

    Returns:
        The policy.

    Raises:
        PolicyFileError: If the file is missing, damaged or no model of PPO, A2C, SAC or TD3.
    """
    import stable_baselines3 as sb3

    control, data = control_in(path), _read_data(path)
    name = next((algorithm for key, algorithm in _TELLTALES.items() if key in data), None)
    if name is None:
        raise PolicyFileError(
            f"{path.name} is of none of {sorted(_TELLTALES.values())}: load it yourself and use its predict"
        )
    try:
        model = getattr(sb3, name).load(path, device="cpu", custom_objects=_UNUSED)
    except Exception as error:  # whatever a damaged pickle raises
        raise PolicyFileError(
            f"{path.name} is damaged: Stable-Baselines3 cannot load it ({error})"
        ) from error
    return Sb3Policy(model, control)


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
