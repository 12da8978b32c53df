"""Trains a sealing policy with Stable-Baselines3's PPO or SAC.

    python -m agents.train_sb3 --algo ppo --env SealGym/Flat-v0 --control tip --out out/ppo_flat

Training goes in rounds: each one seeds everything anew, resets the environments, learns, evaluates on
validation seeds and writes a checkpoint. Killed at any moment and started again, it loses at most one round
and ends with the same policy. The folder then holds ``policy.safetensors`` + ``policy.json`` (the best
policy, by ``better``), ``evaluations.jsonl``, ``run.json``, ``checkpoint.safetensors``, ``tensorboard/``
and, if asked for, ``videos/``.
"""

from agents import backend

_GL = backend.choose()

import argparse  # the backend has to be chosen before mujoco is imported
import contextlib
import json
import shlex
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from stable_baselines3.sac.policies import SACPolicy
from torch import Tensor
from tqdm import tqdm

import seal_gym
from agents import policies, sb3_policies
from agents.episodes import FIRST_VALIDATION_SEED
from agents.policies import LearnedPolicy, PolicyFileError, write_whole
from agents.rollouts import play
from agents.sb3_policies import (
    ALGORITHMS,
    GaussianActorCritic,
    NetCfg,
    Sb3Policy,
    put_actor,
    read_tensors,
)
from seal_gym.core.errors import RenderError, SealGymError, require
from seal_gym.core.provenance import versions
from seal_gym.envs.config import PERCEPTIONS
from seal_gym.envs.sb3 import make_sb3_vec
from seal_gym.tasks.progress import SealTaskCfg
from seal_gym.tasks.reward import RewardCfg

_STACK = ("stable-baselines3", "gymnasium", "torch", "numpy", "mujoco")
_LOG_STD_FINE = -3.5  # spread around a policy that can seal already


@dataclass(frozen=True, kw_only=True)
class PpoCfg:
    """PPO's tuned values.

    Attributes:
        n_envs: Environments stepped together.
        rollout: Steps of all environments together between two updates.
        batch_size: Of a gradient step.
        n_epochs: Passes over a rollout.
        learning_rate: At the start; falls linearly to a tenth.
        gamma: Discount a frame: 0.98 looks 1.7 s ahead, twice as far as the gun needs to settle.
        gae_lambda: Of the advantages.
    """

    n_envs: int = 64
    rollout: int = 8192
    batch_size: int = 1024
    n_epochs: int = 8
    learning_rate: float = 5e-4
    gamma: float = 0.98
    gae_lambda: float = 0.95


@dataclass(frozen=True, kw_only=True)
class SacCfg:
    """SAC's tuned values.

    Attributes:
        n_envs: Environments stepped together.
        buffer_size: Transitions kept.
        batch_size: Of a gradient step.
        gradient_steps: After each step of all environments.
        learning_rate: At the start; falls linearly to a tenth.
        gamma: Discount a frame.
        target_entropy: A dimension of the action [nat]: -2.5 is a spread of about 0.02.
        learning_starts: Steps before the first gradient step, with the first policy and not with SB3's
            uniform actions, which would only show collisions.
    """

    n_envs: int = 16
    buffer_size: int = 300_000
    batch_size: int = 256
    gradient_steps: int = 4
    learning_rate: float = 5e-4
    gamma: float = 0.98
    target_entropy: float = -2.5
    learning_starts: int = 2_000


@dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """Everything that decides a training run; the same values on the same stack give the same policy.

    Attributes:
        env: Id of the environment.
        perception: ``"oracle"`` or ``"vision"``.
        steps: Frames of experience, of all environments together; rounded up to whole rounds.
        seed: Of the run.
        round_steps: Frames between two evaluations.
        episodes: Of an evaluation, with seeds from 500000 on.
        time_factor: Time limit of training episodes, as a share of the nominal time: short ones show the
            approach more often; what comes after the limit is bootstrapped. Evaluations use the task's own.
        reward_scale: Factor on the reward: values of about one.
        error_m: Tip error that halves the reward's tracking quality in training [m]. Wider than the
            task's: it is felt from the start of the approach.
        net: The network.
        ppo: Used with ``net.algo = "ppo"``.
        sac: Used with ``net.algo = "sac"``.
        init: Weights of a behaviour-cloned policy to start from.
    """

    env: str = "SealGym/Flat-v0"
    perception: str = "oracle"
    steps: int = 393_216
    seed: int = 0
    round_steps: int = 49_152
    episodes: int = 20
    time_factor: float = 0.4
    reward_scale: float = 0.1
    error_m: float = 3e-3
    net: NetCfg = field(default_factory=NetCfg)
    ppo: PpoCfg = field(default_factory=PpoCfg)
    sac: SacCfg = field(default_factory=SacCfg)
    init: str | None = None

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(self.env in seal_gym.ENV_IDS, f"env = {self.env!r}: must be one of {list(seal_gym.ENV_IDS)}")
        require(
            self.perception in PERCEPTIONS,
            f"perception = {self.perception!r}: must be one of {list(PERCEPTIONS)}",
        )
        for name, least in (("steps", 1), ("seed", 0), ("round_steps", 1), ("episodes", 1)):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= least,
                f"{name} = {value!r}: must be a whole number >= {least}",
            )
        require(
            self.seed < FIRST_VALIDATION_SEED,
            f"seed = {self.seed}: from {FIRST_VALIDATION_SEED} on seeds are for validation and tables",
        )
        require(
            1 <= self.n_envs <= self.ppo.rollout and self.ppo.rollout % self.ppo.n_envs == 0,
            f"n_envs = {self.ppo.n_envs}: must divide the rollout of {self.ppo.rollout} steps",
        )
        require(
            self.init is None or self.net.algo == "ppo",
            "init with algo = 'sac': a fresh critic would lead SAC astray at once; use --algo ppo",
        )

    @property
    def n_envs(self) -> int:
        """Environments stepped together."""
        return self.ppo.n_envs if self.net.algo == "ppo" else self.sac.n_envs

    def comparable(self) -> dict[str, Any]:
        """The run's description, ready for JSON.

        Returns:
            Its attributes; of the algorithms only the one in use.
        """
        values = asdict(self)
        del values["sac" if self.net.algo == "ppo" else "ppo"]
        plain = json.loads(json.dumps(values))
        assert isinstance(plain, dict)
        return plain


# -- evaluation -----------------------------------------------------------------------------------------


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates and means over episodes.

    Args:
        rows: From ``play``.

    Returns:
        Rates [%], ``rmse_mm`` and ``time_s`` over those that reached (None if none did), the others over all.
    """
    reached = [row for row in rows if row["reached"]]

    def mean(name: str, chosen: list[dict[str, Any]]) -> float | None:
        values = [row[name] for row in chosen if row[name] is not None]
        return float(np.mean(values)) if values else None

    return {
        "episodes": len(rows),
        **{
            f"{name}_pct": 100.0 * sum(bool(row[name]) for row in rows) / len(rows)
            for name in ("reached", "collision", "timeout")
        },
        "rmse_mm": mean("rmse_mm", reached),
        "rmse_whole_mm": mean("rmse_whole_mm", rows),
        "coverage_pct": mean("coverage_pct", rows),
        "time_s": mean("time_s", reached),
        "return": mean("return", rows),
    }


def better(a: dict[str, Any], b: dict[str, Any] | None) -> bool:
    """The rule by which the kept policy is chosen: reached share, then RMSE, then return.

    Args:
        a: An evaluation.
        b: The best one so far, or none.

    Returns:
        Whether ``a`` beats it.
    """

    def key(row: dict[str, Any]) -> tuple[float, float, float]:
        rmse = row["rmse_mm"]
        return row["reached_pct"], -np.inf if rmse is None else -rmse, row["return"]

    return b is None or key(a) > key(b)


# -- the algorithms -------------------------------------------------------------------------------------


class ScaledReward(VecEnvWrapper):
    """Rewards times a constant; unlike running statistics it is the same in every run."""

    def __init__(self, venv: VecEnv, factor: float) -> None:
        super().__init__(venv)
        self._factor = factor

    def reset(self) -> VecEnvObs:
        """See ``VecEnv``."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """See ``VecEnv``."""
        observation, reward, done, info = self.venv.step_wait()
        return observation, self._factor * reward, done, info


def training_env(cfg: TrainCfg, threads: int = 1) -> VecEnv:
    """The environments to learn in.

    Args:
        cfg: Of the run.
        threads: For physics and vision.

    Returns:
        With short episodes, a wider reward and scaled rewards.
    """
    venv = make_sb3_vec(
        cfg.env,
        cfg.n_envs,
        control=cfg.net.control,
        perception=cfg.perception,
        task=SealTaskCfg(time_factor=cfg.time_factor),
        reward=RewardCfg(error_m=cfg.error_m),
        threads=threads,
    )
    return ScaledReward(venv, cfg.reward_scale)


class QuietSac(SAC):
    """SAC whose first steps are the policy's own: SB3's are uniform, up to 1 m/s^2 all over."""

    def _sample_action(
        self, learning_starts: int, action_noise: Any = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        del learning_starts
        return super()._sample_action(0, action_noise, n_envs)


def make_model(cfg: TrainCfg, env: VecEnv) -> BaseAlgorithm:
    """The algorithm, fresh.

    Args:
        cfg: Of the run.
        env: To learn in.

    Returns:
        PPO or SAC; its learning rate falls linearly with the steps of the whole run.
    """
    set_random_seed(cfg.seed)
    policy, kwargs = sb3_policies.policy_of(cfg.net)
    model: BaseAlgorithm
    if cfg.net.algo == "ppo":
        p = cfg.ppo
        model = PPO(
            policy,  # type: ignore[arg-type]  # policy_of gives an ActorCriticPolicy for PPO
            env,
            n_steps=p.rollout // p.n_envs,
            batch_size=min(p.batch_size, p.rollout),
            n_epochs=p.n_epochs,
            learning_rate=p.learning_rate,
            gamma=p.gamma,
            gae_lambda=p.gae_lambda,
            device="cpu",
            policy_kwargs=kwargs,
        )
        if cfg.init is not None:
            assert isinstance(model.policy, GaussianActorCritic)
            put_actor(model.policy, cloned(cfg).net)
        rate = p.learning_rate
    else:
        s = cfg.sac
        model = QuietSac(
            policy,  # type: ignore[arg-type]  # policy_of gives a SACPolicy for SAC
            env,
            buffer_size=s.buffer_size,
            batch_size=s.batch_size,
            train_freq=1,
            gradient_steps=s.gradient_steps,
            learning_rate=s.learning_rate,
            learning_starts=s.learning_starts,
            gamma=s.gamma,
            ent_coef="auto_0.01",
            target_entropy=s.target_entropy * sb3_policies.ACTION_SIZE[cfg.net.control],
            device="cpu",
            policy_kwargs=kwargs,
        )
        assert isinstance(model.policy, SACPolicy)
        sb3_policies.start_from_rest(model.policy, cfg.net)
        rate = s.learning_rate
    # SB3 counts the progress within one call of `learn`, which here is one round.
    model.lr_schedule = lambda _: rate * max(0.1, 1.0 - model.num_timesteps / cfg.steps)
    return model


def cloned(cfg: TrainCfg) -> LearnedPolicy:
    """The behaviour-cloned policy to start from.

    Args:
        cfg: Of a run with ``init``.

    Returns:
        Its ``net`` is the module from observations to actions.

    Raises:
        ConfigError: If the control mode is another.
    """
    policy = policies.load(Path(cfg.init or ""))
    require(
        policy.control == cfg.net.control,
        f"init = {cfg.init!r} acts with control={policy.control!r}: use --control {policy.control}",
    )
    return policy


# -- checkpoints ----------------------------------------------------------------------------------------


def _optimizers(model: BaseAlgorithm) -> list[torch.optim.Optimizer]:
    if isinstance(model, SAC):
        assert model.ent_coef_optimizer is not None
        return [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]
    return [model.policy.optimizer]


_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _tensors(model: BaseAlgorithm) -> dict[str, Tensor]:
    """All that learning goes on from; the random generators are seeded anew in each round."""
    tensors = {f"policy/{name}": values for name, values in model.policy.state_dict().items()}
    for k, optimizer in enumerate(_optimizers(model)):
        for i, state in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer{k}/{i}/{name}": torch.as_tensor(v) for name, v in state.items()}
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None and isinstance(model.replay_buffer, ReplayBuffer)
        tensors["log_ent_coef"] = model.log_ent_coef
        buffer, filled = model.replay_buffer, _filled(model.replay_buffer)
        tensors |= {f"buffer/{name}": torch.from_numpy(getattr(buffer, name)[:filled]) for name in _BUFFER}
    return {name: values.detach().contiguous().clone() for name, values in tensors.items()}


def _filled(buffer: ReplayBuffer) -> int:
    return buffer.buffer_size if buffer.full else buffer.pos


def write_checkpoint(path: Path, model: BaseAlgorithm, about: dict[str, Any]) -> None:
    """Writes all that a run goes on from.

    Args:
        path: The safetensors file, replaced as a whole.
        model: The algorithm.
        about: Ready for JSON.
    """
    counts = {"steps": model.num_timesteps, "updates": model._n_updates}
    if isinstance(model, SAC):
        assert isinstance(model.replay_buffer, ReplayBuffer)
        counts |= {"pos": model.replay_buffer.pos, "full": int(model.replay_buffer.full)}
    text = json.dumps({**about, "counts": counts})
    write_whole(path, save_tensors(_tensors(model), {"run": text}))


def read_about(path: Path) -> dict[str, Any]:
    """What a checkpoint says about itself.

    Args:
        path: The file.

    Returns:
        As given to ``write_checkpoint``, with ``counts``.

    Raises:
        PolicyFileError: If it is broken or no checkpoint of ours.
    """
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["run"])
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise PolicyFileError(
            f"{path.name} is no checkpoint of python -m agents.train_sb3, or a broken one ({error}): "
            "remove the folder to start afresh"
        ) from error
    assert isinstance(about, dict)
    return about


def read_checkpoint(path: Path, model: BaseAlgorithm) -> None:
    """Brings a fresh algorithm to where a checkpoint was written.

    Args:
        path: The file.
        model: From ``make_model`` with the same configuration, changed in place.

    Raises:
        PolicyFileError: If it is broken or of another network.
    """
    counts, tensors = read_about(path)["counts"], read_tensors(path)
    try:
        model.policy.load_state_dict(_below("policy/", tensors))
        for k, optimizer in enumerate(_optimizers(model)):
            state: dict[int, dict[str, Tensor]] = {}
            for name, values in _below(f"optimizer{k}/", tensors).items():
                index, entry = name.split("/")
                state.setdefault(int(index), {})[entry] = values
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
        if isinstance(model, SAC):
            assert model.log_ent_coef is not None and isinstance(model.replay_buffer, ReplayBuffer)
            with torch.no_grad():
                model.log_ent_coef.copy_(tensors["log_ent_coef"])
            for name, values in _below("buffer/", tensors).items():
                getattr(model.replay_buffer, name)[: len(values)] = values.numpy()
            model.replay_buffer.pos, model.replay_buffer.full = counts["pos"], bool(counts["full"])
        model.num_timesteps, model._n_updates = counts["steps"], counts["updates"]
    except (KeyError, ValueError, RuntimeError) as error:
        raise PolicyFileError(f"{path.name} does not fit this run's network ({error})") from error


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


# -- training -------------------------------------------------------------------------------------------


class Bar(BaseCallback):
    """Moves the progress bar."""

    def __init__(self, bar: Any) -> None:
        super().__init__()
        self._bar = bar

    def _on_step(self) -> bool:
        self._bar.update(self.num_timesteps - self._bar.n)
        return True


def _seed_round(model: BaseAlgorithm, cfg: TrainCfg, number: int) -> None:
    """Makes a round depend on seed and number only, not on what the process did before."""
    drawn = np.random.default_rng((cfg.seed, number)).integers(0, FIRST_VALIDATION_SEED - cfg.n_envs, 2)
    set_random_seed(int(drawn[0]))
    env = model.get_env()
    assert env is not None
    env.seed(int(drawn[1]))
    model._last_obs = None  # `learn` then resets the environments


@contextlib.contextmanager
def _only_critic(model: BaseAlgorithm, active: bool) -> Iterator[None]:
    """Holds a cloned actor still until there is a critic worth following."""
    held: list[torch.nn.Parameter] = []
    if active:
        assert isinstance(model.policy, GaussianActorCritic)
        held = [*model.policy.actor.parameters(), model.policy.log_std]
    for values in held:
        values.requires_grad_(False)
    try:
        yield
    finally:
        for values in held:
            values.requires_grad_(True)


@dataclass(kw_only=True)
class Run:
    """A training run in a folder.

    Attributes:
        cfg: What decides it.
        out: The folder.
        threads: For physics and vision.
        videos: Whether each evaluation also makes a video.
        tensorboard: Whether to log for TensorBoard.
    """

    cfg: TrainCfg
    out: Path
    threads: int = 1
    videos: bool = False
    tensorboard: bool = True

    def train(self) -> list[dict[str, Any]]:
        """Trains to the end, from the checkpoint if there is one.

        Returns:
            The evaluations, the first one before any learning.

        Raises:
            ConfigError: If the folder holds another run.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        checkpoint = self.out / "checkpoint.safetensors"
        rows = self._rows_so_far(checkpoint)
        model = make_model(self.cfg, training_env(self.cfg, self.threads))
        model.set_logger(self._logger())
        if rows:
            read_checkpoint(checkpoint, model)
        else:
            self._describe()
        venv = make_sb3_vec(
            self.cfg.env,
            self.cfg.episodes,
            control=self.cfg.net.control,
            perception=self.cfg.perception,
            threads=self.threads,
        )
        with tqdm(
            total=self.cfg.steps, initial=model.num_timesteps, unit="step", unit_scale=True, mininterval=1.0
        ) as bar:
            while not rows or model.num_timesteps < self.cfg.steps:
                started = time.perf_counter()
                if rows:
                    self._learn(model, len(rows), bar)
                learned_s = time.perf_counter() - started
                row = {
                    "step": model.num_timesteps,
                    **summary(play(self._policy(model), venv, FIRST_VALIDATION_SEED)),
                }
                row |= {"learn_s": round(learned_s, 1)}
                self._keep(model, row, rows)
                rows.append(row)
                write_checkpoint(checkpoint, model, {"config": self.cfg.comparable(), "rows": rows})
                self._log(model, rows)
                bar.set_postfix_str(_short(row))
        return rows

    def _learn(self, model: BaseAlgorithm, number: int, bar: Any) -> None:
        left = self.cfg.steps - model.num_timesteps
        _seed_round(model, self.cfg, number)
        with _only_critic(model, self.cfg.init is not None and number == 1):
            model.learn(min(self.cfg.round_steps, left), callback=Bar(bar), reset_num_timesteps=False)

    def _rows_so_far(self, checkpoint: Path) -> list[dict[str, Any]]:
        if not checkpoint.exists():
            return []
        about, wanted = read_about(checkpoint), self.cfg.comparable()
        found = about.get("config", {})
        other = sorted(k for k in wanted.keys() | found.keys() if wanted.get(k) != found.get(k))
        require(
            not other,
            f"{self.out} holds another run: {', '.join(f'{k} = {found.get(k)!r}' for k in other)} there; "
            "give the same options to go on, or another --out",
        )
        rows = about["rows"]
        assert isinstance(rows, list)
        return rows

    def _logger(self) -> Logger:
        kinds = ["tensorboard"] if self.tensorboard and find_spec("tensorboard") else []
        return configure(str(self.out / "tensorboard"), kinds)

    def _describe(self) -> None:
        text = json.dumps(about_run(self.cfg), indent=1)
        write_whole(self.out / "run.json", (text + "\n").encode())

    def _policy(self, model: BaseAlgorithm) -> Sb3Policy:
        return Sb3Policy(model.policy, self.cfg.net.control)

    def _keep(self, model: BaseAlgorithm, row: dict[str, Any], rows: list[dict[str, Any]]) -> None:
        """Writes the policy if it is the best so far."""
        best = None
        for earlier in rows:
            best = earlier if better(earlier, best) else best
        if not better(row, best):
            return
        path, card = self.out / "policy.safetensors", {**about_run(self.cfg), "scores": row}
        if self.cfg.init is None:
            sb3_policies.save(model.policy, self.cfg.net, path, card)
            return
        # A cloned policy stays one of its own kind, only with other weights.
        assert isinstance(model.policy, GaussianActorCritic)
        policy = cloned(self.cfg)
        policy.net.load_state_dict(model.policy.actor.state_dict())
        policies.save(policy, path, card)

    def _log(self, model: BaseAlgorithm, rows: list[dict[str, Any]]) -> None:
        text = "".join(json.dumps(row) + "\n" for row in rows)
        write_whole(self.out / "evaluations.jsonl", text.encode())
        for name, value in rows[-1].items():
            if value is not None and name != "step":
                model.logger.record(f"eval/{name}", value)
        model.logger.dump(model.num_timesteps)
        if self.videos:
            self._film(model)

    def _film(self, model: BaseAlgorithm) -> None:
        from agents.enjoy import film

        path = self.out / "videos" / f"{model.num_timesteps:09d}.mp4"
        kwargs = {"control": self.cfg.net.control, "perception": self.cfg.perception}
        try:
            film(self._policy(model), self.cfg.env, kwargs, FIRST_VALIDATION_SEED, path)
        except RenderError as error:
            self.videos = False
            sys.stderr.write(f"no videos: {error}\n")


def about_run(cfg: TrainCfg) -> dict[str, Any]:
    """What a run is, for its cards.

    Args:
        cfg: Of the run.

    Returns:
        Ready for JSON.
    """
    return {
        "command": shlex.join(["python", "-m", "agents.train_sb3", *sys.argv[1:]]),
        "control": cfg.net.control,
        "training": cfg.comparable(),
        "stack": versions(_STACK),
    }


def _short(row: dict[str, Any]) -> str:
    rmse = "-" if row["rmse_mm"] is None else f"{row['rmse_mm']:.3f}"
    return f"reached {row['reached_pct']:.0f} %, RMSE {rmse} mm"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m agents.train_sb3",
        description="Trains a sealing policy with Stable-Baselines3; run it again to go on after a stop.",
    )
    parser.add_argument("--algo", choices=ALGORITHMS, default="ppo", help="(default: %(default)s)")
    parser.add_argument(
        "--env",
        choices=seal_gym.ENV_IDS,
        default=seal_gym.ENV_IDS[0],
        metavar="ID",
        help="(default: %(default)s)",
    )
    parser.add_argument(
        "--control", choices=tuple(sb3_policies.ACTION_SIZE), default="tip", help="(default: %(default)s)"
    )
    parser.add_argument("--perception", choices=PERCEPTIONS, default="oracle", help="(default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, help="frames, of all environments together (default: 393216; SAC 200000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--n-envs", type=int, help="environments stepped together (default: 64; SAC 16)")
    parser.add_argument("--init", help="NAME.safetensors of a behaviour-cloned policy to start from (PPO)")
    parser.add_argument("--round-steps", type=int, help="frames between evaluations and checkpoints")
    parser.add_argument("--episodes", type=int, default=20, help="of an evaluation (default: %(default)s)")
    parser.add_argument(
        "--threads", type=int, default=1, help="for physics and vision (default: %(default)s)"
    )
    parser.add_argument("--videos", action="store_true", help="a video at each evaluation; needs OpenGL")
    parser.add_argument("--no-tensorboard", action="store_true", help="no TensorBoard log")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the run")
    return parser.parse_args(arguments)


def config(options: argparse.Namespace) -> TrainCfg:
    """The run that a command line asks for.

    Args:
        options: From ``parse``.

    Returns:
        Its configuration.

    Raises:
        ConfigError: If a value is out of range.
    """
    sac = options.algo == "sac"
    net = NetCfg(algo=options.algo, control=options.control)
    if options.init is not None:
        net = replace(net, log_std=_LOG_STD_FINE)
    changes: dict[str, Any] = {"n_envs": options.n_envs} if options.n_envs is not None else {}
    return TrainCfg(
        env=options.env,
        perception=options.perception,
        steps=options.steps if options.steps is not None else (200_000 if sac else TrainCfg.steps),
        seed=options.seed,
        round_steps=options.round_steps
        if options.round_steps is not None
        else (20_000 if sac else TrainCfg.round_steps),
        episodes=options.episodes,
        net=net,
        init=options.init,
        ppo=PpoCfg() if sac else PpoCfg(**changes),
        sac=SacCfg(**changes) if sac else SacCfg(),
    )


def main(arguments: list[str] | None = None) -> int:
    """Trains.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it trained to the end.
    """
    options = parse(arguments)
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other
    try:
        run = Run(
            cfg=config(options),
            out=options.out,
            threads=options.threads,
            videos=options.videos,
            tensorboard=not options.no_tensorboard,
        )
        rows = run.train()
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"stopped; the same command goes on from {options.out}\n")
        return 130
    for row in rows:
        print(f"{row['step']:>9} steps: {_short(row)}, return {row['return']:.1f}")
    print(f"policy and curves in {options.out}/")
    return 0


if __name__ == "__main__":
    sys.exit(main())
