"""The Hopfield palette observer: what its networks recall, and how well it sees in changing light and noise.

    python -m experiments.observer --trials 12 --seed 500000 --jobs 2 --out experiments/results

After Carvajal and Martinez-Garcia, section IV, Figs. 4 and 6. Every method sees the same drawn palettes in
the same lights, and shares all that follows the naming of pixels. Writes observer.json, .csv, .md and three
figures.
"""

import argparse
import sys
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from tqdm import tqdm

from agents import engines
from experiments import command, observer_figures, palette_methods, palette_pictures, results
from experiments.palette_pictures import CAMERA, LightCfg, Palette
from seal_gym.core.frames import Array
from seal_gym.vision import hopfield, palette_segments
from seal_gym.vision.hopfield import TABLE_1, TABLE_2, HebbReading
from seal_gym.vision.palette_regions import Fault, PaletteReport, RegionCfg, report_on
from seal_gym.vision.palette_segments import PaletteClass

NAME = "observer"
NOMINAL = LightCfg(noise=4.0)
SWEEPS: dict[str, tuple[float, ...]] = {
    "level": (0.3, 0.5, 0.7, 1.0, 1.3, 1.6),
    "contrast": (0.3, 0.5, 0.75, 1.0),
    "slope": (0.0, 0.3, 0.6),
    "noise": (4.0, 8.0, 16.0, 32.0, 48.0),
}
ELEMENTS = (
    PaletteClass.CABLE,
    PaletteClass.CONNECTOR,
    PaletteClass.RIVET,
    PaletteClass.TARGET,
    PaletteClass.TIE,
)
ALL, STRANGER, MISSING = "all", "stranger", "missing tie"
WHATS = (*(k.name.lower() for k in ELEMENTS), STRANGER, MISSING, ALL)
# A region is an element if its centroid is this near the element's; half a rivet is 7.7 px.
_NEAR_PX = {PaletteClass.CABLE: 15.0}
_NEAR_DEFAULT_PX = 6.0

Row = dict[str, Any]


def lights() -> dict[str, LightCfg]:
    """Lights by name: the nominal one, and one of its values changed at a time.

    Returns:
        Without doubles.
    """
    found = {"nominal": NOMINAL}
    for name, values in SWEEPS.items():
        for value in values:
            if value != getattr(NOMINAL, name):
                found[f"{name} {value:g}"] = LightCfg(**{**vars(NOMINAL), name: value})
    return found


def matched(truth_px: Array, seen_px: Array, near_px: float) -> list[tuple[int, int]]:
    """One-to-one pairs of elements and regions, least total distance, none farther than allowed.

    Args:
        truth_px: Shape (n, 2), px.
        seen_px: Shape (m, 2), px.
        near_px: Largest distance [px].

    Returns:
        Pairs of indices.
    """
    away = np.linalg.norm(truth_px[:, None] - seen_px[None], axis=2)
    pairs = zip(*linear_sum_assignment(np.minimum(away, 2 * near_px)), strict=True)
    return [(int(i), int(j)) for i, j in pairs if away[i, j] <= near_px]


def judged(report: PaletteReport, palette: Palette) -> dict[str, Array]:
    """What a report got right.

    Args:
        report: It.
        palette: The truth.

    Returns:
        By class and fault: elements, regions, pairs, missed elements that lie in a region of a fault, sums of
        the pairs' distances in px and in mm.
    """
    flagged = np.isin(report.labels, 1 + report.of(PaletteClass.UNKNOWN))
    open_regions = [f.region for f in report.faults if f.kind is Fault.MISSING_TIE]
    names = {k.name.lower(): k for k in ELEMENTS} | {STRANGER: PaletteClass.UNKNOWN}
    sets = {
        name: (np.flatnonzero(palette.classes == k), report.of(k), _NEAR_PX.get(k, _NEAR_DEFAULT_PX))
        for name, k in names.items()
    }
    sets[MISSING] = (palette.open_targets, np.array(open_regions, dtype=np.intp), _NEAR_DEFAULT_PX)
    out = {}
    for name, (truth, seen, near) in sets.items():
        pairs = matched(palette.centroids_px[truth], report.centroids_px[seen], near)
        i, j = truth[[p[0] for p in pairs]], seen[[p[1] for p in pairs]]
        missed = palette.centroids_px[np.setdiff1d(truth, i)].astype(np.intp)
        px = np.linalg.norm(palette.centroids_px[i] - report.centroids_px[j], axis=1).sum()
        mm = 1e3 * np.linalg.norm(palette.positions_m[i] - report.positions_m[j], axis=1).sum()
        told = np.count_nonzero(flagged[missed[:, 1], missed[:, 0]])
        out[name] = np.array([len(truth), len(seen), len(pairs), told, px, mm])
    out[ALL] = np.sum([out[k.name.lower()] for k in ELEMENTS], axis=0)
    return out


@lru_cache(maxsize=1)
def _methods() -> dict[str, palette_methods.Method]:
    return palette_methods.methods()


def trial(seed: int) -> dict[tuple[str, str, str], Array]:
    """One palette in all lights by all methods.

    Args:
        seed: Of the palette and the noise.

    Returns:
        Counts of ``judged`` by light, method and class.
    """
    rng = np.random.default_rng(seed)
    palette = palette_pictures.draw(palette_pictures.layout(rng), rng)
    out = {}
    for name, light in lights().items():
        rgb = palette_pictures.photograph(palette, light, rng)
        for method, names in _methods().items():
            report = report_on(names(rgb), rgb, palette.depth_m, CAMERA, RegionCfg())
            for what, counts in judged(report, palette).items():
                out[name, method, what] = counts
    return out


def summarised(found: list[dict[tuple[str, str, str], Array]], seed0: int) -> list[Row]:
    """The table.

    Args:
        found: Of ``trial``, one each.
        seed0: Of the first.

    Returns:
        One row a light, method and class.
    """
    rows = []
    for light, method, what in product(lights(), palette_methods.NAMES, WHATS):
        n, m, k, told, px, mm = np.sum([t[light, method, what] for t in found], axis=0)
        rows.append(
            {
                "light": light,
                "method": method,
                "class": what,
                "trials": len(found),
                "seed0": seed0,
                "elements": int(n),
                "regions": int(m),
                "recall_pct": 100.0 * k / n if n else None,
                "recall_ci": results.wilson(int(k), int(n)) if n else None,
                "precision_pct": 100.0 * k / m if m else None,
                "precision_ci": results.wilson(int(k), int(m)) if m else None,
                "missed_but_flagged_pct": 100.0 * told / (n - k) if n > k else None,
                "centroid_px": px / k if k else None,
                "centroid_mm": mm / k if k else None,
            }
        )
    return rows


def recall_rows() -> list[Row]:
    """Which rows of the tables each network answers, and how many each reading of Hebb's rule.

    Returns:
        One row a network or reading.
    """
    rows = []
    networks = {
        "exact": hopfield.exact(),
        "Hebb as printed": hopfield.printed(),
        "Hebb, best reading": hopfield.best_hebbian(),
    }
    for feedback in (True, False):
        for a, b, c, d in product((False, True), repeat=4):
            if c and not feedback:  # no feedback, none to itself
                continue
            reading = HebbReading(active_only=a, bipolar=b, own=c, constant=d, feedback=feedback)
            name = (
                f"Hebb: {'answering' if a else 'all'} rows, inputs {'-1/1' if b else '0/1'}"
                f"{', own feedback' if c else ''}{', constant unit' if d else ''}"
                f"{'' if feedback else ', no feedback'}"
            )
            first, second = hopfield.hebbian(TABLE_1, reading), hopfield.hebbian(TABLE_2, reading)
            networks[name] = hopfield.HopfieldNetwork(first=first, second=second)
    for name, network in networks.items():
        one = hopfield.recalled(network.first, TABLE_1)
        two = hopfield.recalled(network.second, TABLE_2)
        rows.append(
            {
                "network": name,
                "table_1_rows": int(one.sum()),
                "table_2_rows": int(two.sum()),
                "table_1": "".join("x" if v else "." for v in one),
                "table_2": "".join("x" if v else "." for v in two),
            }
        )
    return rows


def mask_rows(seed: int) -> list[Row]:
    """How far the masks of Eqs. 39-42 overlap, as printed and joined by "and".

    Args:
        seed: Of the palette.

    Returns:
        One row a class of pixels, the share of its pixels in each mask [%].
    """
    rng = np.random.default_rng(seed)
    palette = palette_pictures.draw(palette_pictures.layout(rng), rng)
    rgb = palette_pictures.photograph(palette, NOMINAL, rng)
    rows = []
    for printed in (True, False):
        masks = palette_segments.element_masks(rgb, palette_methods.FIXED, printed=printed)
        for kind in (PaletteClass.PALETTE, *ELEMENTS):
            share = {
                k.name.lower(): 100.0 * float(m[palette.labels == kind].mean()) for k, m in masks.items()
            }
            rows.append(
                {"joined_by": "or (printed)" if printed else "and", "pixels": kind.name.lower(), **share}
            )
    return rows


def _text(rows: list[Row], recall: list[Row], masks: list[Row]) -> str:
    whole = [r for r in rows if r["class"] == ALL]
    body = [
        [
            r["light"],
            r["method"],
            results.with_interval(r, "recall_pct", 1),
            results.with_interval(r, "precision_pct", 1) if r["regions"] else "-",
            results.number(r["missed_but_flagged_pct"], 0),
            results.number(r["centroid_px"], 2),
            results.number(r["centroid_mm"], 2),
        ]
        for r in whole
    ]
    head = ["light", "method", "recall %", "precision %", "missed, but flagged %"]
    accuracy = results.grid([*head, "centroid px", "mm"], body)
    nominal = [r for r in rows if r["light"] == "nominal" and r["class"] != ALL]
    classes = results.grid(
        ["method", "class", "elements", "recall %", "precision %", "centroid px", "mm"],
        [
            [
                r["method"],
                r["class"],
                str(r["elements"]),
                results.number(r["recall_pct"], 1),
                results.number(r["precision_pct"], 1),
                results.number(r["centroid_px"], 2),
                results.number(r["centroid_mm"], 2),
            ]
            for r in nominal
        ],
    )
    networks = results.grid(
        ["network", "Table I, of 8", "Table II, of 8", "rows 000..111 of I", "of II"],
        [
            [
                r["network"],
                str(r["table_1_rows"]),
                str(r["table_2_rows"]),
                f"`{r['table_1']}`",
                f"`{r['table_2']}`",
            ]
            for r in recall
        ],
    )
    overlap = results.grid(
        ["joined by", "pixels of", "in the board's mask %", "cables' %", "connectors' %", "targets' %"],
        [
            [
                r["joined_by"],
                r["pixels"],
                *(f"{r[k]:.1f}" for k in ("palette", "cable", "connector", "target")),
            ]
            for r in masks
        ],
    )
    n = rows[0]["trials"]
    return (
        "Rows of the paper's tables that a network answers (x), from rest; row 001 of Table I corrected.\n\n"
        f"{networks}\n\n"
        f"Pixels in the masks of Eqs. 39-42, fixed thresholds, nominal light.\n\n{overlap}\n\n"
        f"Elements of {n} drawn palettes: cables, connectors, rivets, target zones and ties together. One is "
        "found if a region of its class has its centroid within 6 px (cables: 15 px). Nominal: level 1, "
        "contrast 1, slope 0, noise 4 of 255; one of them is changed at a time. Wilson 95 % intervals.\n\n"
        f"{accuracy}\n\n"
        "By class in nominal light; strangers are yellow parts that no table names, to be flagged.\n\n"
        f"{classes}\n\n"
        "![colours and answers](observer_fig4.png)\n\n![stages](observer_fig6.png)\n\n"
        "![accuracy](observer_accuracy.png)"
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Reads the command line.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        The options.
    """
    parser = argparse.ArgumentParser(
        prog="python -m experiments.observer", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--trials", type=int, default=12, help="palettes (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=500_000, help="of the first (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out") / NAME, help="folder (default: %(default)s)")
    return command.checked(parser, arguments, trials=1, seed=0, jobs=1)


def main(arguments: list[str] | None = None) -> int:
    """Makes tables and figures.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 0 if it ran to the end.
    """
    options = parse(arguments)

    def work() -> str:
        results.log_run(NAME, "Palette observer", options.seed + options.trials - 1)
        seeds = range(options.seed, options.seed + options.trials)
        done = tqdm(engines.local(options.jobs)(trial, seeds), "palettes", total=len(seeds))
        # In the order of the seeds, so that sums of floats repeat.
        found = [counts for _, counts in sorted(done, key=lambda unit: unit[0])]
        rows, recall, masks = summarised(found, options.seed), recall_rows(), mask_rows(options.seed)
        text = _text(rows, recall, masks)
        results.write(
            options.out,
            NAME,
            rows,
            [],
            renderer="drawn",
            regime="static",
            text=text,
            more={"recall": recall, "masks": masks},
        )
        observer_figures.responses(options.out / "observer_fig4.png", options.seed)
        observer_figures.stages(options.out / "observer_fig6.png", options.seed)
        sweeps = {name: [(value, _light(name, value)) for value in values] for name, values in SWEEPS.items()}
        observer_figures.accuracy(
            options.out / "observer_accuracy.png", [r for r in rows if r["class"] == ALL], sweeps
        )
        return text

    return command.run(work, options.out)


def _light(name: str, value: float) -> str:
    return "nominal" if value == getattr(NOMINAL, name) else f"{name} {value:g}"


if __name__ == "__main__":
    sys.exit(main())
