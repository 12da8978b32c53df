"""Behaviour cloning and DAgger of the RMP expert.

``python -m agents.train_bc --policy neural_rmp --seed 0 --data DIR --out DIR``

Loss. L2 as Zhou et al., 4.2, on the environment's scaled action: the six accelerations (for ``neural_rmp``
of the expert's leaf, with the 21 Cholesky entries of its metric; for ``neural_rmp_identity`` of the leaf
alone; for ``neural_control`` of the tip), each divided by the limit that an action of 1 means. It is the
plainest loss that is the same for every kind. A loss on the resolved acceleration would not do for
``neural_rmp``: it leaves f and A free to trade against each other, and a metric that is right by accident
beside the fixed leaves is wrong beside a leaf that the user adds. A label at its limit of +-1 has been
clipped: a prediction beyond it is clipped as well and costs nothing.

Optimiser. `imitation`'s ``BC`` with Adam, whose negative log-likelihood is exchanged for the loss above; the
learning rate falls along a half cosine over ``--epochs``. All kinds share data, split, batches, optimiser,
epochs and the rules below.

Rules, fixed beforehand. One episode in ten is held out for validation, the same ones for every kind and seed.
The weights kept are those of the epoch with the lowest validation loss. Training stops early once that loss
has not fallen by 1 % for ``--patience`` epochs. With ``--dagger`` the last round's policy is kept. Of several
training seeds the one to ship is ``agents.ship.best_of``'s: it reached most often on the validation seeds of
flat and cylinder (``--validate``), and among equals had the smallest RMSE; the rectangular part has no
say, so that it stays unseen.

DAgger (Ross et al. 2011). In each round the policy acts on flat and cylinder, the expert labels the states it
visits, in the action space of the kind, and the policy learns on from all the data. The expert never acts in
these rounds (beta = 1 for the demonstrations, 0 afterwards, as Ross et al. recommend). The loop is ours:
`imitation`'s trainer takes its labels from a policy that acts in the same action space, which the expert does
not for ``neural_control``, and it keeps its state in pickles.

Resume. After each epoch the state is written to ``checkpoint.safetensors`` in the round's folder; the same
command goes on from there and ends with the same weights, to the bit on the same machine. Remove OUT to start
anew.
"""

import argparse
import hashlib
import json
import shlex
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from imitation.algorithms.bc import BC
from imitation.util import logger as imitation_logger
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as write_tensors
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from agents import rollouts
from agents.policies import (
    ACCELS,
    CONTROL_OF,
    KINDS,
    LearnedPolicy,
    PolicyFileError,
    SealNet,
    check_tensors,
    save,
    write_whole,
)
from agents.rollouts import Episode
from seal_gym.core.errors import ConfigError, is_number, require
from seal_gym.envs.core import FEATURES

FloatRows = NDArray[np.float32]
_SPLIT_SEED = 0  # one split for every kind and training seed
_HELD_OUT = 10
_STATE = "state"
_PARTS = ("flat", "cylinder")  # to train and to choose on: the rectangular part stays unseen
_DAGGER_SEED = 300_000  # away from the demonstrations', below the validation seeds
_DAGGER_RUNS, _DAGGER_STRIDE = 20, 10_000


@dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """How to train.

    Attributes:
        kind: One of ``agents.policies.KINDS``.
        seed: Of weights and batches.
        epochs: At most so many.
        batch: Frames in a batch.
        learning_rate: At the start.
        patience: Epochs without improvement after which training stops.
    """

    kind: str
    seed: int = 0
    epochs: int = 20
    batch: int = 1024
    learning_rate: float = 2e-3
    patience: int = 5

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(self.kind in KINDS, f"kind = {self.kind!r}: must be one of {list(KINDS)}")
        for name, low in (("seed", 0), ("epochs", 1), ("batch", 1), ("patience", 1)):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            require(whole and value >= low, f"TrainCfg.{name} = {value!r}: must be a whole number >= {low}")
        rate = self.learning_rate
        require(
            is_number(rate) and 0 < rate <= 1,
            f"TrainCfg.learning_rate = {rate!r}: must be a number in (0, 1]",
        )

    @property
    def control(self) -> str:
        """The action space of the labels."""
        return CONTROL_OF[self.kind]

    @property
    def learned(self) -> int | None:
        """How many entries of the action are learned; None for all."""
        return ACCELS if self.kind == "neural_rmp_identity" else None


@dataclass(frozen=True, kw_only=True)
class Split:
    """Labelled frames to learn from and to validate on.

    Attributes:
        train: Observations (n, 35) and actions (n, k).
        held_out: The same, of other episodes.
        digest: SHA-256 of them all.
    """

    train: tuple[Tensor, Tensor]
    held_out: tuple[Tensor, Tensor]
    digest: str


def split(episodes: Sequence[Episode], control: str) -> Split:
    """Holds one episode in ten out.

    Args:
        episodes: At least two.
        control: ``"tip"`` or ``"rmp"``: which labels.

    Returns:
        The frames.

    Raises:
        ConfigError: If there are too few episodes, or a number is not finite.
    """
    require(len(episodes) >= 2, f"the data hold {len(episodes)} episodes: at least 2, one to validate on")
    held = _held_out(len(episodes))
    digest = hashlib.sha256()
    parts = []
    for wanted in (False, True):
        chosen = [e for k, e in enumerate(episodes) if (k in held) == wanted]
        observations = np.concatenate([e.observations for e in chosen]).astype(np.float32)
        actions = np.concatenate([getattr(e, control) for e in chosen]).astype(np.float32)
        for rows in (observations, actions):
            require(
                bool(np.isfinite(rows).all()), "the data hold values that are not finite: collect them anew"
            )
            digest.update(rows.tobytes())
        parts.append((torch.from_numpy(observations), torch.from_numpy(actions)))
    return Split(train=parts[0], held_out=parts[1], digest=digest.hexdigest())


def _held_out(n: int) -> set[int]:
    """One in each ten, which stays held out when more episodes follow; the last one of fewer than ten."""
    tens = range(n // _HELD_OUT)
    held = {_HELD_OUT * k + int(np.random.default_rng([_SPLIT_SEED, k]).integers(_HELD_OUT)) for k in tens}
    return held or {n - 1}


def loss(prediction: Tensor, label: Tensor, learned: int | None = None) -> Tensor:
    """Mean square error of the action, blind to what clipping hides.

    Args:
        prediction: Not clipped, shape (n, k).
        label: In [-1, 1], shape (n, k).
        learned: How many entries count; the others are not the network's to choose. All by default.

    Returns:
        A scalar.
    """
    prediction, label = prediction[:, :learned], label[:, :learned]
    hidden = ((label >= 1.0) & (prediction > 1.0)) | ((label <= -1.0) & (prediction < -1.0))
    return torch.where(hidden, 0.0, prediction - label).square().mean()


@dataclass(frozen=True)
class _Metrics:
    loss: Tensor


class _L2Loss:
    """In the place of `imitation`'s ``BehaviorCloningLossCalculator``; adds up the epoch's loss."""

    def __init__(self, learned: int | None) -> None:
        self.learned = learned
        self.total, self.batches = 0.0, 0

    def __call__(self, policy: BasePolicy, obs: Tensor, acts: Tensor) -> _Metrics:
        value = loss(policy(obs), acts, self.learned)
        self.total += value.item()
        self.batches += 1
        return _Metrics(value)


class _Student(BasePolicy):
    """The network as the policy that ``BC`` wants."""

    def __init__(self, net: SealNet, control: str) -> None:
        size = 6 if control == "tip" else 27
        super().__init__(
            gym.spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32),
            gym.spaces.Box(-1.0, 1.0, (size,), np.float32),
        )
        self.net = net

    def forward(self, observation: Tensor) -> Tensor:
        action: Tensor = self.net(observation)
        return action

    def _predict(self, observation: Tensor, deterministic: bool = False) -> Tensor:  # type: ignore[override]
        del deterministic
        return self.forward(observation).clamp(-1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class _Batches:
    """One epoch's batches: an order of its own, whatever was drawn before."""

    data: tuple[Tensor, Tensor]
    size: int
    seed: int
    epoch: int

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        observations, actions = self.data
        order = torch.from_numpy(np.random.default_rng([self.seed, self.epoch]).permutation(len(actions)))
        size = min(self.size, len(actions))
        for start in range(0, len(actions) - size + 1, size):
            rows = order[start : start + size]
            yield {"obs": observations[rows], "acts": actions[rows]}


class Trainer:
    """Behaviour cloning of one policy, epoch by epoch, resumable after each.

    Attributes:
        policy: What is trained.
        history: Per epoch: training loss, validation loss.
    """

    def __init__(self, cfg: TrainCfg, data: Split, out: Path, start: LearnedPolicy | None = None) -> None:
        """Sets up, or goes on where ``out`` left off.

        Args:
            cfg: How to train.
            data: What to learn.
            out: Directory of the checkpoint and the curves.
            start: Weights to start from; drawn with ``cfg.seed`` by default.

        Raises:
            ConfigError: If ``out`` holds the checkpoint of another run.
            PolicyFileError: If the checkpoint is damaged.
        """
        self._cfg, self._data, self._out = cfg, data, out
        self.policy = start or LearnedPolicy.fresh(cfg.kind, cfg.seed)
        self.history: list[tuple[float, float]] = []
        out.mkdir(parents=True, exist_ok=True)
        self._student = _Student(self.policy.net, cfg.control)
        self._loss = _L2Loss(cfg.learned)
        with tempfile.TemporaryDirectory() as folder:
            self._bc = BC(
                observation_space=self._student.observation_space,
                action_space=self._student.action_space,
                rng=np.random.default_rng(cfg.seed),  # only for rollouts, of which there are none
                policy=self._student,  # type: ignore[arg-type]  # with the loss below, any policy of SB3's will do
                batch_size=min(cfg.batch, len(data.train[1])),
                optimizer_kwargs={"lr": cfg.learning_rate},
                device="cpu",
                custom_logger=imitation_logger.configure(folder, []),
            )
        self._bc.loss_calculator = self._loss  # type: ignore[assignment]
        self._best = self._weights()
        self._identity = {**asdict(cfg), "data": data.digest, "start": _digest(self._best)}
        if self._checkpoint.exists():
            self._resume()

    @property
    def digest(self) -> str:
        """SHA-256 of the data."""
        return self._data.digest

    @property
    def _checkpoint(self) -> Path:
        return self._out / "checkpoint.safetensors"

    @property
    def done(self) -> bool:
        """Whether the epochs are over, or the validation loss has stopped falling."""
        epochs = len(self.history)
        return epochs >= self._cfg.epochs or epochs - _last_progress(self.history) >= self._cfg.patience

    def run(self, progress: bool = True) -> LearnedPolicy:
        """Trains to the end.

        Args:
            progress: Whether to show a bar.

        Returns:
            The policy with the weights of the best epoch.
        """
        epochs = len(self.history)
        with SummaryWriter(str(self._out / "tensorboard"), purge_step=epochs) as curves:
            bar = tqdm(total=self._cfg.epochs, initial=epochs, unit="epoch", disable=not progress)
            while not self.done:
                self.epoch(curves)
                bar.update()
                bar.set_postfix(train=f"{self.history[-1][0]:.2e}", held_out=f"{self.history[-1][1]:.2e}")
            bar.close()
        self.policy.net.load_state_dict(self._best)
        return self.policy

    def epoch(self, curves: SummaryWriter | None = None) -> None:
        """Trains for one epoch, validates, and writes the checkpoint.

        Args:
            curves: Where to draw the losses.
        """
        cfg, k = self._cfg, len(self.history)
        rate = 0.5 * cfg.learning_rate * (1.0 + np.cos(np.pi * k / cfg.epochs))
        for group in self._bc.optimizer.param_groups:
            group["lr"] = rate
        self._loss.total, self._loss.batches = 0.0, 0
        batches = _Batches(data=self._data.train, size=self._bc.batch_size, seed=cfg.seed, epoch=k)
        self._bc.set_demonstrations(cast("Any", batches))  # a list of batches would do, and fill the memory
        with warnings.catch_warnings():
            # BC turns its loss into a float for a log that nobody keeps, gradient and all.
            warnings.filterwarnings("ignore", "Converting a tensor with requires_grad", UserWarning)
            self._bc.train(n_epochs=1, progress_bar=False, log_interval=sys.maxsize)
        self.history.append((self._loss.total / self._loss.batches, self._validate()))
        if self.history[-1][1] <= min(held for _, held in self.history):
            self._best = self._weights()
        self._save()
        if curves:
            for name, value in (("train", self.history[-1][0]), ("held_out", self.history[-1][1])):
                curves.add_scalar(f"loss/{name}", value, k)
            curves.add_scalar("learning_rate", rate, k)

    def _validate(self) -> float:
        observations, actions = self._data.held_out
        with torch.inference_mode():
            return float(loss(self._student(observations), actions, self._cfg.learned))

    def _weights(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.policy.net.state_dict().items()}

    # -- checkpoint -------------------------------------------------------------------------------------

    def _tensors(self) -> dict[str, Tensor]:
        """Weights, best weights and Adam's state, by name."""
        out = {f"net/{k}": v for k, v in self._weights().items()}
        out |= {f"best/{k}": v for k, v in self._best.items()}
        for k, parameter in enumerate(self._student.parameters()):
            state = self._bc.optimizer.state.get(parameter) or {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }
            out |= {f"adam/{k}/{name}": state[name].detach().contiguous() for name in _ADAM}
        return out

    def _save(self) -> None:
        state = json.dumps({"run": self._identity, "history": self.history})
        write_whole(self._checkpoint, write_tensors(self._tensors(), metadata={_STATE: state}))

    def _resume(self) -> None:
        path = self._checkpoint
        text, tensors = _read_tensors(path)
        state = json.loads(text)
        if state["run"] != self._identity:
            raise ConfigError(
                f"{path} is of another run (other data, seed or options): choose another --out, or remove it"
            )
        check_tensors(tensors, self._tensors(), path)
        self.history = [(float(train), float(held)) for train, held in state["history"]]
        self._best = {name: tensors[f"best/{name}"] for name in self._best}
        self.policy.net.load_state_dict({name: tensors[f"net/{name}"] for name in self._best})
        for k, parameter in enumerate(self._student.parameters()):
            self._bc.optimizer.state[parameter] = {name: tensors[f"adam/{k}/{name}"] for name in _ADAM}


_ADAM = ("step", "exp_avg", "exp_avg_sq")


def _read_tensors(path: Path) -> tuple[str, dict[str, Tensor]]:
    """A file of this module's: what was noted in it, and its tensors."""
    try:
        with safe_open(str(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # no mapping
            return file.metadata()[_STATE], tensors
    except (SafetensorError, OSError, TypeError, KeyError) as error:
        raise PolicyFileError(
            f"{path} is damaged, or not a file of this program's ({error}): remove it"
        ) from error


def _last_progress(history: Sequence[tuple[float, float]]) -> int:
    """Epochs after which the validation loss last fell by 1 % below what it had been when it last did."""
    level, at = np.inf, 0
    for k, (_, held) in enumerate(history, start=1):
        if held < 0.99 * level:
            level, at = held, k
    return at


def _digest(tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode() + tensors[name].numpy().tobytes())
    return digest.hexdigest()


# -- DAgger ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class DaggerCfg:
    """Rounds of DAgger after behaviour cloning.

    Attributes:
        rounds: How many; 0 for behaviour cloning alone.
        episodes: Episodes a round on each part.
        epochs: Epochs a round.
        perception: ``"vision"`` or ``"oracle"``.
    """

    rounds: int = 0
    episodes: int = 10
    epochs: int = 20
    perception: str = "vision"

    def __post_init__(self) -> None:
        """Checks the ranges."""
        for name, low, high in (("rounds", 0, 9), ("episodes", 1, 500), ("epochs", 1, 10_000)):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            require(
                whole and low <= value <= high,
                f"DaggerCfg.{name} = {value!r}: must be a whole number in {low}..{high}",
            )
        require(
            self.perception in ("vision", "oracle"),
            f"DaggerCfg.perception = {self.perception!r}: must be 'vision' or 'oracle'",
        )


def train(
    cfg: TrainCfg,
    episodes: Sequence[Episode],
    out: Path,
    dagger: DaggerCfg | None = None,
    progress: bool = True,
) -> tuple[LearnedPolicy, dict[str, Any]]:
    """Clones the expert, then lets it correct the clone in rounds of DAgger.

    Args:
        cfg: How to train.
        episodes: Demonstrations.
        out: Directory for checkpoints, curves and the rounds' episodes; a killed run goes on from it.
        dagger: The rounds; none by default.
        progress: Whether to show bars.

    Returns:
        The policy, and the last training's losses and the data's digest for its card.
    """
    dagger = dagger or DaggerCfg()
    trainer = Trainer(cfg, split(episodes, cfg.control), out / "round-0")
    policy, seen = trainer.run(progress), list(episodes)
    for k in range(1, dagger.rounds + 1):
        folder = out / f"round-{k}"
        seen += _round(policy, cfg, dagger, k, folder / "episodes.safetensors")
        data = split(seen, cfg.control)
        trainer = Trainer(replace(cfg, epochs=dagger.epochs), data, folder, start=policy)
        policy = trainer.run(progress)
    scores = {
        "epochs": len(trainer.history),
        "loss_train": trainer.history[-1][0],
        "loss_held_out": min(held for _, held in trainer.history),
    }
    return policy, {"data_sha256": trainer.digest, "training": scores}


def _round(policy: LearnedPolicy, cfg: TrainCfg, dagger: DaggerCfg, k: int, file: Path) -> list[Episode]:
    """The episodes of a round, from its file if it was run before by the same policy."""
    run = json.dumps({**asdict(dagger), "seed": cfg.seed, "policy": _digest(policy.net.state_dict())})
    if not file.exists():
        first = _DAGGER_SEED + _DAGGER_STRIDE * (cfg.seed % _DAGGER_RUNS) + 1000 * k
        rolled = [
            episode
            for n, part in enumerate(_PARTS)
            for episode in rollouts.roll(
                policy,
                workpiece=part,
                seed=first + 500 * n,
                episodes=dagger.episodes,
                perception=dagger.perception,
            )
        ]
        columns = zip(Episode._fields, zip(*rolled, strict=True), strict=True)
        tensors = {name: torch.from_numpy(np.concatenate(rows)) for name, rows in columns}
        tensors["lengths"] = torch.tensor([len(e.tip) for e in rolled])
        write_whole(file, write_tensors(tensors, metadata={_STATE: run}))
    state, tensors = _read_tensors(file)
    if state != run:
        raise ConfigError(
            f"{file} is of another run (other options or policy): choose another --out, or remove it"
        )
    lengths = tensors["lengths"].tolist()
    rows = [torch.split(tensors[name], lengths) for name in Episode._fields]
    return [Episode(*(r.numpy() for r in parts)) for parts in zip(*rows, strict=True)]


def validate(policy: LearnedPolicy, trials: int, perception: str) -> dict[str, Any]:
    """Scores a policy in closed loop on the validation seeds of the parts it was trained on.

    Args:
        policy: To drive.
        trials: Trials a part.
        perception: ``"vision"`` or ``"oracle"``.

    Returns:
        ``agents.rollouts.score`` by part.
    """
    return {
        part: rollouts.score(policy, workpiece=part, trials=trials, perception=perception) for part in _PARTS
    }


# -- command line ---------------------------------------------------------------------------------------


def read_episodes(path: Path) -> list[Episode]:
    """Demonstrations as ``agents.collect`` stores them.

    Args:
        path: The dataset.

    Returns:
        One entry an episode.
    """
    data = import_module("agents.demos").load(path)
    rows = (data.observations, data.actions("tip"), data.actions("rmp"))
    return [Episode(*(r[start:stop] for r in rows)) for start, stop in data.episodes]


def _stack() -> dict[str, str | None]:
    def installed(name: str) -> str | None:
        try:
            return version(name)
        except PackageNotFoundError:
            return None

    names = ("torch", "safetensors", "imitation", "stable-baselines3", "gymnasium", "mujoco", "numpy")
    return {"python": sys.version.split()[0], **{name: installed(name) for name in names}}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m agents.train_bc", description="Behaviour cloning and DAgger of the RMP expert."
    )
    defaults, rounds = TrainCfg(kind=KINDS[0]), DaggerCfg()
    parser.add_argument("--policy", choices=KINDS, required=True)
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default: %(default)s)")
    parser.add_argument("--data", type=Path, required=True, help="dataset of agents.collect")
    parser.add_argument("--out", type=Path, required=True, help="directory; a killed run goes on from it")
    parser.add_argument("--epochs", type=int, default=defaults.epochs, help="at most (default: %(default)s)")
    parser.add_argument("--batch", type=int, default=defaults.batch, help="frames (default: %(default)s)")
    parser.add_argument(
        "--learning-rate", type=float, default=defaults.learning_rate, help="(default: %(default)s)"
    )
    parser.add_argument(
        "--patience", type=int, default=defaults.patience, help="epochs (default: %(default)s)"
    )
    parser.add_argument("--jobs", type=int, default=1, help="torch's threads (default: %(default)s)")
    parser.add_argument("--dagger", type=int, default=0, metavar="ROUNDS", help="(default: %(default)s)")
    parser.add_argument(
        "--dagger-episodes", type=int, default=rounds.episodes, help="a round and part (default: %(default)s)"
    )
    parser.add_argument(
        "--dagger-epochs", type=int, default=rounds.epochs, help="a round (default: %(default)s)"
    )
    parser.add_argument(
        "--perception", choices=("vision", "oracle"), default="vision", help="of DAgger and --validate"
    )
    parser.add_argument(
        "--validate",
        type=int,
        default=0,
        metavar="TRIALS",
        help="in closed loop a part at the end, for the card",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Trains a policy and writes ``OUT/NAME-seedS.safetensors`` with its card.

    Args:
        arguments: Of the command line.
    """
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.jobs)
    cfg = TrainCfg(
        kind=options.policy,
        seed=options.seed,
        epochs=options.epochs,
        batch=options.batch,
        learning_rate=options.learning_rate,
        patience=options.patience,
    )
    dagger = DaggerCfg(
        rounds=options.dagger,
        episodes=options.dagger_episodes,
        epochs=options.dagger_epochs,
        perception=options.perception,
    )
    policy, card = train(cfg, read_episodes(options.data), options.out, dagger)
    if options.validate:
        card["validation"] = validate(policy, options.validate, options.perception)
        card["validation_perception"] = options.perception
    given = sys.argv[1:] if arguments is None else list(arguments)
    card |= {
        "command": shlex.join(["python", "-m", "agents.train_bc", *given]),
        "seed": cfg.seed,
        "train": asdict(cfg),
        "dagger": asdict(dagger),
        "data": options.data.name,
        "stack": _stack(),
    }
    path = options.out / f"{cfg.kind}-seed{cfg.seed}.safetensors"
    save(policy, path, card)
    print(f"{path}: {json.dumps({k: card.get(k) for k in ('training', 'validation')})}")


if __name__ == "__main__":
    main()
