"""Runs trials: one policy, one workpiece, one seed each; in parallel, resumable, the same in any order."""

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

import agents
import seal_gym
from experiments import results
from seal_gym.core.errors import SeamError
from seal_gym.envs.seal_env import SealEnv
from seal_gym.workpieces.catalogue import NAMES
from seal_gym.workpieces.workpiece import Workpiece

Observer = Callable[[SealEnv, dict[str, Any]], None]


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Everything that decides a trial.

    Attributes:
        method: Name of the policy.
        workpiece: Name of a nominal part, or path of a CSV file with a seam.
        seed: Seed of the environment.
        env: Further keyword arguments of the environment.
    """

    method: str
    workpiece: str
    seed: int
    env: dict[str, Any] = field(default_factory=dict)

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
        part: Any = self.workpiece
        if part.endswith(".csv"):
            points, approach = read_seam(Path(part))
            part = {"points_m": points.tolist(), "approach": approach.tolist(), "name": self.part}
        return {
            "id": "SealGym/Seal-v0",
            "workpiece": part,
            "kwargs": {**self.env, "control": agents.control_of(self.method)},
            "seed": self.seed,
            "version": seal_gym.__version__,
        }


Worker = Callable[[Trial], dict[str, Any]]


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
    """Hash of everything a trial runs on besides its specification: sources, assets and packages.

    Returns:
        Sixteen hexadecimal digits.
    """
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256(json.dumps(results.stack(), sort_keys=True).encode())
    for folder in ("agents", "assets", "experiments", "seal_gym"):
        for file in sorted((root / folder).rglob("*")):
            if file.suffix in (".py", ".xml", ".toml"):
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=32)
def workpiece(name: str) -> str | Workpiece:
    """A nominal part's name, or the workpiece of a seam file.

    Args:
        name: As in ``Trial``.

    Returns:
        What the environment's ``workpiece`` takes.
    """
    if not name.endswith(".csv"):
        return name
    points, approach = read_seam(Path(name))
    return Workpiece.from_polyline(points, approach, name=Path(name).stem)


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


def run(trial: Trial, observer: Observer | None = None, render_mode: str | None = None) -> dict[str, Any]:
    """Runs one trial.

    Args:
        trial: What to run.
        observer: Called with the environment and the info after the reset and after each step.
        render_mode: Of the environment, for observers that take pictures.

    Returns:
        The trial's row as protocol.md has it, with the episode's metrics.
    """
    control = agents.control_of(trial.method)
    env = _environment(trial.workpiece, control, json.dumps(trial.env, sort_keys=True), render_mode)
    policy = agents.load_policy(trial.method, env)
    core = env.unwrapped
    assert isinstance(core, SealEnv)
    observation, info = env.reset(seed=trial.seed)
    state, start, done = None, np.array([True]), False
    if observer:
        observer(core, info)
    while not done:
        action, state = policy.predict(observation, state=state, episode_start=start)
        observation, _, terminated, truncated, info = env.step(action)
        start, done = np.array([False]), terminated or truncated
        if observer:
            observer(core, info)
    metrics = info["episode_metrics"]
    return {
        "method": trial.method,
        "workpiece": trial.part,
        "seed": trial.seed,
        "training_seed": None,
        **{k: (None if isinstance(v, float) and np.isnan(v) else v) for k, v in metrics.items()},
        "env_spec": trial.spec(),
    }


def run_all(
    trials: Iterable[Trial], *, jobs: int, log: Path, title: str, work: Worker | None = None
) -> list[dict[str, Any]]:
    """Runs trials that are not in the log yet, and logs each as it ends.

    Args:
        trials: What to run.
        jobs: Processes.
        log: A file of JSON lines; what is in it with the same specification, from the same code and
            packages, is not run again.
        title: Of the progress bar.
        work: What makes a row with ``method`` and ``env_spec`` of a trial, picklable; ``run`` by default.

    Returns:
        One row a trial, in the order of ``trials``.
    """
    wanted = list(trials)
    done = _read_log(log)
    missing = [t for t in wanted if _key(t.method, t.spec()) not in done]
    with log.open("a", encoding="utf-8") as file:
        for row in tqdm(
            _results(missing, jobs, work or run),
            total=len(wanted),
            initial=len(wanted) - len(missing),
            desc=title,
            unit="trial",
        ):
            done[_key(row["method"], row["env_spec"])] = row
            file.write(json.dumps({"code": code(), **row}) + "\n")
            file.flush()
    return [done[_key(t.method, t.spec())] for t in wanted]


def _results(trials: list[Trial], jobs: int, work: Worker) -> Iterator[dict[str, Any]]:
    if jobs <= 1 or len(trials) <= 1:
        yield from map(work, trials)
        return
    # Fresh processes: a forked one would share OpenGL contexts and threads with this one.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(trials)), mp_context=context, initializer=_one_thread) as pool:
        for future in as_completed([pool.submit(work, t) for t in trials]):
            yield future.result()


def _one_thread() -> None:
    os.environ["OMP_NUM_THREADS"] = "1"


def _key(method: str, spec: dict[str, Any]) -> str:
    return json.dumps([method, spec], sort_keys=True)


def _read_log(log: Path) -> dict[str, dict[str, Any]]:
    if not log.exists():
        return {}
    rows = {}
    for line in log.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue  # the line a killed run was writing
        if row.pop("code", None) != code():
            continue  # another version's
        rows[_key(row["method"], row["env_spec"])] = row
    return rows
