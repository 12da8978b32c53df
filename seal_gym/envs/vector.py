"""``SealVectorEnv``: the face of the sealing core for ``gymnasium.make_vec``."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from seal_gym.core.errors import ConfigError, SealGymError, require
from seal_gym.core.frames import Array
from seal_gym.envs.adapters import LeafFunction
from seal_gym.envs.config import SealCfg, check_num_envs
from seal_gym.envs.core import Observation, SealCore, StepResult
from seal_gym.envs.journey import check_start
from seal_gym.envs.seal_env import SealEnv
from seal_gym.envs.viewing import SceneView, check_render_mode
from seal_gym.vision.features import RoiFeatures

# Gymnasium 1.0 has next-step autoreset but no name for it yet.
_NEXT_STEP = getattr(getattr(gym.vector, "AutoresetMode", None), "NEXT_STEP", "NextStep")
_MM = 1e3


def require_gymnasium_1(version: str = gym.__version__) -> None:
    """Refuses Gymnasium before 1.0, whose ``VectorEnv`` is another interface.

    Args:
        version: Of Gymnasium.

    Raises:
        SealGymError: If it is too old.
    """
    require(
        int(version.partition(".")[0]) >= 1,
        f"gymnasium {version}: the native vector environment needs gymnasium >= 1.0; on this version use "
        "seal_gym.envs.sb3.make_sb3_vec (Stable-Baselines3's VecEnv), which works on both",
        SealGymError,
    )


class SealVectorEnv(VectorEnv, EzPickle):
    """N sealing environments in one process, stepped together; needs Gymnasium >= 1.0.

    Spaces, reward, outcomes and info are ``SealEnv``'s, and row i follows, to the bit, the single environment
    with the same seed and actions.

    Autoreset is next-step: the step after an episode's end ignores that row's action, starts its next episode
    and returns its first observation with reward 0. ``reset(seed=s)`` seeds row i with s + i.

    Info: an array (or dictionary of arrays) per key of ``SealEnv``'s, each with the mask ``_key`` of the rows
    that have it, as Gymnasium's own vector environments give them; ``episode_metrics`` of the rows that ended
    in this step; and ``final_info`` with the whole info of those rows.
    """

    metadata = {  # noqa: RUF012  # as gymnasium.Env declares it
        **SealEnv.metadata,
        "autoreset_mode": _NEXT_STEP,
    }

    def __init__(self, num_envs: int = 1, *, render_mode: str | None = None, **kwargs: Any) -> None:
        """Builds the cells.

        Args:
            num_envs: Number of simulations.
            render_mode: As ``SealEnv``'s; shows row 0.
            **kwargs: Attributes of ``SealCfg``.

        Raises:
            ConfigError: If an argument is unknown or out of range.
            SealGymError: If Gymnasium is older than 1.0.
            SeamError: If this cell cannot seal the workpiece.
        """
        require_gymnasium_1()
        check_num_envs(num_envs)
        check_render_mode(render_mode, self.metadata["render_modes"])
        self._view: SceneView | None = None  # first of all: the base class closes what failed half-way
        EzPickle.__init__(self, num_envs=num_envs, render_mode=render_mode, **kwargs)
        self.num_envs, self.render_mode, self.closed = num_envs, render_mode, False
        self.core = SealCore(SealCfg.of(**kwargs), num_envs)
        self.single_action_space = self.core.action_space
        self.single_observation_space = self.core.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._ended = np.zeros(num_envs, np.bool_)
        self._running = np.zeros(num_envs, np.bool_)
        if render_mode:
            self._view = SceneView(self.core)

    # -- running ----------------------------------------------------------------------------------------

    def reset(  # type: ignore[override]  # gymnasium 1.x takes lists of seeds too
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed: Row i is seeded with seed + i, or with the list's entry i; rows without one go on with their
                generator.
            options: ``{"reset_mask": mask}`` resets the rows of a boolean array of shape (num_envs,) only;
                ``{"start": "home"}`` begins at the arm's posture of rest, see ``SealEnv``; episodes that
                start by themselves begin in the hover.

        Returns:
            Observations and info; info masks the rows that were reset.

        Raises:
            ConfigError: If a seed or an option does not fit.
        """
        rest = dict(options or {})
        rows = self._reset_mask(rest.pop("reset_mask", None))
        if unknown := sorted(set(rest) - {"start"}):
            raise ConfigError(f"unknown option {unknown}: reset takes ['reset_mask', 'start']")
        start = check_start(rest)
        seeds = self._seeds(seed)
        for i in np.flatnonzero(rows):
            if seeds[i] is not None:
                self._rngs[i], _ = seeding.np_random(seeds[i])
            self._restart(int(i), start)
        self._ended &= ~rows
        self._running |= rows
        observation = self.core.observe(None if rows.all() else rows)
        self._show()
        return observation, self._info(rows, None)

    def step(  # type: ignore[override]  # gymnasium 0.29 types its own vector environment
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Advances all rows by one camera frame; rows whose episode has ended start the next one.

        Args:
            actions: Shape (num_envs, n), see ``SealEnv``.

        Returns:
            Observations, rewards, terminated, truncated, info.

        Raises:
            ActionError: If an action has a wrong shape or is not finite.
            ResetNeeded: If a row was never reset.
        """
        if not self._running.all():
            raise gym.error.ResetNeeded("call reset() before step()")
        fresh = self._ended
        actions = np.asarray(actions)
        if fresh.any() and actions.shape == self.action_space.shape:
            actions = np.where(fresh[:, None], 0.0, actions)
        result = self.core.step(actions)
        if fresh.any():
            for i in np.flatnonzero(fresh):
                self._restart(int(i))
            result = StepResult(np.where(fresh, 0.0, result.reward), *(flag & ~fresh for flag in result[1:]))
        observation = self.core.observe()
        terminated, truncated = result.terminated, result.timeout
        self._ended = terminated | truncated
        self._show()
        return observation, result.reward, terminated, truncated, self._info(None, result)

    def _restart(self, i: int, start: str = "hover") -> None:
        rng = self._rngs[i]
        if rng is None:
            rng, _ = seeding.np_random()
            self._rngs[i] = rng
        self.core.reset(i, rng, start)

    # -- seeds and options ------------------------------------------------------------------------------

    def _seeds(self, seed: Any) -> list[int | None]:
        n = self.num_envs
        if seed is None:
            return [None] * n
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(n)]
        require(
            isinstance(seed, list | tuple)
            and all(s is None or isinstance(s, int | np.integer) for s in seed),
            f"seed = {seed!r}: must be a whole number or a list of them, one a row",
        )
        require(len(seed) == n, f"seed has {len(seed)} entries: must be one number or {n}, one a row")
        return [None if s is None else int(s) for s in seed]

    def _reset_mask(self, mask: Any) -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        require(
            isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,),
            f"reset_mask = {mask!r}: must be a boolean array of shape ({self.num_envs},)",
        )
        require(bool(mask.any()), "reset_mask chooses no row: at least one must be True")
        return np.array(mask, dtype=np.bool_)

    # -- info -------------------------------------------------------------------------------------------

    def _info(self, rows: NDArray[np.bool_] | None, result: StepResult | None) -> dict[str, Any]:
        """``SealCore.info`` of all rows, or of a reset's, at once; masked as gymnasium's ``_add_info``."""
        core, n = self.core, self.num_envs
        shown = np.ones(n, np.bool_) if rows is None else rows
        no = np.zeros(n, np.bool_)
        reached = no if result is None else result.reached
        values: dict[str, Any] = {
            "tip_error_mm": _MM * core.progress.error_m,
            "progress": core.progress.share,
            "collision": no.copy() if result is None else result.collision.copy(),
            "reached": reached.copy(),
            "is_success": reached.copy(),
            "renderer": np.full(n, core.cfg.renderer, dtype=object),
            "seam_velocity": core.seam_twist.copy(),
            "roi": _roi_arrays(core.features),
        }
        if core.snr_db is not None:
            values["snr_db"] = core.snr_db.copy()
        if core.cfg.disturbances:
            values["disturbances"] = _objects([core.recorded() for _ in range(n)])
        if core.obstacle is not None:
            o = core.obstacle
            values["obstacle"] = {
                "position_m": o.position,
                "velocity_m_s": o.velocity,
                "radius_m": np.full(n, o.radius),
            }
        if core.extrusion is not None:
            values["sealant"] = core.extrusion.infos()
        info = _masked(values, shown)
        journey = core.journey
        if (travelled := shown & journey.from_home).any():
            ways = {"under_way": journey.under_way.copy(), "hover_pose": journey.hover.copy()}
            info |= _masked(ways, travelled)
        if result is not None:
            for i in np.flatnonzero(self._ended):
                last = core.info(int(i), result)
                _add(info, {"episode_metrics": last["episode_metrics"], "final_info": last}, int(i), n)
        return info

    # -- the rest ---------------------------------------------------------------------------------------

    @property  # type: ignore[misc]  # gymnasium's has a setter
    def np_random(self) -> tuple[np.random.Generator | None, ...]:  # type: ignore[override]  # one a row
        """The rows' generators; None for a row that was never reset."""
        return tuple(self._rngs)

    def disturb(self, disturbance: object) -> None:
        """Adds a disturbance; a ``reset`` of all rows has to follow. What ``seal_gym.wrappers`` call.

        Args:
            disturbance: As ``SealCfg.disturbances`` takes them.

        Raises:
            ConfigError: If it is wrong, or there is one of its kind.
        """
        self.core = self.core.disturbed(disturbance)
        self._ezpickle_kwargs["disturbances"] = self.core.cfg.disturbances
        if self.spec is not None:
            self.spec = replace(self.spec, kwargs={**self.spec.kwargs, "disturbances": self.core.recorded()})
        self._running[:] = self._ended[:] = False
        if self._view is not None:
            self._view.close()
            self._view = SceneView(self.core)

    def add_leaf(self, leaf: LeafFunction) -> None:
        """Adds an RMP leaf to all rows at run time; needs ``control="rmp"``.

        Args:
            leaf: Gives a ``Leaf`` from an ``ArmState``.
        """
        self.core.add_leaf(leaf)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]  # gymnasium's RenderFrame
        """A picture of row 0, or nothing with the viewer.

        Returns:
            One picture of shape (720, 1280, 3) with ``render_mode="rgb_array"``.

        Raises:
            RenderError: If this machine cannot make pictures.
        """
        if self._view is None:
            gym.logger.warn('render() without render_mode: pass render_mode="rgb_array" to gym.make_vec')
            return None
        if self.render_mode == "human":
            self._view.sync()
            return None
        return (self._view.picture(),)

    def close_extras(self, **kwargs: Any) -> None:
        """Closes windows and contexts.

        Args:
            **kwargs: None are used.
        """
        del kwargs
        if self._view is not None:
            self._view.close()

    def _show(self) -> None:
        if self.render_mode == "human" and self._view is not None:
            self._view.sync()


def _objects(rows: list[Any]) -> NDArray[Any]:
    """One object a row, whatever numpy might make of it."""
    out = np.full(len(rows), None, dtype=object)
    for i, row in enumerate(rows):
        out[i] = row
    return out


def _roi_arrays(f: RoiFeatures) -> dict[str, NDArray[Any]]:
    """``seal_gym.envs.core.roi_info`` of all rows at once."""
    out: dict[str, NDArray[Any]] = {}
    for v, view in enumerate(("front", "side")):
        out[f"d_{view}_mm"] = _MM * f.d_m[:, v]
        out[f"theta_{view}_rad"] = f.theta_rad[:, v].copy()
        out[f"d_{view}_px"] = f.d_px[:, v].copy()
        out[f"theta_{view}_px_rad"] = f.theta_px_rad[:, v].copy()
        out[f"valid_{view}"] = f.valid[:, v].copy()
    return out


def _masked(values: dict[str, Any], rows: NDArray[np.bool_]) -> dict[str, Any]:
    """Adds the masks, and blanks the rows that have no value as gymnasium does."""
    everyone = bool(rows.all())
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out[key] = _masked(value, rows)
        elif not everyone:
            value[~rows] = None if value.dtype == object else 0
            out[key] = value
        else:
            out[key] = value
        out[f"_{key}"] = rows.copy()
    return out


def _add(out: dict[str, Any], row: dict[str, Any], i: int, n: int) -> None:
    """Adds one row's info, as ``gymnasium.vector.VectorEnv._add_info`` does since 1.0."""
    for key, value in row.items():
        if isinstance(value, dict):
            _add(out.setdefault(key, {}), value, i, n)
        else:
            if key not in out:
                value_type = np.asarray(value)
                plain = value_type.dtype.kind in "bif"
                out[key] = (
                    np.zeros((n, *value_type.shape), value_type.dtype) if plain else np.full(n, None, object)
                )
            out[key][i] = value
        out.setdefault(f"_{key}", np.zeros(n, np.bool_))[i] = True
