"""Finds the best settings of each edge method on validation frames.

    python -m experiments.tune_edges --seed 500000 --frames 200 --out experiments/results

Every method gets the same effort: settings drawn at random from its choices, then each parameter of the best
one in turn through all its choices. Half the frames choose; the table's errors are those of the other half.
The settings for frames as in a run are the defaults in ``seal_gym.vision.baselines``; those for much noise
tell what a method can do there.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments import command, edge_tables
from experiments.edge_tables import Log, Row
from experiments.seam_frames import (
    FIRST_SEED,
    STAGES,
    VIEWS,
    LineErrors,
    SeamFrames,
    accuracy,
    check_seeds,
    draw,
    joined,
    lines_of,
    loss,
    stage_errors,
    subset,
)
from seal_gym.core.errors import SealGymError
from seal_gym.vision.baselines import (
    CannyCfg,
    CannyEdges,
    LsdCfg,
    LsdEdges,
    SobelCfg,
    SobelEdges,
)
from seal_gym.vision.edges import EdgeCfg, EdgeDetector, EdgeStage
from seal_gym.workpieces.catalogue import NAMES

_SHARES = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.16, 0.2, 0.3)
_SIGMAS = (0.0, 0.7, 1.0, 1.4, 2.0, 2.8)
_TAUS = tuple(round(0.05 * k, 2) for k in range(4, 18))
# Weights of magnitude, direction and contrast, summing to 1, so that tau means the same for all.
WEIGHTS = {
    "a+b+c": (0.6, 0.3, 0.1),
    "a": (1.0, 0.0, 0.0),
    "a+b": (0.7, 0.3, 0.0),
    "a+c": (0.8, 0.0, 0.2),
    "a+b+c, more a": (0.8, 0.1, 0.1),
    "a+b+c, more b": (0.4, 0.5, 0.1),
}
ALPHAS, LENGTHS, OUR_SHARES = (0.3, 0.5, 0.7, 1.0), (3, 5, 7), (0.03, 0.05, 0.1, 0.25, 0.5)
# The sensors' signal-to-noise ratio that settings are chosen for; None: as in a run.
CONDITIONS: dict[str, float | None] = {"run": None, "2 dB": 2.0}


@dataclass(frozen=True, kw_only=True)
class Method:
    """What may be chosen for a method.

    Attributes:
        usual: Settings of textbooks or of the implementation, which are tried as well.
        choices: Values of each parameter.
        make: The detector of a choice.
    """

    usual: Row
    choices: dict[str, tuple[Any, ...]]
    make: Callable[[Row], EdgeDetector]


def ours(row: Row) -> EdgeDetector:
    """Our stage.

    Args:
        row: Settings.

    Returns:
        The detector.
    """
    return EdgeStage(EdgeCfg(**shown(row)))


_OURS: Row = {"alpha": 0.5, "length": 3, "tau": 0.5, "share": 0.25}

METHODS = {
    "ours": Method(
        usual={"weights": "a+b+c", **_OURS},
        choices={
            "weights": tuple(WEIGHTS),
            "alpha": ALPHAS,
            "length": LENGTHS,
            "tau": _TAUS,
            "share": OUR_SHARES,
        },
        make=ours,
    ),
    "canny": Method(
        usual={"sigma_px": 1.4, "share": 0.1, "ratio": 0.4},
        choices={"sigma_px": _SIGMAS, "share": _SHARES, "ratio": (0.2, 0.4, 0.6, 0.8, 1.0)},
        make=lambda row: CannyEdges(CannyCfg(**row)),
    ),
    "sobel": Method(
        usual={"sigma_px": 0.0, "share": 0.1},
        choices={"sigma_px": (0.0,), "share": _SHARES},
        make=lambda row: SobelEdges(SobelCfg(**row)),
    ),
    "sobel_blurred": Method(
        usual={"sigma_px": 1.4, "share": 0.1},
        choices={"sigma_px": _SIGMAS[1:], "share": _SHARES},
        make=lambda row: SobelEdges(SobelCfg(**row)),
    ),
    "lsd": Method(
        usual={
            "sigma_px": 0.0,
            "scale": 0.8,
            "sigma_scale": 0.6,
            "quant": 2.0,
            "angle_deg": 22.5,
            "density": 0.7,
            "refine": "standard",
            "min_length_px": 5.0,
        },
        choices={
            "sigma_px": (0.0, 0.7, 1.0, 1.4, 2.0),
            "scale": (0.5, 0.8, 1.0),
            "sigma_scale": (0.6, 1.0),
            "quant": (1.0, 2.0, 4.0),
            "angle_deg": (15.0, 22.5, 30.0, 45.0),
            "density": (0.3, 0.5, 0.7),
            "refine": ("none", "standard", "advanced"),
            "min_length_px": (5.0, 10.0, 15.0),
        },
        make=lambda row: LsdEdges(LsdCfg(**row)),
    ),
}


def shown(settings: Row) -> Row:
    """Settings as the configurations name them.

    Args:
        settings: As drawn.

    Returns:
        With a, b and c for ``weights``.
    """
    out = dict(settings)
    if "weights" in out:
        out |= dict(zip("abc", WEIGHTS[out.pop("weights")], strict=True))
    return out


def measure(frames: list[SeamFrames], detector: EdgeDetector) -> dict[tuple[str, str, str], LineErrors]:
    """A method's errors.

    Args:
        frames: Of each part.
        detector: The method.

    Returns:
        Errors by part, view and stage.
    """
    out = {}
    for f in frames:
        for v, found in enumerate(lines_of(f, detector)):
            for stage, e in stage_errors(found, f.truth[:, v], f.views.reference[v, 1]).items():
                out[f.part, VIEWS[v], stage] = e
    return out


def figures(found: dict[tuple[str, str, str], LineErrors]) -> Row:
    """Columns of a table from a method's errors.

    Args:
        found: From ``measure``.

    Returns:
        Losses and errors of all frames before and after the refinement, and the score that chooses.
    """
    row: Row = {}
    for stage in STAGES:
        e = joined([e for (_, _, s), e in found.items() if s == stage])
        row |= {f"{stage}_{k}": v for k, v in accuracy(e).items() if k not in ("frames", "failed_ci")}
    row["score"] = float(np.mean([loss(e) for e in found.values()]))
    return row


def search(
    method: Method, evaluate: Callable[[Row], float], budget: int, rng: np.random.Generator
) -> tuple[Row, int]:
    """The best settings of a method.

    Args:
        method: Its choices.
        evaluate: The score of settings, the lower the better.
        budget: How many random settings; all there are, if these are fewer.
        rng: Draws them.

    Returns:
        The settings, and how many were tried.
    """
    sizes = [len(v) for v in method.choices.values()]
    total = int(np.prod(sizes))
    numbers = rng.permutation(total)[: min(budget, total)]
    tried: list[Row] = [method.usual]
    for number in numbers:
        index = np.unravel_index(number, sizes)
        tried.append({k: v[i] for (k, v), i in zip(method.choices.items(), index, strict=True)})
    scores = [evaluate(row) for row in tried]
    best = int(np.argmin(scores))
    chosen, least = tried[best], scores[best]
    for name, values in method.choices.items():
        for value in values:
            row = {**chosen, name: value}
            if row in tried:
                continue
            tried.append(row)
            score = evaluate(row)
            if score < least:
                chosen, least = row, score
    return chosen, len(tried)


def ablation() -> list[tuple[str, Row]]:
    """Variants of our stage, of which all but tau is fixed.

    Returns:
        What is varied, and the settings.
    """
    base = {"weights": "a+b+c", **_OURS}
    out = [(f"terms {w}", {**base, "weights": w}) for w in ("a", "a+b", "a+c", "a+b+c")]
    out += [(f"alpha {a:g}", {**base, "alpha": a}) for a in ALPHAS]
    out += [(f"L {length}", {**base, "length": length}) for length in LENGTHS]
    out += [(f"share {share:g}", {**base, "share": share}) for share in OUR_SHARES]
    return out


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.tune_edges", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first frame")
    parser.add_argument("--frames", type=int, default=200, help="a part, half to choose by, half to report")
    parser.add_argument("--settings", type=int, default=48, help="random settings of a method")
    parser.add_argument("--method", action="append", choices=sorted(METHODS), help="default: all")
    parser.add_argument("--out", type=Path, default=Path("out/tune_edges"), help="folder")
    options = command.checked(parser, arguments, frames=2, settings=1)
    try:
        check_seeds(options.seed, options.frames)
    except SealGymError as error:
        parser.error(str(error))
    return options


def _page(options: argparse.Namespace, rows: list[Row]) -> str:
    columns = {
        "score": "score",
        "raw_offset_px": "raw px",
        "raw_angle_deg": "raw deg",
        "raw_failed_pct": "raw failed %",
        "refined_offset_px": "refined px",
        "refined_angle_deg": "refined deg",
        "refined_failed_pct": "refined failed %",
    }
    first = {"method": "method", "which": "settings are", "settings": "settings", "tried": "tried"}
    ours_first = {"which": "varied", "settings": "settings"}
    varied = [r for r in rows if r["table"] == "ablation"]
    parts = [
        "# Settings of the edge methods",
        f"{options.frames} frames of each part from seed {options.seed} on, two views each; half chose, the "
        "errors are those of the other half. Medians of the offset from the true line at the tip and of the "
        "angle; failed: no line, or more than 3 px or 10 deg off. Raw: RANSAC's line through the whole ROI; "
        "refined: sub-pixel edges and a local curve. The score that chose is the mean over parts, views and "
        "both stages of min(offset / 3 px, 1) and min(angle / 10 deg, 1).",
    ]
    for condition in CONDITIONS:
        chosen = [r for r in rows if r["table"] == "methods" and r["condition"] == condition]
        title = (
            "As in a run" if condition == "run" else f"With so much noise that the ROI's SNR is {condition}"
        )
        parts += [f"## {title}", edge_tables.markdown(chosen, first | columns)]
    if varied:
        parts += [
            "## Our stage, varied",
            "As in a run, from the usual settings, one thing at a time; tau is chosen anew for each row on "
            "the choosing half, with weights that sum to 1.",
            edge_tables.markdown(varied, ours_first | columns),
        ]
    return "\n\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the search.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    log = Log(options.out / "tune_edges.trials.jsonl")
    odd = np.arange(options.frames) % 2 == 1
    halves = {}
    for condition, level in CONDITIONS.items():
        frames = [draw(part, options.frames, options.seed, snr_db=level) for part in NAMES]
        halves[condition, "choose"] = [subset(f, ~odd) for f in frames]
        halves[condition, "report"] = [subset(f, odd) for f in frames]
    bar = tqdm(desc="settings", unit="setting")

    def result(name: str, settings: Row, condition: str, half: str) -> Row:
        what = {"method": name, "settings": settings, "condition": condition, "half": half}

        def make() -> list[Row]:
            return [figures(measure(halves[condition, half], METHODS[name].make(settings)))]

        bar.update()
        return log.get({**what, "n": options.frames, "seed": options.seed}, make)[0]

    def row(table: str, name: str, which: str, settings: Row, condition: str, tried: int) -> Row:
        head = {"table": table, "condition": condition, "method": name, "which": which}
        found = result(name, settings, condition, "report")
        return {**head, "settings": shown(settings), "tried": tried, **found}

    rows: list[Row] = []
    for condition in CONDITIONS:
        for name in options.method or METHODS:

            def score(settings: Row, name: str = name, condition: str = condition) -> float:
                return float(result(name, settings, condition, "choose")["score"])

            method = METHODS[name]
            best, tried = search(method, score, options.settings, np.random.default_rng(options.seed))
            rows.append(row("methods", name, "usual", method.usual, condition, tried))
            rows.append(row("methods", name, "best", best, condition, tried))
    if "ours" in (options.method or METHODS):
        for what, settings in ablation():
            taus = [{**settings, "tau": tau} for tau in _TAUS]
            best = min(taus, key=lambda s: result("ours", s, "run", "choose")["score"])
            rows.append(row("ablation", "ours", what, best, "run", len(taus)))
    bar.close()
    document = {"seed0": options.seed, "frames_per_part": options.frames}
    page = _page(options, rows)
    edge_tables.write(options.out, "tune_edges", edge_tables.command_line(arguments), rows, document, page)
    sys.stdout.write(page + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
