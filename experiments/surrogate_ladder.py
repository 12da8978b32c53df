"""The ladder of surrogates: what is trained, how each is judged on the obstacle course, what is shipped."""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.surrogate_data import Bead, Set, digest, prepared
from agents.train_surrogate import TrainCfg, Trained, card, fit
from experiments import surrogate_metrics as metrics
from seal_gym.core.frames import Array
from seal_gym.sealant.fan_section import fan_sections
from seal_gym.sealant.surrogate import Surrogate, SurrogateCfg, features, load_surrogate, save_surrogate

SHIPPED = {"linear": "surrogate_linear.safetensors", "best": "surrogate.safetensors"}
STATION, PATH = "fast tier, one station", "fast tier, along the path"
REFERENCE, LINEAR = "reference itself", "linear glass box"
_REPEATS, _TIMES = 50, 3
_SPREAD = ("iou", "area_error_pct")
# what only models that learn have, in the order of the table
_LEARNED = ["single_ms", "parameters", "held_out_mse", "training_seed", "train_s"]
_LEARNED += [f"{key}_seeds" for key in _SPREAD]

Row = dict[str, Any]


@dataclass(frozen=True)
class Rung:
    """A model of the ladder that learns.

    Attributes:
        name: For people.
        cfg: What it is.
        optimiser: That trains it; None for what is solved.
    """

    name: str
    cfg: SurrogateCfg
    optimiser: str | None = None


def _ladder() -> tuple[Rung, ...]:
    def net(**kinds: Any) -> SurrogateCfg:
        return SurrogateCfg(kind="mlp_cnn", **kinds)

    return (
        Rung(LINEAR, SurrogateCfg(kind="linear")),
        Rung("linear, N_m = 4", SurrogateCfg(kind="linear", neighbours=4)),
        Rung("MLP-CNN, SGD", net(), "sgd"),
        Rung("MLP-CNN, AdamW", net(), "adamw"),
        Rung("MLP-CNN, N_m = 4, AdamW", net(neighbours=4), "adamw"),
        Rung("fast tier + linear", SurrogateCfg(kind="linear", on_fan=True)),
        Rung("fast tier + MLP-CNN, SGD", net(on_fan=True), "sgd"),
        Rung("fast tier + MLP-CNN, AdamW", net(on_fan=True), "adamw"),
        Rung("fast tier + MLP-CNN, N_m = 4, AdamW", net(on_fan=True, neighbours=4), "adamw"),
    )


LADDER = _ladder()


@dataclass(frozen=True)
class Judged:
    """A model on the obstacle course.

    Attributes:
        name: Of the model.
        images: Its sections, bead after bead.
        trials: Its scores, one a bead.
        row: Of the table.
    """

    name: str
    images: tuple[Array, ...]
    trials: tuple[Row, ...]
    row: Row


def judged(name: str, predict: Callable[[Bead], Array], beads: list[Bead], **more: Any) -> Judged:
    """Judges a model.

    Args:
        name: Of the model.
        predict: Gives the sections of a bead.
        beads: Of the obstacle course.
        **more: Further entries of the row.

    Returns:
        What it is worth; ``bead_ms`` is what a section costs when whole beads are predicted, each in
        its best of some tries.
    """
    predict(beads[0])  # what is compiled is compiled now
    images, cost = [], 0.0
    for bead in beads:
        times = []
        for _ in range(_TIMES):
            begin = time.perf_counter()
            found = predict(bead)
            times.append(time.perf_counter() - begin)
        images.append(found)
        cost += 1e3 * min(times)
    cost /= sum(len(i) for i in images)
    trials = tuple(metrics.scores(i, b) for i, b in zip(images, beads, strict=True))
    row: Row = {"model": name, **metrics.summary(list(trials)), "bead_ms": cost}
    return Judged(name, tuple(images), trials, row | dict.fromkeys(_LEARNED) | more)


def single_ms(model: Surrogate, bead: Bead) -> float:
    """What one section costs alone: the smallest of some tries.

    Args:
        model: To try.
        bead: From whose middle a section is predicted, its features given.

    Returns:
        The time [ms].
    """
    row = len(bead.arcs_m) // 2
    inputs = features(bead, model.cfg.neighbours).rows(slice(row, row + 1))
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        model.sections(inputs)
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def judged_model(name: str, model: Surrogate, beads: list[Bead], **more: Any) -> Judged:
    """Judges a surrogate, see ``judged``.

    Args:
        name: Of the model.
        model: With its weights.
        beads: Of the obstacle course.
        **more: Further entries of the row.

    Returns:
        What it is worth.
    """
    more = {"single_ms": single_ms(model, beads[0]), "parameters": model.parameters} | more
    return judged(name, model.predict, beads, **more)


def baselines(beads: list[Bead], train: list[Bead]) -> list[Judged]:
    """Models that learn nothing, and the reference itself, whose area is not flow / speed either.

    Args:
        beads: Of the obstacle course.
        train: Training beads for the mean section; without any there is none.

    Returns:
        Judged.
    """

    def station(bead: Bead) -> Array:
        return fan_sections(bead.linear_mps, bead.angular_radps, bead.heights_m)

    out = [judged(REFERENCE, lambda b: b.images, beads)]
    if train:
        mean = np.concatenate([b.images for b in train]).mean(0)
        out.append(judged("mean section", lambda b: np.tile(mean, (len(b.images), 1, 1)), beads))
    out.append(judged(STATION, station, beads))
    out.append(judged(PATH, lambda b: features(b).fan(), beads))
    return out


def trained(
    rung: Rung, train: list[Bead], held: list[Bead], options: argparse.Namespace
) -> Iterator[tuple[TrainCfg, Trained, Set, Set]]:
    """Trains a rung with each training seed.

    Args:
        rung: What to train.
        train: To learn from.
        held: To choose by.
        options: With ``seed``, ``seeds``, ``epochs``.

    Yields:
        How it was trained, the result, and what it learned from and was chosen by.
    """
    data, kept = prepared(train, rung.cfg.neighbours), prepared(held, rung.cfg.neighbours)
    for seed in range(options.seed, options.seed + (options.seeds if rung.optimiser else 1)):
        how = TrainCfg(optimiser=rung.optimiser or "adamw", seed=seed, epochs=options.epochs)
        yield how, fit(rung.cfg, how, data, kept, f"{rung.name}, seed {seed}"), data, kept


def learn(
    train: list[Bead], held: list[Bead], beads: list[Bead], options: argparse.Namespace
) -> tuple[list[Judged], dict[str, Surrogate], dict[str, tuple[tuple[float, float], ...]]]:
    """Trains and judges the ladder; writes the linear model and the best one.

    Args:
        train: To learn from.
        held: To choose by.
        beads: Of the obstacle course.
        options: Of the command.

    Returns:
        Judged models, ``"linear"`` and ``"best"``, and the learning curves by name.
    """
    out, models, curves, smallest = [], {}, {}, np.inf
    for rung in LADDER:
        tries = list(trained(rung, train, held, options))
        how, best, data, kept = min(tries, key=lambda t: t[1].held_out)
        seeds = [judged_model(rung.name, t[1].model, beads).row for t in tries]
        more: Row = {f"{key}_seeds": [row[key] for row in seeds] for key in _SPREAD}
        more |= {"held_out_mse": best.held_out, "training_seed": how.seed if rung.optimiser else None}
        found = judged_model(rung.name, best.model, beads, train_s=best.wall_s, **more)
        out.append(found)
        if rung.optimiser:
            curves[rung.name] = best.history
        about = card(best, how, data, kept) | {"model": rung.name}
        scores = {key: found.row[key] for key in metrics.KEYS}
        about |= {"obstacle_course": scores, "obstacle_course_sha256": digest(beads)}
        if rung.name == LINEAR:
            models["linear"] = best.model
            save_surrogate(best.model, options.save / SHIPPED["linear"], about)
        if best.held_out < smallest:
            smallest, models["best"] = best.held_out, best.model
            save_surrogate(best.model, options.save / SHIPPED["best"], about)
    return out, models, curves


def shipped(beads: list[Bead], folder: Path) -> tuple[list[Judged], dict[str, Surrogate]]:
    """Judges weights that were trained before.

    Args:
        beads: Of the obstacle course.
        folder: Of the weights.

    Returns:
        Judged models, and ``"linear"`` and ``"best"``.
    """
    models = {key: load_surrogate(folder / file) for key, file in SHIPPED.items()}
    names = {key: str(model.card.get("model", key)) for key, model in models.items()}
    rows = [
        judged_model(names[key], model, beads, held_out_mse=model.card.get("held_out_mse"))
        for key, model in models.items()
    ]
    return rows, models


def claims(judged_models: list[Judged], best: str) -> list[Row]:
    """Whether the best model beats the fast tier and the linear one, bead by bead.

    Args:
        judged_models: All.
        best: Name of the best by held-out error.

    Returns:
        Paired differences in IoU and area error with intervals over beads.
    """
    by_name = {j.name: j for j in judged_models}
    rows = []
    for other in (STATION, PATH, LINEAR):
        for key in ("iou", "area_error_pct"):
            mean, interval = metrics.difference(list(by_name[best].trials), list(by_name[other].trials), key)
            rows.append({"model": best, "against": other, "metric": key, "difference": mean, "ci": interval})
    return rows


def reading(model: Surrogate) -> list[Row]:
    """What the glass box says of each input.

    Args:
        model: Linear.

    Returns:
        Effects of one standard deviation of the training data more, see ``surrogate_metrics.effects``.
    """
    net = model.net
    weights = net.glass.weight.detach().numpy().astype(float).T.reshape(-1, 20, 40)
    bias = net.glass.bias.detach().numpy().astype(float).reshape(20, 40)
    scale = np.concatenate((net.kinematic_scale.numpy(), net.spatial_scale.numpy())).astype(float)
    names = [f"{kind}_{axis}" for kind in ("v", "omega", "g") for axis in "xyz"]
    units = ["m/s"] * 3 + ["rad/s"] * 3 + ["m/s2"] * 3
    rows = metrics.effects(weights, np.clip(bias, 0.0, 1.0))
    places = [*names, *(f"h({k - 20:+d} mm)" for k in range(41))]
    return [
        {"input": name, "one_sd": float(s), "unit": u, **row}
        for name, u, s, row in zip(places, [*units, *["m"] * 41], scale, rows, strict=True)
    ]
