"""Runs trials: one policy, one workpiece, one seed each; in parallel, resumable, the same in any order."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from tqdm import tqdm

import agents
import seal_gym
from agents.engines import Engine
from agents.provenance import ROOT
from agents.rollouts import play_once
from agents.travel import play_from_home
from experiments import results, shapes
from seal_gym.core.errors import ConfigError, SeamError
from seal_gym.core.frames import Array
from seal_gym.core.provenance import digest
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from seal_gym.envs.seal_env import SealEnv
from seal_gym.workpieces.catalogue import NAMES
from seal_gym.workpieces.workpiece import Workpiece

Row = dict[str, Any]
Observer = Callable[[SealEnv, dict[str, Any]], None]
TOGETHER = 25
"""Trials that a worker runs as one batch, and that are logged together."""
_SIMULATIONS = 5  # at once: a divisor of TOGETHER, so that none idles; more save little time
_PATH_EVERY = 3  # frames, about 1 mm of the seam
# They say which trials to run, or turn their rows into tables and pictures: no row depends on them.
_NO_ROW_DEPENDS_ON = (
    "command.py",
    "control_figures.py",
    "control_report.py",
    "control_table.py",
    "demo.py",
    "learning_curves.py",
    "methods.py",
    "pictures.py",
    "results.py",
    "severity.py",
    "severity_figures.py",
    "severity_report.py",
    "table3.py",
    "table4.py",
)
_SOURCES = (".py", ".xml", ".toml")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Everything that decides a trial.

    Attributes:
        method: Name of the policy.
        workpiece: Name of a nominal part or of one of ``shapes``, or path of a CSV file with a seam.
        seed: Seed of the environment.
        env: Further keyword arguments of the environment.
        weights: File of the policy's weights; by default those that ``agents.load_policy`` takes.
        training_seed: Of these weights.
    """

    method: str
    workpiece: str
    seed: int
    env: dict[str, Any] = field(default_factory=dict)
    weights: str | None = None
    training_seed: int | None = None

    @property
    def part(self) -> str:
        """Short name of the workpiece; a seam file's never that of a nominal part."""
        if not self.workpiece.endswith(".csv"):
            return self.workpiece
        stem = Path(self.workpiece).stem
        return f"{stem}_csv" if stem in NAMES else stem

    def spec(self) -> dict[str, Any]:
        """Enough to rebuild the run.

        Returns:
            Environment id, keyword arguments and seed, ready for JSON.
        """
        return {
            "id": "SealGym/Seal-v0",
            "workpiece": _part_spec(self.workpiece, self.part),
            "kwargs": {**self.env, "control": agents.control_of(self.method)},
            "seed": self.seed,
            "version": seal_gym.__version__,
        }


Worker = Callable[[Trial], Row]


def _part_spec(name: str, shown: str) -> str | dict[str, Any]:
    """A nominal part's name; of any other everything it is built from."""
    shape = _shape(name, shown)
    return name if shape is None else shape.spec()


def _shape(name: str, shown: str) -> shapes.Shape | None:
    if name in shapes.NAMES:
        return shapes.get(name)
    if not name.endswith(".csv"):
        return None
    points, approach = read_seam(Path(name))
    return shapes.Shape(name=shown, points=points, approach=approach)


def read_seam(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads a seam from a CSV file.

    Args:
        path: Rows x, y, z, ax, ay, az: points in order of travel in the part's frame [m] and the unit
            approach direction at each; a header line and lines starting with # are passed over.

    Returns:
        Points and approach directions, shape (n, 3) each.

    Raises:
        SeamError: If there is no such file, or a row has not six numbers.
    """
    if not path.is_file():
        raise SeamError(f"seam file {str(path)!r} not found: give a CSV file with rows x,y,z,ax,ay,az")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SeamError(f"seam file {path.name!r} is no text file: {error}") from error
    rows: list[list[float]] = []
    header = False
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.split("#")[0].replace(",", " ").split()
        values = [_number(c) for c in cells]
        if not cells:
            continue
        if not rows and not header and all(v is None for v in values):
            header = True
            continue
        row = [v for v in values if v is not None]
        if len(row) != 6 or len(cells) != 6:
            raise SeamError(
                f"{path.name} line {number}: {line.strip()!r} has not six numbers; write x,y,z,ax,ay,az with "
                "the point in m and the unit approach direction (e.g. 0.10,0,0,0,-0.7071,0.7071)"
            )
        rows.append(row)
    if len(rows) < 2:
        raise SeamError(f"seam file {path.name!r} has {len(rows)} points: at least 2")
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    direction = table[:, 3:]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    # A file has few digits: anything near a unit vector is meant as one.
    direction = np.where(
        np.abs(length - 1.0) < 0.02, direction / np.where(length > 0, length, 1.0), direction
    )
    return table[:, :3], direction


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


@lru_cache(maxsize=1)
def code() -> str:
    """Hash of everything a trial runs on besides its specification and weights: sources, assets, packages.

    Returns:
        Sixteen hexadecimal digits.
    """
    files = {
        str(file.relative_to(ROOT)): file
        for folder in ("agents", "assets", "experiments", "seal_gym")
        for file in (ROOT / folder).rglob("*")
        if file.suffix in _SOURCES and not (folder == "experiments" and file.name in _NO_ROW_DEPENDS_ON)
    }
    packages = json.dumps(results.stack(), sort_keys=True)
    return hashlib.sha256((digest(files) + packages).encode()).hexdigest()[:16]


@lru_cache(maxsize=256)
def code_of(source: str) -> str:
    """Hash of everything that a policy's trials run on, its weights included, and no other policy's.

    Args:
        source: Name of the policy, or file of its weights.

    Returns:
        Sixteen hexadecimal digits.
    """
    file = Path(source) if Path(source).suffix else agents.WEIGHTS / f"{source}.safetensors"
    # Whatever stands beside the weights under their name: the card, or gains in a file of their own.
    beside = {f.name: f for f in file.parent.glob(f"{file.stem}.*")}
    return hashlib.sha256((code() + digest(beside)).encode()).hexdigest()[:16]


@lru_cache(maxsize=32)
def workpiece(name: str) -> str | Workpiece:
    """A nominal part's name, or the workpiece of a shape or a seam file.

    Args:
        name: As in ``Trial``.

    Returns:
        What the environment's ``workpiece`` takes.
    """
    shape = _shape(name, Path(name).stem)
    return name if shape is None else shape.workpiece()


def rebuild(spec: dict[str, Any], environments: Iterable[dict[str, Any]] = ()) -> gym.Env[Any, Any]:
    """Makes the environment of a trial again.

    Args:
        spec: A trial's ``env_spec``; reset the environment with its ``seed``.
        environments: The document's, if the trials name one of them.

    Returns:
        The environment.

    Raises:
        ConfigError: If the environment that it names is not there.
    """
    if "environment" in spec:
        found = [e for e in environments if e["environment"] == spec["environment"]]
        if len(found) != 1:
            raise ConfigError(
                f"environment {spec['environment']!r} is there {len(found)} times: give the document's "
                '"environments"'
            )
        spec = found[0]
    part = spec["workpiece"]
    built = part if isinstance(part, str) else shapes.Shape.of_spec(part).workpiece()
    return gym.make(spec["id"], workpiece=built, disable_env_checker=True, **spec["kwargs"])


def shared(rows: Iterable[Row]) -> tuple[list[dict[str, Any]], list[Row]]:
    """Rows that name their environment instead of describing it each for itself.

    Args:
        rows: Of trials.

    Returns:
        The environments, for ``rebuild``; and the rows, whose ``env_spec`` has ``environment`` and ``seed``.
    """
    names: dict[str, str] = {}
    environments: list[dict[str, Any]] = []
    light = []
    for row in rows:
        spec = {k: v for k, v in row["env_spec"].items() if k != "seed"}
        key = json.dumps(spec, sort_keys=True)
        if key not in names:
            names[key] = f"{row['workpiece']}-{len(names)}"
            environments.append({"environment": names[key], **spec})
        light.append({**row, "env_spec": {"environment": names[key], "seed": row["env_spec"]["seed"]}})
    return environments, light


@lru_cache(maxsize=8)
def _environment(part: str, control: str, kwargs: str, render_mode: str | None) -> gym.Env[Any, Any]:
    return gym.make(
        "SealGym/Seal-v0",
        workpiece=workpiece(part),
        control=control,
        render_mode=render_mode,
        disable_env_checker=True,
        **json.loads(kwargs),
    )


def run(
    trial: Trial, observer: Observer | None = None, render_mode: str | None = None, *, from_home: bool = False
) -> dict[str, Any]:
    """Runs one trial.

    Args:
        trial: What to run.
        observer: Called with the environment and the info after the reset and after each step.
        render_mode: Of the environment, for observers that take pictures.
        from_home: Whether the arm comes from its home and goes back there.

    Returns:
        The trial's row as protocol.md has it, with the episode's metrics.
    """
    control = agents.control_of(trial.method)
    env = _environment(trial.workpiece, control, json.dumps(trial.env, sort_keys=True), render_mode)
    policy = agents.load_policy(trial.weights or trial.method, env)
    core = env.unwrapped
    assert isinstance(core, SealEnv)
    play = play_from_home if from_home else play_once
    metrics = play(policy, env, trial.seed, observer and (lambda _, info: observer(core, info)))
    del metrics["return"]  # depends on the reward's weights: no table has it
    return _row(trial, metrics)


def _row(trial: Trial, metrics: dict[str, Any]) -> Row:
    return {
        "method": trial.method,
        "workpiece": trial.part,
        "seed": trial.seed,
        "training_seed": trial.training_seed,
        **{k: (None if isinstance(v, float) and np.isnan(v) else v) for k, v in metrics.items()},
        "env_spec": trial.spec(),
    }


@lru_cache(maxsize=2)
def _core(part: str, control: str, kwargs: str, n: int) -> SealCore:
    return SealCore(SealCfg.of(workpiece=workpiece(part), control=control, **json.loads(kwargs)), n)


def run_together(batch: Sequence[Trial]) -> list[Row]:
    """Runs trials that differ in their seed alone, several at once: to the bit as ``run`` one by one.

    Args:
        batch: What to run, at least one.

    Returns:
        One row a trial in the same order, with ``path_mm``: the tip in the part's frame, sampled along the
            run, rounded to 1 um.
    """
    first, n = batch[0], min(len(batch), _SIMULATIONS)
    kwargs = json.dumps(first.env, sort_keys=True)
    core = _core(first.workpiece, agents.control_of(first.method), kwargs, n)
    policy = agents.load_policy(first.weights or first.method, SimpleNamespace(core=core))
    paths: list[list[Array]] = [[] for _ in batch]
    ended: dict[int, Row] = {}
    waiting = iter(range(n, len(batch)))
    which: list[int | None] = list(range(n))

    def begin(i: int, k: int | None) -> None:
        which[i] = k
        # With nothing left to do, the simulation goes on with any trial: nobody looks.
        core.reset(i, seeding.np_random(batch[k or 0].seed)[0])
        if k is not None:
            paths[k].append(1e3 * core.tip_in_part()[i])

    for i in range(n):
        begin(i, i)
    state, starts = None, np.ones(n, np.bool_)
    while len(ended) < len(batch):
        action, state = policy.predict(core.observe(), state=state, episode_start=starts)
        result = core.step(action)
        starts = result.terminated | result.timeout
        tips = 1e3 * core.tip_in_part()
        for i, k in enumerate(which):
            if k is not None and (starts[i] or core.frames[i] % _PATH_EVERY == 0):
                paths[k].append(tips[i])
        for i in map(int, np.flatnonzero(starts)):
            k = which[i]
            if k is not None:
                path = np.round(paths[k], 3).tolist()
                ended[k] = {**_row(batch[k], core.episode_metrics(i, result)), "path_mm": path}
            begin(i, next(waiting, None))
    return [ended[k] for k in range(len(batch))]


def run_all(
    trials: Iterable[Trial],
    *,
    engine: Engine,
    log: Path,
    title: str,
    work: Worker | None = None,
    together: int = 1,
) -> list[Row]:
    """Runs trials that are not in the log yet, and logs each, or each batch, as it ends.

    Args:
        trials: What to run.
        engine: Where they run.
        log: A file of JSON lines; what is in it with the same specification, from the same code, weights
            and packages, is not run again.
        title: Of the progress bar.
        work: What makes a row with ``method`` and ``env_spec`` of a trial, picklable; ``run`` by default.
        together: Trials in a batch; above 1 they run as ``run_together`` has it, without ``work``.

    Returns:
        One row a trial, in the order of ``trials``.
    """
    wanted = list(trials)
    code_of.cache_clear()  # weights may have been trained since
    done = _read_log(log)
    missing = [t for t in wanted if _key(t) not in done]
    batches = _batches(missing, together)
    work_all = run_together if together > 1 else partial(_one_by_one, work or run)
    with (
        log.open("a", encoding="utf-8") as file,
        tqdm(total=len(wanted), initial=len(wanted) - len(missing), desc=title, unit="trial") as bar,
    ):
        for batch, rows in engine(work_all, batches):
            for trial, row in zip(batch, rows, strict=True):
                done[_key(trial)] = row
                file.write(json.dumps({"code": _code(trial), **row}) + "\n")
            file.flush()
            bar.update(len(batch))
    return [done[_key(t)] for t in wanted]


def _batches(trials: Sequence[Trial], size: int) -> list[list[Trial]]:
    """Trials that differ in their seed alone, at most ``size`` together, in order of first appearance."""
    alike: dict[str, list[Trial]] = {}
    for t in trials:
        what = [t.method, t.weights, t.training_seed, t.workpiece, t.env]
        alike.setdefault(json.dumps(what, sort_keys=True), []).append(t)
    return [group[k : k + size] for group in alike.values() for k in range(0, len(group), size)]


def _one_by_one(work: Worker, batch: Sequence[Trial]) -> list[Row]:
    return [work(trial) for trial in batch]


def _code(trial: Trial) -> str:
    return code_of(trial.weights or trial.method)


def _key(trial: Trial) -> str:
    return _key_of(_code(trial), trial.method, trial.training_seed, trial.spec())


def _key_of(code: str | None, method: str, training_seed: int | None, spec: dict[str, Any]) -> str:
    return json.dumps([code, method, training_seed, spec], sort_keys=True)


def _read_log(log: Path) -> dict[str, Row]:
    text = log.read_text(encoding="utf-8") if log.exists() else ""
    if text and not text.endswith("\n"):  # cut off by a kill: what comes next needs a line of its own
        with log.open("a", encoding="utf-8") as file:
            file.write("\n")
    rows = {}
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue  # the line a killed run was writing
        made_by = row.pop("code", None)
        rows[_key_of(made_by, row["method"], row.get("training_seed"), row["env_spec"])] = row
    return rows
