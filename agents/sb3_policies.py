"""Policies that Stable-Baselines3 trains: networks with fixed input scales, stored without pickle.

A stored policy is two files, ``NAME.safetensors`` (the parameters) and ``NAME.json`` (the card: how to build
the network, what it was trained on, its scores). Reading them executes nothing.
"""

import copy
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.sac.policies import SACPolicy
from torch import Tensor, nn

from agents.policies import PolicyFileError, card_path, check_tensors, write_whole
from seal_gym.core.cell import load_cell
from seal_gym.core.errors import ConfigError, require
from seal_gym.envs.adapters import RmpAdapter, TipAdapter

ALGORITHMS = ("ppo", "sac")
FORMAT = "seal_gym sb3 policy 1"
ACTION_SIZE = {"tip": TipAdapter.size, "rmp": RmpAdapter.size}
OBSERVATION_SIZE = 35
# What counts as one, for each observation row of ``SealEnv`` up to the commanded acceleration: values of a
# run that goes well. Fixed, so that a policy is whole without running statistics. The joints' angles and
# speeds are left out: seen from the tip they add nothing the seam asks for.
SCALES = np.array(
    [3.0, 5.0, 1.0, 3.0, 5.0, 1.0]  # mm, deg and validity, front and side
    + [10.0, 10.0, 10.0, 10.0]  # the seam's velocity and turning, mm/s and deg/s
    + [5.0]  # lean, deg
    + [10.0] * 6  # the tip's twist, mm/s and deg/s
    + [0.3] * 3  # commanded acceleration, m/s^2
    + [5.0] * 3,  # rad/s^2
    dtype=np.float32,
)
_CLIP = 10.0
_FIRST_SPREAD = 0.1  # of the last layer's weights: the first policy is nearly the zero action


@dataclass(frozen=True, kw_only=True)
class NetCfg:
    """The network of a policy.

    Attributes:
        algo: ``"ppo"`` or ``"sac"``.
        control: ``"tip"`` or ``"rmp"``.
        hidden: Units of each hidden layer, of actor and critic.
        log_std: Logarithm of the exploration's standard deviation at the start. Small: an action of 1 is
            1 m/s^2, the start is 7 mm above the part and contact ends the episode.
        metric: Diagonal of the Cholesky factor at the start, as an action, for ``"rmp"``: with 0 the leaf
            has no say, and no direction to learn in.
    """

    algo: str = "ppo"
    control: str = "tip"
    hidden: tuple[int, ...] = (64, 64)
    log_std: float = -3.0
    metric: float = 0.3

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(self.algo in ALGORITHMS, f"algo = {self.algo!r}: must be one of {list(ALGORITHMS)}")
        require(
            self.control in ACTION_SIZE, f"control = {self.control!r}: must be one of {list(ACTION_SIZE)}"
        )
        require(
            bool(self.hidden) and all(1 <= n <= 4096 for n in self.hidden),
            f"hidden = {self.hidden!r}: must be whole numbers in 1..4096",
        )
        require(-20.0 <= self.log_std <= 2.0, f"log_std = {self.log_std!r}: must be in -20..2")
        require(-1.0 <= self.metric <= 1.0, f"metric = {self.metric!r}: must be in -1..1, as an action")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Builds it from a card.

        Args:
            values: The attributes.

        Returns:
            The configuration.

        Raises:
            ConfigError: If names or values are wrong.
        """
        try:
            return cls(**{**values, "hidden": tuple(values["hidden"])})
        except (KeyError, TypeError) as error:
            raise ConfigError(f"net = {dict(values)!r}: no description of a network ({error})") from error


def observation_space() -> spaces.Box:
    """What the policies take: ``SealEnv``'s features.

    Returns:
        Unbounded: the environment's own bounds only matter to it.
    """
    return spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)


def action_space(control: str) -> spaces.Box:
    """What the policies give.

    Args:
        control: ``"tip"`` or ``"rmp"``.

    Returns:
        As ``SealEnv``'s.
    """
    return spaces.Box(-1.0, 1.0, (ACTION_SIZE[control],), np.float32)


def first_action(cfg: NetCfg) -> NDArray[np.float32]:
    """The action around which exploration starts: zero, and a round metric with ``"rmp"``.

    Args:
        cfg: Of the network.

    Returns:
        Shape (6,) or (27,).
    """
    action = np.zeros(ACTION_SIZE[cfg.control], np.float32)
    if cfg.control == "rmp":
        rows, columns = np.tril_indices(6)
        action[6:][rows == columns] = cfg.metric
    return action


def _relative() -> tuple[Tensor, Tensor]:
    """What makes the tip's motion that against the seam at nominal speed: x @ matrix - offset."""
    matrix, offset = torch.eye(len(SCALES)), torch.zeros(len(SCALES))
    for seam, tip in ((6, 11), (7, 13), (8, 14), (9, 16)):
        matrix[seam, tip] = -1.0
    offset[12] = 1e3 * load_cell().process.speed_m_s
    return matrix, offset


class Scale(nn.Module):
    """The first 23 observation rows in natural units, clipped to +-10.

    The tip's velocities are taken against the seam's own and, along y, against the nominal speed: zero is
    where the gun should be.
    """

    matrix: Tensor
    offset: Tensor

    def __init__(self) -> None:
        super().__init__()
        matrix, offset = _relative()
        scales = torch.from_numpy(SCALES)
        self.register_buffer("matrix", matrix / scales, persistent=False)
        self.register_buffer("offset", offset / scales, persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Scales.

        Args:
            observation: Shape (B, 35).

        Returns:
            Shape (B, 23).
        """
        return (observation[:, : len(SCALES)] @ self.matrix - self.offset).clamp(-_CLIP, _CLIP)


class ScaledFeatures(BaseFeaturesExtractor):
    """``Scale`` as a features extractor."""

    def __init__(self, space: spaces.Box) -> None:
        super().__init__(space, len(SCALES))
        self.scale = Scale()

    def forward(self, observation: Tensor) -> Tensor:
        """See ``Scale.forward``."""
        scaled: Tensor = self.scale(observation)
        return scaled


def _tower(sizes: tuple[int, ...]) -> list[nn.Module]:
    layers: list[nn.Module] = [Scale()]
    for before, after in zip((len(SCALES), *sizes), sizes, strict=False):
        layers += [nn.Linear(before, after), nn.Tanh()]
    return layers


def mlp_actor(cfg: NetCfg) -> nn.Module:
    """The mean of the action from the observation, nearly constant at the start.

    Args:
        cfg: Of the network.

    Returns:
        Takes (B, 35), gives (B, n).
    """
    first = torch.from_numpy(first_action(cfg))
    last = nn.Linear(cfg.hidden[-1], len(first))
    with torch.no_grad():
        nn.init.orthogonal_(last.weight, 0.01 * _FIRST_SPREAD)
        last.bias.copy_(first)
    actor = nn.Sequential(*_tower(cfg.hidden), last)
    for layer in list(actor)[:-1]:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, 2.0**0.5)
            nn.init.zeros_(layer.bias)
    return actor


class _Towers(nn.Module):
    """Actor and critic apart, in the place of SB3's ``MlpExtractor``."""

    def __init__(self, actor: nn.Module, critic: nn.Module, actions: int, hidden: int) -> None:
        super().__init__()
        self.actor, self.critic = actor, critic
        self.latent_dim_pi, self.latent_dim_vf = actions, hidden

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Both."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        """The mean action."""
        mean: Tensor = self.actor(features)
        return mean

    def forward_critic(self, features: Tensor) -> Tensor:
        """What the value is read from."""
        latent: Tensor = self.critic(features)
        return latent


class GaussianActorCritic(ActorCriticPolicy):
    """PPO's policy with any module as the mean of its Gaussian: a trained network can take that place.

    Attributes:
        actor: The module: observations (B, 35) to mean actions (B, n).
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Callable[[float], float],
        net: NetCfg | None = None,
        **kwargs: Any,
    ) -> None:
        self._net = net or NetCfg()
        kwargs = {**kwargs, "features_extractor_class": FlattenExtractor, "ortho_init": False}
        super().__init__(
            observation_space, action_space, lr_schedule, log_std_init=self._net.log_std, **kwargs
        )

    @property
    def actor(self) -> nn.Module:
        """The mean of the action."""
        module = self.mlp_extractor.actor
        assert isinstance(module, nn.Module)
        return module

    def set_actor(self, module: nn.Module) -> None:
        """Replaces the mean of the action; the optimiser starts anew.

        Args:
            module: Takes observations (B, 35), gives mean actions (B, n).
        """
        self.mlp_extractor.actor = module
        self._new_optimizer()

    def _build_mlp_extractor(self) -> None:
        hidden = self._net.hidden
        critic = nn.Sequential(*_tower(hidden))
        for layer in critic:
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, 2.0**0.5)
                nn.init.zeros_(layer.bias)
        actions = ACTION_SIZE[self._net.control]
        towers = _Towers(mlp_actor(self._net), critic, actions, hidden[-1])
        self.mlp_extractor = towers  # type: ignore[assignment]  # it has all that SB3 uses of an MlpExtractor

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()  # the actor gives the action itself
        self._new_optimizer()

    def _new_optimizer(self) -> None:
        rate = self.optimizer.param_groups[0]["lr"]
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=rate, **self.optimizer_kwargs)


def _sac_kwargs(cfg: NetCfg) -> dict[str, Any]:
    return {"features_extractor_class": ScaledFeatures, "net_arch": list(cfg.hidden)}


def policy_of(cfg: NetCfg) -> tuple[type[BasePolicy], dict[str, Any]]:
    """Class and arguments of a policy, as SB3's algorithms take them.

    Args:
        cfg: Of the network.

    Returns:
        ``policy`` and ``policy_kwargs``.
    """
    if cfg.algo == "ppo":
        return GaussianActorCritic, {"net": cfg}
    return SACPolicy, _sac_kwargs(cfg)


def build(cfg: NetCfg) -> BasePolicy:
    """A policy outside any algorithm.

    Args:
        cfg: Of the network.

    Returns:
        With fresh parameters.
    """
    kind, kwargs = policy_of(cfg)
    # SB3's policies take a learning rate, which nothing uses here.
    policy: BasePolicy = kind(observation_space(), action_space(cfg.control), lambda _: 0.0, **kwargs)
    return policy


def start_from_rest(policy: SACPolicy, cfg: NetCfg) -> None:
    """Makes a fresh SAC policy act like ``first_action`` with a small spread, whatever it sees.

    Args:
        policy: Changed in place.
        cfg: Of the network.
    """
    mean, spread = policy.actor.mu, policy.actor.log_std
    assert isinstance(mean, nn.Linear) and isinstance(spread, nn.Linear)
    with torch.no_grad():
        mean.weight.mul_(_FIRST_SPREAD)
        mean.bias.copy_(torch.from_numpy(np.arctanh(first_action(cfg))))
        spread.weight.zero_()
        spread.bias.fill_(cfg.log_std)


def put_actor(policy: GaussianActorCritic, module: nn.Module) -> None:
    """Makes a copy of a module, weights and all, the mean of a PPO policy: a behaviour-cloned one, say.

    Critic and spread stay as they are; the optimiser starts anew.

    Args:
        policy: Changed in place.
        module: Takes observations (B, 35), gives actions (B, n).

    Raises:
        ConfigError: If the module takes or gives something else; the policy is then as it was.
    """
    probe = torch.zeros(2, OBSERVATION_SIZE)
    wanted = (2, *(policy.action_space.shape or ()))
    try:
        with torch.no_grad():
            shape = tuple(module(probe).shape)
    except RuntimeError as error:
        raise ConfigError(
            f"the module does not take observations of {OBSERVATION_SIZE} features ({error})"
        ) from error
    require(shape == wanted, f"the module gives {shape} for two observations: must be {wanted}")
    policy.set_actor(copy.deepcopy(module))


class Sb3Policy:
    """A trained SB3 policy as an evaluator wants it.

    Attributes:
        control: The ``control`` its environment needs.
        card: What is known about it.
    """

    def __init__(self, policy: BasePolicy, control: str, card: dict[str, Any] | None = None) -> None:
        self.control, self.card = control, card or {}
        self._policy = policy

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Actions for observations of one environment or of N; with images, only the features count."""
        takes_dict = isinstance(self._policy.observation_space, spaces.Dict)
        if isinstance(observation, dict) and not takes_dict:
            observation = observation["features"]
        action, state = self._policy.predict(observation, state, episode_start, deterministic)
        return np.asarray(action, dtype=np.float32), state


# -- files -------------------------------------------------------------------------------------------------


def save(policy: BasePolicy, cfg: NetCfg, path: Path, card: Mapping[str, Any]) -> None:
    """Writes a policy's parameters and card.

    Args:
        policy: From ``build`` or an algorithm with ``policy_of``.
        cfg: Its network.
        path: ``NAME.safetensors``; the card goes beside it as ``NAME.json``.
        card: What else to say about it, ready for JSON.
    """
    tensors = {name: values.detach().contiguous().clone() for name, values in policy.state_dict().items()}
    write_whole(path, save_tensors(tensors))
    text = json.dumps({"format": FORMAT, "net": asdict(cfg), **card}, indent=1)
    write_whole(card_path(path), (text + "\n").encode())


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Reads a safetensors file.

    Args:
        path: The file.

    Returns:
        Tensors by name.

    Raises:
        PolicyFileError: If there is none, or it is broken or of another kind.
    """
    try:
        tensors: dict[str, Tensor] = load_tensors(path.read_bytes())
    except OSError as error:
        raise PolicyFileError(f"{path} cannot be read ({error.strerror})") from error
    except (SafetensorError, KeyError, ValueError) as error:
        raise PolicyFileError(f"{path.name} is no safetensors file, or a damaged one: {error}") from error
    return tensors


def is_ours(path: Path) -> bool:
    """Whether the card beside weights is one of this module's.

    Args:
        path: ``NAME.safetensors``.

    Returns:
        False as well if there is no card, or none that can be read.
    """
    try:
        card = json.loads(card_path(path).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(card, dict) and card.get("format") == FORMAT


def read_card(path: Path) -> dict[str, Any]:
    """A policy's card.

    Args:
        path: ``NAME.safetensors``.

    Returns:
        What ``NAME.json`` says.

    Raises:
        PolicyFileError: If there is none, or it is not one of ours.
    """
    file = card_path(path)
    if not is_ours(path):
        raise PolicyFileError(
            f"{file.name} beside {path.name} is missing, or no card of a policy of python -m agents.train_sb3"
        )
    card = json.loads(file.read_bytes())
    assert isinstance(card, dict)
    return card


def load(path: Path) -> Sb3Policy:
    """Reads a policy; nothing in the files is executed.

    Args:
        path: ``NAME.safetensors``, with ``NAME.json`` beside it.

    Returns:
        The policy.

    Raises:
        PolicyFileError: If a file is missing, damaged, or the two do not belong together.
    """
    card = read_card(path)
    try:
        cfg = NetCfg.of(card.get("net", {}))
    except ConfigError as error:
        raise PolicyFileError(f"{card_path(path).name}: {error}") from error
    tensors = read_tensors(path)
    policy = build(cfg)
    check_tensors(tensors, policy.state_dict(), path)
    policy.load_state_dict(tensors)
    policy.set_training_mode(False)
    return Sb3Policy(policy, cfg.control, card)
