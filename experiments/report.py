"""Puts the results on one static page: tables, intervals, charts, videos, and what made each number.

python -m experiments.report --results experiments/results --out site/
"""

import argparse
import json
import re
import shutil
import struct
import sys
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from experiments import report_charts, report_tables
from seal_gym.core.errors import SealGymError, require

_HERE = Path(__file__).parent
_VIDEOS = (".mp4", ".webm")
_NOTES = ("*.txt", "LOG.md")
_UNKNOWN = "not recorded"
# Title, short title for the navigation, what it is.
ABOUT = {
    "demo": (
        "The expert on every part",
        "Expert",
        "The RMP expert, a policy written by hand, seals each part; learned policies imitate it.",
    ),
    "table2": (
        "Table 2: accuracy of the seam line",
        "Table 2",
        "How far the line that vision finds is from the true seam while the expert seals, by edge method and "
        "by how the line is read from the edges. The charts show the first edge method.",
    ),
    "table3": (
        "Table 3: parts that stand still",
        "Table 3",
        "Learned and hand-written policies on parts that stand still, displaced and lit anew in each trial.",
    ),
    "table4": (
        "Table 4: parts that move",
        "Table 4",
        "The same policies, and a classical adaptive one, while the part moves and turns under the gun.",
    ),
    "severity": (
        "Growing disturbances",
        "Severity",
        "Reached and error against the severity of each disturbance; 1 is the default.",
    ),
    "obstacle": (
        "A leaf added, nothing retrained",
        "Obstacle",
        "A body crosses the path: with an obstacle leaf added at run time, and without.",
    ),
    "reactive": (
        "What makes moving parts sealable",
        "Reactive control",
        "The dynamic regime with parts of the reactive control switched off, one at a time.",
    ),
    "fig12": (
        "Fig. 12: edge methods on single frames",
        "Fig. 12",
        "Edge methods on single frames without memory, as in a run and in growing noise, and on photographs.",
    ),
    "fig15": (
        "Fig. 15: a run on a moving part",
        "Fig. 15",
        "Frames of a run while the part moves.",
    ),
    "learning_curves": (
        "Reinforcement learning",
        "Learning",
        "Policies trained by Stable-Baselines3 beside random actions, no action and the expert.",
    ),
    "calibrate": (
        "Calibration",
        "Calibration",
        "Sensor cameras calibrated from pictures of a board, and the part's pose from its code.",
    ),
    "bead_quality": (
        "The bead at constant and at regulated pressure",
        "Bead",
        "The bead's section along the seam, each run with another cartridge, and what smoothing makes of it.",
    ),
    "bead_paths": (
        "Bead paths between two edges",
        "Bead paths",
        "Nozzle paths with the same height at both edges, naive ones beside them, and as the UR5 runs them.",
    ),
    "tau_jerk": (
        "Tau-Jerk motions",
        "Tau-Jerk",
        "Motions from rest to rest by tau-Jerk, quintic, trapezoid and Ruckig under the same limits.",
    ),
    "inverse_kinematics": (
        "Inverse kinematics",
        "Inverse kinematics",
        "How often and how fast closed form and Newton's method find a posture for a pose.",
    ),
    "palette_paths": (
        "Ways over palettes",
        "Palette ways",
        "Multi-path planning beside straight lines, up-across-down and RRT-Connect, among pegs.",
    ),
    "palette": (
        "Ties pressed home on random palettes",
        "Palettes",
        "A scripted policy that is told the targets by the truth or by an observer of one picture.",
    ),
    "observer": (
        "Observers of palettes",
        "Observers",
        "The two-layer Hopfield observer beside thresholds and k-NN in changing light and noise.",
    ),
    "bead_reference": (
        "Bead paths in the reference simulation",
        "Reference beads",
        "The eight cases' naive and optimal paths laid by OpenFOAM.",
    ),
    "bead_refine": (
        "Bead paths refined",
        "Refined paths",
        "Optimal paths refined on an evaluator of the bead, and what that gains in the reference.",
    ),
    "surrogate": (
        "A surrogate of bead cross-sections",
        "Surrogate",
        "Networks, a linear glass box and a fast tier on beads around paths that none has seen.",
    ),
    "laydown_grid": (
        "Grid study of the reference simulation",
        "Grid study",
        "One straight bead in OpenFOAM by cell size and solver.",
    ),
    "laydown_runs": (
        "Reference simulations of beads",
        "Laydown",
        "Random paths around 25 centre paths and 12 unseen ones in OpenFOAM: the surrogate's data.",
    ),
    "tune_edges": (
        "Settings of the edge methods",
        "Edge settings",
        "How the settings of each edge method were chosen, on validation seeds.",
    ),
}
_FIRST = (
    "table3",
    "table4",
    "severity",
    "obstacle",
    "reactive",
    "demo",
    "table2",
    "fig12",
    "fig15",
    "bead_quality",
    "bead_paths",
    "learning_curves",
)


class File(NamedTuple):
    """A file beside the page.

    Attributes:
        name: As shown.
        src: Where it is, from the page.
    """

    name: str
    src: str


class Media(NamedTuple):
    """A picture or video beside the page.

    Attributes:
        caption: What it shows.
        src: Where it is, from the page.
        width: In pixels, 0 for videos.
        height: In pixels, 0 for videos.
    """

    caption: str
    src: str
    width: int = 0
    height: int = 0


class Section(NamedTuple):
    """One result on the page.

    Attributes:
        id: Of its heading.
        title: Heading.
        short: For the navigation.
        about: What it is.
        command: That made it.
        commit: Of the code.
        seeds: Of its trials.
        regime: Static or dynamic.
        renderer: Of the sensor images.
        stack: Versions by package.
        files: What it was made from.
        charts: Dot plots.
        tables: Tables.
        pictures: That the command made.
        videos: That the command made.
    """

    id: str
    title: str
    short: str
    about: str
    command: str
    commit: str
    seeds: str
    regime: str
    renderer: str
    stack: dict[str, str]
    files: list[File]
    charts: list[report_charts.Chart]
    tables: list[report_tables.Table]
    pictures: list[Media]
    videos: list[Media]


class Note(NamedTuple):
    """A text shown as it is.

    Attributes:
        name: Of the file.
        text: Its content.
    """

    name: str
    text: str


def read(folder: Path) -> dict[Path, dict[str, Any]]:
    """All results below a folder, in the order of the page.

    Args:
        folder: Where the experiments wrote.

    Returns:
        Documents by their path below the folder; JSON files that are no results are left out.

    Raises:
        SealGymError: If there are none.
    """
    require(folder.is_dir(), f"--results {folder}: there is no such folder")
    found = {}
    for path in sorted(folder.rglob("*.json")):
        document = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(document, dict) and document.get("rows") and isinstance(document.get("name"), str):
            found[path.relative_to(folder)] = document
    require(bool(found), f"--results {folder}: no result in it; run an experiment with --out {folder}")

    def order(path: Path) -> tuple[int, str, int]:
        name = _kind(found[path]["name"])
        return (_FIRST.index(name) if name in _FIRST else len(_FIRST), name, len(path.parts))

    return {path: found[path] for path in sorted(found, key=order)}


def seeds(document: dict[str, Any]) -> str:
    """Seeds of a result's trials, in words.

    Args:
        document: As protocol.md describes it.

    Returns:
        First and last seed of the trials, else the first alone.
    """
    used = [t["seed"] for t in document.get("trials", []) if isinstance(t.get("seed"), int)]
    trained = {
        t["training_seed"]
        for t in document.get("trials", []) + document["rows"]
        if isinstance(t.get("training_seed"), int)
    }
    first = document.get("seed0")
    flag = re.search(r"--seed[= ](\d+)", document.get("command", ""))
    if used:
        words = f"{min(used)} to {max(used)}" if max(used) > min(used) else str(used[0])
    elif first is not None or flag:
        words = f"from {first if first is not None else flag and flag[1]} on"
    else:
        words = "" if trained else _UNKNOWN
    learned = f"training {', '.join(map(str, sorted(trained)))}" if trained else ""
    return "; ".join(w for w in (words, learned) if w)


def _copy(source: Path, out: Path, inside: str) -> str:
    target = out / inside
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    return inside


def _caption(path: Path) -> str:
    return path.with_suffix("").as_posix().replace("_", " ").replace("/", ", ")


def _picture(path: Path, folder: Path, out: Path) -> Media:
    with (folder / path).open("rb") as file:
        head = file.read(24)  # signature, then the header's length, name, width and height
    require(
        len(head) == 24 and head.startswith(b"\x89PNG"),
        f"{folder / path}: not a PNG picture; make it again or remove it",
    )
    width, height = struct.unpack(">II", head[16:])
    return Media(_caption(path), _copy(folder / path, out, f"media/{path.as_posix()}"), width, height)


def owner(path: Path, documents: dict[Path, dict[str, Any]]) -> Path | None:
    """The result that a picture or video belongs to.

    Args:
        path: Of the file, below the results' folder.
        documents: From ``read``.

    Returns:
        The one in the same folder with the longest name that the file's begins with, else the first there
        that has a part of the file's name.
    """
    near = [p for p in documents if p.parent == path.parent]
    named = [p for p in near if path.stem == p.stem or path.stem.startswith(f"{p.stem}_")]
    if named:
        return max(named, key=lambda p: len(p.stem))
    parts = (p for p in near if any(r.get("workpiece") == path.stem for r in documents[p]["rows"]))
    return next(parts, None)


def _kind(name: str) -> str:
    """The experiment of a result, which may add what it was run on: ``fig15`` of ``fig15_rectangular``."""
    return next((kind for kind in ABOUT if name == kind or name.startswith(f"{kind}_")), name)


def _section(
    path: Path, document: dict[str, Any], folder: Path, out: Path, pictures: list[Media], videos: list[Media]
) -> Section:
    name = _kind(document["name"])
    title, short, about = ABOUT.get(name, (name, name, ""))
    seals = any("rmse_mm" in row for row in document["rows"])
    if seals and document.get("renderer") == "none":
        about += " Features from the true geometry (oracle), without images."
    where = path.parent.as_posix()
    if where != ".":
        title, short = f"{title} ({where})", f"{short} ({where})"
    beside = [p for p in (path, path.with_suffix(".csv"), path.with_suffix(".md")) if (folder / p).exists()]
    return Section(
        id=re.sub(r"[^a-z0-9]+", "-", path.with_suffix("").as_posix().lower()),
        title=title,
        short=short,
        about=about.strip(),
        command=document.get("command") or _UNKNOWN,
        commit=document.get("git_commit") or _UNKNOWN,
        seeds=seeds(document),
        regime=document.get("regime") or _UNKNOWN,
        renderer=document.get("renderer") or _UNKNOWN,
        stack={"seal_gym": document.get("version", _UNKNOWN), **document.get("stack", {})},
        files=[File(p.name, _copy(folder / p, out, f"data/{p.as_posix()}")) for p in beside],
        charts=report_charts.charts(document),
        tables=report_tables.tables(document),
        pictures=pictures,
        videos=videos,
    )


def sections(folder: Path, out: Path) -> list[Section]:
    """All results of a folder; copies the files they need.

    Args:
        folder: Where the experiments wrote.
        out: Where the page will be.

    Returns:
        One for each result.
    """
    documents = read(folder)
    media: dict[Path | None, tuple[list[Media], list[Media]]] = {}
    for path in sorted(p.relative_to(folder) for p in folder.rglob("*")):
        if path.suffix not in (".png", *_VIDEOS):
            continue
        pictures, videos = media.setdefault(owner(path, documents), ([], []))
        if path.suffix == ".png":
            pictures.append(_picture(path, folder, out))
        else:
            videos.append(Media(_caption(path), _copy(folder / path, out, f"media/{path.as_posix()}")))
    return [
        _section(path, document, folder, out, *media.get(path, ([], [])))
        for path, document in documents.items()
    ]


def films(sources: list[Path], out: Path) -> list[Media]:
    """Videos from elsewhere; copies them.

    Args:
        sources: Files or folders.
        out: Where the page will be.

    Returns:
        The videos, sorted by name.

    Raises:
        SealGymError: If a source has none.
    """
    found: list[Media] = []
    for source in sources:
        files = sorted(source.rglob("*")) if source.is_dir() else [source]
        files = [f for f in files if f.suffix in _VIDEOS and f.is_file()]
        require(bool(files), f"--videos {source}: no {' or '.join(_VIDEOS)} there")
        for file in files:
            name = file.relative_to(source) if source.is_dir() else Path(file.name)
            inside = f"media/videos/{len(found)}_{file.name}"
            found.append(Media(_caption(name), _copy(file, out, inside)))
    return found


def notes(folder: Path) -> list[Note]:
    """Logs in the results' folder.

    Args:
        folder: Where the experiments wrote.

    Returns:
        Text files and the log of published runs.
    """
    files = sorted({f for pattern in _NOTES for f in folder.glob(pattern)})
    return [Note(f.name, f.read_text(encoding="utf-8")) for f in files]


def page(results: list[Section], videos: list[Media], logs: list[Note]) -> str:
    """The page.

    Args:
        results: Its sections.
        videos: From elsewhere.
        logs: Shown as they are.

    Returns:
        HTML that needs nothing but the files beside it.
    """
    templates = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    used = {c.key for s in results for t in s.tables for c in t.columns}
    terms = {k: v for k, v in report_tables.GLOSSARY.items() if k in used}
    style = Markup((_HERE / "report_style.css").read_text(encoding="utf-8"))
    return templates.get_template("report_page.html.j2").render(
        title="seal_gym results",
        style=style,
        sections=results,
        videos=videos,
        notes=logs,
        glossary=terms,
        terms=terms,
        width=report_charts.WIDTH,
    )


def main(arguments: list[str] | None = None) -> int:
    """Makes the page.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status.
    """
    parser = argparse.ArgumentParser(prog="python -m experiments.report", description=__doc__)
    parser.add_argument("--results", type=Path, default=_HERE / "results", help="folder of the results")
    parser.add_argument("--out", type=Path, default=Path("site"), help="folder of the page")
    parser.add_argument(
        "--videos", type=Path, action="append", default=[], help="more videos: a file or a folder; repeatable"
    )
    options = parser.parse_args(arguments)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        results = sections(options.results, options.out)
        html = page(results, films(options.videos, options.out), notes(options.results))
    except SealGymError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    (options.out / "index.html").write_text(html, encoding="utf-8")
    print(f"{len(results)} results written to {options.out / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
