"""``SealSb3VecEnv``: the face of the sealing core for Stable-Baselines3, on every Gymnasium it supports."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

import seal_gym
from seal_gym.core.errors import ConfigError
from seal_gym.envs.adapters import LeafFunction
from seal_gym.envs.config import SealCfg, check_num_envs
from seal_gym.envs.core import Observation, SealCore
from seal_gym.envs.journey import check_start
from seal_gym.envs.seal_env import SealEnv
from seal_gym.envs.viewing import SceneView, check_render_mode

_SINGLE = f"{SealEnv.__module__}:{SealEnv.__qualname__}"


class SealSb3VecEnv(VecEnv):
    """N sealing environments in one process as a Stable-Baselines3 ``VecEnv``.

    Row i follows, to the bit, the single environment with the same seed and actions. A row whose episode ends
    is reset in the same step, its info holds ``terminal_observation`` and ``TimeLimit.truncated``, and
    ``episode`` ({"r", "l", "t"}), so that no ``Monitor`` is needed around it, besides all of ``SealEnv``'s.
    """

    def __init__(self, num_envs: int = 1, *, render_mode: str | None = None, **kwargs: Any) -> None:
        """Builds the cells.

        Args:
            num_envs: Number of simulations.
            render_mode: As ``SealEnv``'s; shows row 0.
            **kwargs: Attributes of ``SealCfg``.

        Raises:
            ConfigError: If an argument is unknown or out of range.
            SeamError: If this cell cannot seal the workpiece.
        """
        check_num_envs(num_envs)
        check_render_mode(render_mode, SealEnv.metadata["render_modes"])
        self.core = SealCore(SealCfg.of(**kwargs), num_envs)
        self.render_mode = render_mode
        self._attributes: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._actions: NDArray[Any] = np.zeros((num_envs, *self.core.action_space.shape))
        self._returns = np.zeros(num_envs)
        self._running = False
        self._born_s = time.time()
        self._view = SceneView(self.core) if render_mode else None
        super().__init__(num_envs, self.core.observation_space, self.core.action_space)

    # -- running ----------------------------------------------------------------------------------------

    def reset(self) -> VecEnvObs:
        """Starts an episode in every row, with the seeds given to ``seed`` and the ``set_options``.

        ``{"start": "home"}`` begins at the arm's posture of rest, see ``SealEnv``.

        Returns:
            Observations.

        Raises:
            ConfigError: If an option is unknown.
        """
        starts = [check_start(options) for options in self._options]
        for i, seed in enumerate(self._seeds):
            if seed is not None:
                self._rngs[i], _ = seeding.np_random(seed)
            self._restart(i, starts[i])
        self._reset_seeds()
        self._reset_options()
        self._running = True
        observation = self.core.observe()
        self.reset_infos = [self.core.info(i, None) for i in range(self.num_envs)]
        self._show()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keeps the actions for ``step_wait``.

        Args:
            actions: Shape (num_envs, n), see ``SealEnv``.
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Advances all rows by one camera frame and resets those whose episode has ended.

        Returns:
            Observations, rewards, dones, infos.

        Raises:
            ActionError: If an action has a wrong shape or is not finite.
            ResetNeeded: If called before ``reset``.
        """
        if not self._running:
            raise gym.error.ResetNeeded("call reset() before step()")
        core = self.core
        result = core.step(np.asarray(self._actions))
        observation = core.observe()
        self._returns += result.reward
        infos = [core.info(i, result) for i in range(self.num_envs)]
        for info, truncated in zip(infos, result.timeout.tolist(), strict=True):
            info["TimeLimit.truncated"] = truncated
        dones = result.terminated | result.timeout
        if dones.any():
            observation = self._next_episodes(dones, observation, infos)
        self._show()
        return observation, result.reward.astype(np.float32), dones, infos

    def _next_episodes(
        self, dones: NDArray[np.bool_], observation: Observation, infos: list[dict[str, Any]]
    ) -> Observation:
        """Closes the books of the ended rows, resets them and lets them, and only them, look again."""
        for i in map(int, np.flatnonzero(dones)):
            infos[i]["terminal_observation"] = _row(observation, i)
            infos[i]["episode"] = {
                "r": round(float(self._returns[i]), 6),
                "l": int(self.core.frames[i]),
                "t": round(time.time() - self._born_s, 6),
            }
            self._restart(i)
        observation = self.core.observe(dones)
        for i in map(int, np.flatnonzero(dones)):
            self.reset_infos[i] = self.core.info(i, None)
        return observation

    def _restart(self, i: int, start: str = "hover") -> None:
        rng = self._rngs[i]
        if rng is None:
            rng, _ = seeding.np_random()
            self._rngs[i] = rng
        self._returns[i] = 0.0
        self.core.reset(i, rng, start)

    # -- pictures ---------------------------------------------------------------------------------------

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """A picture of row 0.

        Returns:
            One picture of shape (720, 1280, 3); one None without ``render_mode="rgb_array"``.

        Raises:
            RenderError: If this machine cannot make pictures.
        """
        if self._view is None or self.render_mode != "rgb_array":
            return [None]
        return [self._view.picture()]

    def close(self) -> None:
        """Closes windows and contexts; safe to call twice."""
        if self._view is not None:
            self._view.close()

    def _show(self) -> None:
        if self.render_mode == "human" and self._view is not None:
            self._view.sync()

    def disturb(self, disturbance: object) -> None:
        """Adds a disturbance to all rows; a ``reset`` has to follow. What ``seal_gym.wrappers`` call.

        Args:
            disturbance: As ``SealCfg.disturbances`` takes them.

        Raises:
            ConfigError: If it is wrong, or there is one of its kind.
        """
        self.core = self.core.disturbed(disturbance)
        self._running = False
        if self._view is not None:
            self._view.close()
            self._view = SceneView(self.core)

    # -- what Stable-Baselines3 asks of the rows --------------------------------------------------------

    def add_leaf(self, leaf: LeafFunction) -> None:
        """Adds an RMP leaf to all rows at run time; needs ``control="rmp"``.

        Args:
            leaf: Gives a ``Leaf`` from an ``ArmState``.
        """
        self.core.add_leaf(leaf)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each row.

        Args:
            attr_name: One set with ``set_attr``, ``np_random``, or any of the environment's.
            indices: Rows, all by default.

        Returns:
            One value a row.

        Raises:
            AttributeError: If there is none of that name.
        """
        return [self._attribute(attr_name, i) for i in self._rows(indices)]

    def _attribute(self, name: str, i: int) -> Any:
        if name in self._attributes[i]:
            return self._attributes[i][name]
        if name == "np_random":
            return self._rngs[i]
        if name == "metadata":
            return SealEnv.metadata
        # Chosen ones: `num_envs` or `reset` of the vector are not a row's.
        if name in ("action_space", "core", "observation_space", "render_mode"):
            return getattr(self, name)
        raise AttributeError(
            f"no attribute {name!r}: the rows have action_space, core, metadata, np_random, "
            f"observation_space, render_mode and what set_attr gave them {sorted(self._attributes[i])}"
        )

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Attaches a value to rows, for ``get_attr`` to give back; it changes nothing in the simulation.

        Args:
            attr_name: Name.
            value: Value.
            indices: Rows, all by default.
        """
        for i in self._rows(indices):
            self._attributes[i][attr_name] = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method on rows.

        Args:
            method_name: ``"add_leaf"`` (always on all rows), ``"render"`` (shows row 0) or ``"seconds"``.
            *method_args: Of the method.
            indices: Rows, all by default.
            **method_kwargs: Of the method.

        Returns:
            One value a row.

        Raises:
            AttributeError: If there is none of that name.
        """
        rows = self._rows(indices)
        if method_name == "seconds":
            return [self.core.seconds(i) for i in rows]
        once: dict[str, Callable[..., Any]] = {"add_leaf": self.add_leaf, "render": self._picture}
        if method_name not in once:
            raise AttributeError(f"no method {method_name!r}: the rows have {['seconds', *once]}")
        return [once[method_name](*method_args, **method_kwargs)] * len(rows)

    def _picture(self) -> NDArray[np.uint8] | None:
        self._show()
        return self.get_images()[0]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:  # type: ignore[type-arg]  # as the base class
        """Whether rows are wrapped: never, but they do what ``Monitor`` does.

        Args:
            wrapper_class: The wrapper.
            indices: Rows, all by default.

        Returns:
            True for ``Monitor``: ``evaluate_policy`` may use the returns and lengths in ``episode``.
        """
        return [issubclass(wrapper_class, Monitor)] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        return [int(i) for i in self._get_indices(indices)]


def _row(observation: Observation, i: int) -> Any:
    if isinstance(observation, dict):
        return {name: rows[i].copy() for name, rows in observation.items()}
    return observation[i].copy()


def make_sb3_vec(env_id: str, n: int = 1, **kwargs: Any) -> SealSb3VecEnv:
    """``gym.make`` for N environments with Stable-Baselines3's interface.

    Args:
        env_id: A sealing id, such as ``"SealGym/Flat-v0"``.
        n: Number of environments.
        **kwargs: Keyword arguments of the environment.

    Returns:
        The environments.

    Raises:
        ConfigError: If there is no such id or an argument is unknown or out of range.
    """
    spec = gym.registry.get(env_id.removeprefix("seal_gym:"))
    if spec is None or spec.entry_point != _SINGLE:
        raise ConfigError(f"env_id = {env_id!r}: must be one of {list(seal_gym.ENV_IDS)}")
    return SealSb3VecEnv(n, **{**spec.kwargs, **kwargs})
