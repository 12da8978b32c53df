"""Training of the cross-section surrogate (paper B 3.2.5).

``python -m agents.train_surrogate --data DIR --kind mlp_cnn --neighbours 4 --on-fan --out FILE.safetensors``

Loss: mean square error of the pixels. The linear glass box is a least-squares problem with a ridge, solved
exactly. The MLP-CNN learns by SGD with Nesterov's momentum, as in the thesis, or by AdamW; the learning rate
rises over three epochs and falls along a half cosine.

Rules, fixed beforehand. One training centre path in five is held out; the weights kept are those of the epoch
with the smallest error on them, and so are the ridge and the model to ship. The obstacle course has no say. A
mirror at the tip's x = 0 changes nothing in the physics: each section is seen as it is or mirrored, with even
chances.
"""

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from agents.provenance import commit
from agents.surrogate_data import Set, digest, prepared, read_beads, split
from seal_gym.core.errors import SealGymError, is_number, require
from seal_gym.core.frames import Array
from seal_gym.core.provenance import versions
from seal_gym.sealant.surrogate import KINDS, Features, Surrogate, SurrogateCfg, joined, save_surrogate
from seal_gym.sealant.surrogate_net import SectionNet, tensors

OPTIMISERS = ("sgd", "adamw")
RIDGES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
_WARM = 3  # epochs
_STACK = ("python", "torch", "safetensors", "numpy", "scipy")


@dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """How to train an MLP-CNN.

    Attributes:
        optimiser: One of ``OPTIMISERS``.
        seed: Of weights and batches.
        epochs: So many.
        batch: Sections in a batch.
        every: Of the sections, which are 1 mm apart, each epoch sees one in so many, others each time.
        learning_rate: At the start; by default the optimiser's own.
        weight_decay: Of both optimisers.
    """

    optimiser: str = "adamw"
    seed: int = 0
    epochs: int = 14
    batch: int = 64
    every: int = 2
    learning_rate: float | None = None
    weight_decay: float = 1e-2

    def __post_init__(self) -> None:
        """Checks the ranges."""
        require(
            self.optimiser in OPTIMISERS,
            f"optimiser = {self.optimiser!r}: must be one of {list(OPTIMISERS)}",
        )
        for name, low in (("seed", 0), ("epochs", 1), ("batch", 2), ("every", 1)):
            value = getattr(self, name)
            require(
                type(value) is int and value >= low, f"{name} = {value!r}: must be a whole number >= {low}"
            )
        rate = self.learning_rate
        require(
            rate is None or (is_number(rate) and 0 < rate <= 10),
            f"learning_rate = {rate!r}: must be a number in (0, 10] or None",
        )
        decay = self.weight_decay
        require(is_number(decay) and 0 <= decay <= 1, f"weight_decay = {decay!r}: must be in [0, 1]")

    @property
    def rate(self) -> float:
        """The learning rate at the start."""
        return self.learning_rate or {"sgd": 0.1, "adamw": 3e-3}[self.optimiser]


@dataclass(frozen=True)
class Trained:
    """What came of a training.

    Attributes:
        model: With the weights of the best epoch.
        history: Of each epoch: training and held-out mean square error.
        held_out: The smallest held-out error.
        wall_s: What it took.
    """

    model: Surrogate
    history: tuple[tuple[float, float], ...]
    held_out: float
    wall_s: float


def mean_square_error(model: Surrogate, data: Set) -> float:
    """The error of clipped sections.

    Args:
        model: To judge.
        data: The sections.

    Returns:
        Mean over pixels and sections.
    """
    return float(np.mean((model.sections(data.inputs) - data.images) ** 2))


def least_squares(inputs: Array, targets: Array, ridge: float) -> tuple[Array, Array]:
    """W and b that make ``|W x + b - y|^2 / n + ridge |W|^2`` smallest.

    Args:
        inputs: x, shape (n, k).
        targets: y, shape (n, m).
        ridge: >= 0; with 0 of all solutions the one with the smallest W.

    Returns:
        W (m, k) and b (m,).
    """
    n, k = inputs.shape
    centre, level = inputs.mean(0), targets.mean(0)
    a = np.vstack(((inputs - centre) / np.sqrt(n), np.sqrt(ridge) * np.eye(k)))
    b = np.vstack(((targets - level) / np.sqrt(n), np.zeros((k, targets.shape[1]))))
    weights = np.linalg.lstsq(a, b, rcond=None)[0].T
    return weights, level - weights @ centre


def with_mirror(data: Set) -> tuple[Features, Array]:
    """The sections and their mirror images.

    Args:
        data: The sections.

    Returns:
        Features and images of twice as many.
    """
    return (
        joined([data.inputs, data.inputs.mirrored()]),
        np.concatenate((data.images, data.images[..., ::-1])),
    )


def fit_linear(cfg: SurrogateCfg, train: Set, held: Set, ridges: Sequence[float] = RIDGES) -> Trained:
    """The glass box, solved for each ridge; the one that is best on the held-out paths.

    Args:
        cfg: Of kind ``"linear"``.
        train: To learn from.
        held: To choose by.
        ridges: To choose from.

    Returns:
        The model; its history has an entry for each ridge.
    """
    begin = time.perf_counter()
    inputs, images = with_mirror(train)
    targets = (images - inputs.fan() if cfg.on_fan else images).reshape(len(images), -1)
    found = []
    for ridge in ridges:
        net = SectionNet(cfg)
        net.normalise(inputs)
        mean = np.concatenate((net.kinematic_mean.numpy(), net.spatial_mean.numpy()))
        scale = np.concatenate((net.kinematic_scale.numpy(), net.spatial_scale.numpy()))
        weights, bias = least_squares((inputs.flat() - mean) / scale, targets, ridge)
        with torch.no_grad():
            net.glass.weight.copy_(torch.from_numpy(weights))
            net.glass.bias.copy_(torch.from_numpy(bias))
        found.append(Surrogate(cfg, net))
    history = tuple((mean_square_error(m, train), mean_square_error(m, held)) for m in found)
    best = min(range(len(found)), key=lambda k: history[k][1])
    return Trained(found[best], history, history[best][1], time.perf_counter() - begin)


def fit_network(
    cfg: SurrogateCfg, how: TrainCfg, train: Set, held: Set, tick: Callable[[], Any] = lambda: None
) -> Trained:
    """Trains an MLP-CNN.

    Args:
        cfg: Of kind ``"mlp_cnn"``.
        how: To train.
        train: To learn from.
        held: To keep the best epoch by.
        tick: Called after each epoch.

    Returns:
        The model. The same arguments give the same weights to the bit on the same machine; torch's global
        generator is left as it was.
    """
    begin = time.perf_counter()
    with torch.random.fork_rng(devices=[]), _single_thread():
        torch.manual_seed(how.seed)
        net = SectionNet(cfg)
        inputs, images = with_mirror(train)
        net.normalise(inputs)
        seen = (*tensors(inputs), torch.from_numpy(images.astype(np.float32)))
        optimiser = _optimiser(net, how)
        best, history = net.arrays(), []
        for epoch in range(how.epochs):
            warm = min((epoch + 1) / _WARM, 1.0)
            rate = 0.5 * how.rate * warm * (1.0 + np.cos(np.pi * epoch / how.epochs))
            for group in optimiser.param_groups:
                group["lr"] = rate
            loss = _epoch(net, optimiser, seen, _batches(len(images) // 2, how, epoch))
            history.append((loss, mean_square_error(Surrogate(cfg, net), held)))
            if history[-1][1] <= min(h for _, h in history):
                best = net.arrays()
            tick()
        net.take(best)
    model = Surrogate(cfg, net)
    return Trained(model, tuple(history), min(h for _, h in history), time.perf_counter() - begin)


def _optimiser(net: SectionNet, how: TrainCfg) -> torch.optim.Optimizer:
    if how.optimiser == "adamw":
        return torch.optim.AdamW(net.parameters(), lr=how.rate, weight_decay=how.weight_decay)
    # SGD adds the decay to the gradient, AdamW takes it off the weights by the step: of the same strength
    # they would have to differ by the learning rate
    decay = 1e-2 * how.weight_decay
    return torch.optim.SGD(net.parameters(), how.rate, momentum=0.9, weight_decay=decay, nesterov=True)


def _batches(sections: int, how: TrainCfg, epoch: int) -> Iterator[Tensor]:
    """Rows among the sections and, beyond them, their mirror images: an order of the epoch's own."""
    rng = np.random.default_rng([how.seed, epoch])
    rows = np.arange(epoch % how.every, sections, how.every)
    rows = rng.permutation(rows) + sections * rng.integers(0, 2, len(rows))
    for start in range(0, len(rows), how.batch):
        part = rows[start : start + how.batch]
        if len(part) > 1:  # batch norm needs two
            yield torch.from_numpy(part)


def _epoch(
    net: SectionNet, optimiser: torch.optim.Optimizer, seen: tuple[Tensor, ...], batches: Iterator[Tensor]
) -> float:
    net.train()
    total, count = 0.0, 0
    for rows in batches:
        *inputs, wanted = (t[rows] for t in seen)
        loss = (net(*inputs) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        total, count = total + loss.item() * len(rows), count + len(rows)
    return total / count


@contextmanager
def _single_thread() -> Iterator[None]:
    """The order of sums, and so the weights, must not depend on the machine's cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def fit(cfg: SurrogateCfg, how: TrainCfg, train: Set, held: Set, title: str = "") -> Trained:
    """Trains a surrogate of either kind.

    Args:
        cfg: What to train.
        how: For an MLP-CNN.
        train: To learn from.
        held: To choose by.
        title: Of the progress bar.

    Returns:
        The model.
    """
    if cfg.kind == "linear":
        return fit_linear(cfg, train, held)
    with tqdm(total=how.epochs, desc=title or cfg.kind, unit="epoch") as bar:
        return fit_network(cfg, how, train, held, bar.update)


def card(trained: Trained, how: TrainCfg, train: Set, held: Set) -> dict[str, Any]:
    """What goes beside the weights.

    Args:
        trained: The training's result.
        how: It was trained; of no meaning to a linear model.
        train: It learned from.
        held: It was chosen by.

    Returns:
        Ready for JSON.
    """
    return {
        "command": shlex.join(["python", "-m", *_module(), *sys.argv[1:]]),
        "git_commit": commit(),
        "data_sha256": digest((*train.beads, *held.beads)),
        "beads": {
            "train": [f"{b.path}/{b.draw}" for b in train.beads],
            "held_out": [f"{b.path}/{b.draw}" for b in held.beads],
        },
        "train": None if trained.model.cfg.kind == "linear" else asdict(how) | {"learning_rate": how.rate},
        "held_out_mse": trained.held_out,
        "stack": versions(_STACK),
    }


def _module() -> list[str]:
    name = Path(sys.argv[0])
    return [f"{name.parent.name}.{name.stem}"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Trains one surrogate and writes it.

    Args:
        arguments: Of the command, by default the process's.

    Returns:
        The exit status: 2 if it could not be done.
    """
    parser = argparse.ArgumentParser(
        prog="python -m agents.train_surrogate", description="Trains one cross-section surrogate."
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of `experiments.laydown runs`")
    parser.add_argument("--out", type=Path, required=True, help="NAME.safetensors, with a card NAME.json")
    parser.add_argument("--kind", choices=KINDS, default="mlp_cnn", help="(default: %(default)s)")
    parser.add_argument("--neighbours", type=int, default=4, help="N_m, even (default: %(default)s)")
    parser.add_argument("--on-fan", action="store_true", help="predict what to add to the fast tier")
    parser.add_argument("--optimiser", choices=OPTIMISERS, default="adamw", help="(default: %(default)s)")
    parser.add_argument("--epochs", type=int, default=14, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of weights and batches (default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        cfg = SurrogateCfg(kind=options.kind, neighbours=options.neighbours, on_fan=options.on_fan)
        how = TrainCfg(optimiser=options.optimiser, epochs=options.epochs, seed=options.seed)
        beads = split(read_beads(options.data))
        train, held = (prepared(b, cfg.neighbours) for b in beads[:2])
        trained = fit(cfg, how, train, held)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        save_surrogate(trained.model, options.out, card(trained, how, train, held))
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    print(f"{options.out}: held-out mean square error {trained.held_out:.5f}, {trained.wall_s:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
