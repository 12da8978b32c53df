"""Surrogates of laydown simulations, from the mean picture to networks, on an unseen obstacle course.

    python -m experiments.surrogate --data DIR --out experiments/results --save agents/weights
    python -m experiments.surrogate --weights agents/weights --data experiments/data/obstacle_course

Each model predicts the cross-section of a bead, 1 mm after 1 mm, from what is known along the tip's path
(Berg 3.2). The first command trains all of them on ``DIR``, which ``python -m experiments.laydown runs``
made, and writes the linear model and the one with the smallest error on held-out centre paths to ``--save``.
The second repeats their rows from the committed weights and data. Both write surrogate.json, .csv, .md and
pictures: the ladder, the linear model's weights and examples with the worst one; the first the learning
curves too.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from agents.surrogate_data import Bead, digest, read_beads, split
from experiments import command, results, surrogate_figures
from experiments import surrogate_ladder as ladder
from experiments import surrogate_metrics as metrics
from experiments.surrogate_ladder import Judged
from seal_gym.core.errors import require
from seal_gym.sealant.laydown import sections
from seal_gym.sealant.laydown.paths import TRAINING, VALIDATION

NAME = "surrogate"
_DATA = Path(__file__).resolve().parent / "data" / "obstacle_course"
_WORDS = {
    "v_x": "speed to the right",
    "v_y": "speed across the fan",
    "v_z": "speed away from the part",
    "omega_x": "nodding",
    "omega_y": "rolling",
    "omega_z": "turning left",
    "g_x": "gravity to the right",
    "g_y": "gravity ahead",
    "g_z": "gravity back along the nozzle",
}

_EFFECTS = {
    "area_mm2": ("area", "mm²"),
    "height_mm": ("thickness where it is thickest", "mm"),
    "right_mm": ("place across, to the right,", "mm"),
    "up_mm": ("place along the nozzle, up,", "mm"),
    "slope_deg": ("slope, up to the right,", "deg"),
}

Row = dict[str, Any]


def markdown(rows: list[Row]) -> str:
    """The ladder for people.

    Args:
        rows: Of ``Judged``.

    Returns:
        Markdown.
    """
    head = ["model", "IoU", "area error %", "area to Q/v %", "MSE", "width mm", "height mm", "contour mm"]
    head += ["held-out MSE", "IoU of seeds", "ms in a bead", "ms alone"]

    def seeds(row: Row) -> str:
        found = row.get("iou_seeds") or []
        return f"{min(found):.3f} to {max(found):.3f}" if len(found) > 1 else "-"

    body = [
        [
            r["model"],
            results.with_interval(r, "iou", 3),
            results.with_interval(r, "area_error_pct", 1),
            results.number(r["ideal_error_pct"], 1),
            results.with_interval(r, "mse", 4),
            results.number(r["width_error_mm"], 2),
            results.number(r["height_error_mm"], 2),
            results.number(r["contour_mm"], 2),
            results.number(r["held_out_mse"], 4),
            seeds(r),
            results.number(r["bead_ms"], 3),
            results.number(r["single_ms"], 2),
        ]
        for r in rows
    ]
    return results.grid(head, body)


def told(rows: list[Row]) -> list[tuple[str, Row]]:
    """The glass box's inputs as people think of them.

    Args:
        rows: From ``ladder.reading``.

    Returns:
        Name and effects of each input of motion, then of all heights, those to the left and to the right.
    """
    named = [
        (f"{_WORDS[r['input']]} ({r['input']}, +{r['one_sd']:.2g} {r['unit']})", r)
        for r in rows
        if r["input"] in _WORDS
    ]
    heights = [r for r in rows if r["input"] not in _WORDS]
    left, right = heights[: len(heights) // 2], heights[len(heights) // 2 + 1 :]
    for title, chosen in (
        ("all heights", heights),
        ("heights to the left", left),
        ("heights to the right", right),
    ):
        mean = 1e3 * float(np.mean([r["one_sd"] for r in chosen]))
        total = {k: sum(r[k] for r in chosen) for k in _EFFECTS}
        named.append((f"{title} (+{mean:.1f} mm)", total))
    return named


def words(rows: list[Row]) -> str:
    """The glass box's reading in words.

    Args:
        rows: From ``ladder.reading``.

    Returns:
        What matters most to each property of the bead, and a table.
    """
    named = told(rows)
    lines = []
    for key, (what, unit) in _EFFECTS.items():
        name, row = max(named, key=lambda n: abs(n[1][key]))
        lines.append(f"- {what} depends most on {name}: {row[key]:+.2f} {unit}.")
    head = ["one deviation more of", *(f"{what} {unit}" for what, unit in _EFFECTS.values())]
    body = [[name, *(f"{row[key]:+.2f}" for key in _EFFECTS)] for name, row in named]
    return "\n".join(lines) + "\n\n" + results.grid(head, body)


def text(found: list[Judged], compared: list[Row], glass: list[Row], data: Row) -> str:
    """The report.

    Args:
        found: All models.
        compared: From ``ladder.claims``.
        glass: From ``ladder.reading``.
        data: Counts of beads and centre paths.

    Returns:
        Markdown.
    """
    missing = ", ".join(data["missing"])
    lines = [
        f"Obstacle course: {data['course'][0]} beads around {data['course'][1]} of {len(VALIDATION)} unseen "
        "centre paths; "
        + (
            f"learned from {data['train'][0]} beads around {data['train'][1]} of {len(TRAINING)}, "
            f"{data['held'][0]} beads around {data['held'][1]} more held out to stop and choose by."
            if data["train"][0]
            else "weights of an earlier training."
        )
        + (f" Without data, and so left out: {missing}." if missing else ""),
        "",
        "Means over beads with bootstrap 95 % intervals over beads (draws around one centre path share its "
        "shape). IoU of what is more than half full; errors of areas as shares of the mean area; Q/v is flow "
        "over speed across the window, away from the bead's ends; times on one core.",
        "",
        markdown([j.row for j in found]),
        "",
        f"Bead by bead, {compared[0]['model']} against:",
        "",
    ]
    for r in compared:
        unit, digits = ("", 3) if r["metric"] == "iou" else (" points", 1)
        label = "IoU" if r["metric"] == "iou" else "area error"
        span = f" [{r['ci'][0]:+.{digits}f}, {r['ci'][1]:+.{digits}f}]" if r["ci"] else ""
        lines.append(f"- {r['against']}: {label} {r['difference']:+.{digits}f}{unit}{span}")
    lines += [
        "",
        "The linear glass box, one standard deviation of the training data more of:",
        "",
        words(glass),
    ]
    return "\n".join(lines)


def examples(
    found: dict[str, Judged], names: list[str], beads: list[Bead]
) -> list[tuple[str, list[np.ndarray[Any, Any]]]]:
    """Sections to show: the middle one of a bead around each centre path, and the worst.

    Args:
        found: Judged models by name.
        names: Of those to show; the last one decides what is worst.
        beads: Of the obstacle course.

    Returns:
        Titles, and sections of the reference and the models.
    """
    best = found[names[-1]]
    places = sorted({b.path for b in beads})
    chosen = []
    for place in places:
        k = next(k for k, b in enumerate(beads) if b.path == place)
        chosen.append((k, len(beads[k].images) // 2, ""))
    overlap = [sections.iou(i, b.images) for i, b in zip(best.images, beads, strict=True)]
    inner = [np.where(metrics.inner(b), o, 1.0) for o, b in zip(overlap, beads, strict=True)]
    for mark, values in (("worst: ", overlap), ("worst but for ends: ", inner)):
        k = min(range(len(beads)), key=lambda k: float(values[k].min()))
        chosen.append((k, int(values[k].argmin()), mark))
    out = []
    for k, row, mark in chosen:
        title = f"{mark}{beads[k].path.replace('_', ' ')}, {1e3 * beads[k].arcs_m[row]:.0f} mm"
        out.append((title, [beads[k].images[row], *(found[n].images[k][row] for n in names)]))
    return out


def counts(train: list[Bead], held: list[Bead], course: list[Bead]) -> Row:
    """Beads and centre paths of each part of the data.

    Args:
        train: To learn from.
        held: Held out.
        course: The obstacle course.

    Returns:
        Counts, and the centre paths that have no beads.
    """
    parts = {"train": train, "held": held, "course": course}
    there = {b.path for part in parts.values() for b in part}
    wanted = VALIDATION if not train else TRAINING + VALIDATION
    row: Row = {key: (len(part), len({b.path for b in part})) for key, part in parts.items()}
    return row | {"missing": [p.name for p in wanted if p.name not in there]}


def work(options: argparse.Namespace) -> str:
    """Trains or loads, judges, writes.

    Args:
        options: Of the command line.

    Returns:
        The report.
    """
    beads = read_beads(options.data)
    course = [b for b in beads if b.path in {p.name for p in VALIDATION}]
    require(bool(course), f"{options.data} holds no bead of the obstacle course")
    train: list[Bead] = []
    held: list[Bead] = []
    curves: dict[str, tuple[tuple[float, float], ...]] = {}
    if options.weights is None:
        train, held, _ = split(beads)
        options.save.mkdir(parents=True, exist_ok=True)
    found = ladder.baselines(course, train)
    if options.weights is None:
        learned, models, curves = ladder.learn(train, held, course, options)
    else:
        learned, models = ladder.shipped(course, options.weights)
    found += learned
    known = [j for j in learned if j.row["held_out_mse"] is not None]
    best = min(known, key=lambda j: float(j.row["held_out_mse"])).name
    compared, glass = ladder.claims(found, best), ladder.reading(models["linear"])
    data = counts(train, held, course)
    report = text(found, compared, glass, data)
    by_name = {j.name: j for j in found}
    trials = [{"model": j.name, **t} for j in found for t in j.trials]
    more = {"data": data, "data_sha256": digest(beads), "compared": compared, "glass_box": glass}
    results.write(
        options.out,
        NAME,
        [j.row for j in found],
        trials,
        renderer="none",
        regime="static",
        text=report,
        more=more,
    )
    surrogate_figures.ladder(options.out / "surrogate_ladder.png", [j.row for j in found])
    surrogate_figures.glass_box(options.out / "surrogate_linear.png", models["linear"])
    shown = [ladder.PATH, ladder.LINEAR, best]
    surrogate_figures.examples(
        options.out / "surrogate_examples.png", examples(by_name, shown, course), ["reference", *shown]
    )
    if curves:
        surrogate_figures.curves(options.out / "surrogate_curves.png", curves)
    return report


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.surrogate", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--data", type=Path, default=_DATA, help="folder of simulated beads (default: the committed ones)"
    )
    parser.add_argument(
        "--weights", type=Path, help="judge the weights of this folder (agents/weights) and train nothing"
    )
    parser.add_argument(
        "--save", type=Path, help="folder for what is trained (default: OUT/weights; shipped: agents/weights)"
    )
    parser.add_argument("--epochs", type=int, default=14, help="of each network (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="first training seed (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=1, help="training seeds (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    options = command.checked(parser, arguments, epochs=1, seed=0, seeds=1)
    options.save = options.save or options.out / "weights"
    return options


def main(arguments: list[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status, see ``command.run``.
    """
    options = parse(arguments)
    return command.run(lambda: work(options), options.out)


if __name__ == "__main__":
    sys.exit(main())
