"""Says what this machine can do and whether the published numbers hold on it.

    python -m seal_gym.doctor                   a report; exit status 0 unless something is broken
    python -m seal_gym.doctor --json            the same for programs
    python -m seal_gym.doctor --write-hashes    ships this machine's rollouts as the reference (maintainers)

It looks at package versions, at OpenGL in processes of its own, and at short rollouts of every environment
id, whose observations it compares with the shipped ones. On one software stack they repeat to the bit.
Where they do not, a hash alone cannot say how far off they are, and a hash of rounded values hardly better:
of ten thousand values some lie on a rounding border. So each rollout also has a sketch, a few sums with
fixed random signs, from which the root mean square of the difference follows (Achlioptas, "Database-friendly
random projections", 2003, theorem 1.1).
"""

import argparse
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import time
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import InvalidVersion, Version

import seal_gym
from seal_gym.core.frames import Array
from seal_gym.core.paths import asset
from seal_gym.core.provenance import digest, version

HASHES = Path(__file__).with_name("rollout_hashes.json")
_PACKAGE = Path(__file__).parent

# -- packages ---------------------------------------------------------------------------------------------

# What users install; test and dev tools decide no result.
_EXTRAS = ("sb3", "imitation", "planning", "ray", "viz")


class Package(NamedTuple):
    """A package against the range it is tested with.

    Attributes:
        name: On PyPI.
        extra: The extra that asks for it, empty for the core.
        tested: The range, e.g. ``>=4.0,<5``.
        installed: The version, None if there is none.
        state: ``ok``, ``outside``, ``unknown`` (no version number), ``absent`` (of an extra) or
            ``missing`` (of the core).
    """

    name: str
    extra: str
    tested: str
    installed: str | None
    state: str


def requirements() -> list[tuple[str, str, str]]:
    """The tested ranges: of the checkout if this is one, else of the installed package.

    Returns:
        Name, extra (empty for the core) and range of each package.
    """
    project = _PACKAGE.parent / "pyproject.toml"
    if project.exists():
        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        lines = [(line, "") for line in (f"python{table['requires-python']}", *table["dependencies"])]
        lines += [(line, extra) for extra in _EXTRAS for line in table["optional-dependencies"][extra]]
    else:
        lines = [(line, "") for line in metadata.requires("seal-gym") or ()]
        lines.insert(0, (f"python{metadata.metadata('seal-gym')['Requires-Python']}", ""))
    out = []
    for line, extra in lines:
        found = Requirement(line)
        # Installed metadata have the extra in the marker.
        wanted = [e for e in ("", *_EXTRAS) if found.marker is None or found.marker.evaluate({"extra": e})]
        if found.name != "seal-gym" and wanted:
            out.append((found.name, extra or wanted[0], str(found.specifier)))
    return out


def _judged(installed: str | None, tested: str, extra: str) -> str:
    if installed is None:
        return "absent" if extra else "missing"
    try:
        return "ok" if SpecifierSet(tested).contains(Version(installed)) else "outside"
    except InvalidVersion:
        return "unknown"


def packages() -> list[Package]:
    """Every package that the core and the extras name.

    Returns:
        What is installed of them, each name once, the core first.
    """
    out: dict[str, Package] = {}
    for name, extra, tested in requirements():
        installed = version(name)
        state = _judged(installed, tested, extra)
        out.setdefault(name, Package(name, extra, tested, installed, state))
    return list(out.values())


# -- OpenGL -----------------------------------------------------------------------------------------------

_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swr", "software")
_PICTURE = (480, 640)  # height, width
_GL_SECONDS = 180


def _ms(renderer: Any, data: Any, camera: str, *, shadows: bool) -> float:
    """Shortest time of a picture [ms]: what else the machine does only adds."""
    import mujoco

    renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = shadows
    renderer.update_scene(data, camera=camera)
    times = []
    for _ in range(4):
        start = time.perf_counter()
        renderer.render()
        times.append(time.perf_counter() - start)
    return 1e3 * min(times[1:])


def probe_gl() -> dict[str, Any]:
    """Draws the cell with OpenGL; run it in a process of its own, which a broken driver may take down.

    Returns:
        Backend, driver and times [ms] of a picture and of an ROI, with and without shadows.
    """
    import mujoco

    from seal_gym.core.cell import load_cell
    from seal_gym.sim.gl import offscreen
    from seal_gym.sim.scene import cached_scene
    from seal_gym.workpieces import catalogue

    cell = load_cell()
    model = cached_scene(catalogue.get("flat"), cell).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = cell.cameras[0]
    times = {}
    driver: dict[str, str] = {}
    for name, size, camera in (
        ("picture", _PICTURE, "scene"),
        ("roi", (view.height, view.width), view.name),
    ):
        with offscreen(model, *size) as renderer:
            times[f"{name}_plain_ms"] = _ms(renderer, data, camera, shadows=False)
            times[f"{name}_shadows_ms"] = _ms(renderer, data, camera, shadows=True)
            driver = driver or _driver()
    return {"backend": os.environ.get("MUJOCO_GL", "default"), **driver, **times}


def _driver() -> dict[str, str]:
    from OpenGL import GL  # type: ignore[import-untyped]  # ships no types

    names = {"vendor": GL.GL_VENDOR, "driver": GL.GL_RENDERER, "version": GL.GL_VERSION}
    return {key: (GL.glGetString(name) or b"?").decode(errors="replace") for key, name in names.items()}


def _try_gl(backend: str | None) -> dict[str, Any]:
    env = os.environ | ({"MUJOCO_GL": backend} if backend else {})
    name = backend or "default"
    try:
        run = subprocess.run(
            [sys.executable, "-m", "seal_gym.doctor", "--probe-gl"],
            cwd=_PACKAGE.parent,
            env=env,
            capture_output=True,
            text=True,
            timeout=_GL_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"works": False, "backend": name, "error": f"no picture within {_GL_SECONDS} s"}
    if run.returncode == 0:
        return {"works": True, **json.loads(run.stdout.splitlines()[-1])}
    last = (run.stderr.strip().splitlines() or [f"the process ended with status {run.returncode}"])[-1]
    return {"works": False, "backend": name, "error": last}


def check_gl() -> dict[str, Any]:
    """Whether OpenGL works here, with ``MUJOCO_GL`` if it is set, else with the first backend that does.

    Returns:
        ``works``, and what ``probe_gl`` found or the ``error`` of each backend.
    """
    chosen = os.environ.get("MUJOCO_GL")
    backends = (chosen,) if chosen else ("egl", "osmesa") if sys.platform == "linux" else (None,)
    failed = []
    for backend in backends:
        found = _try_gl(backend)
        if found["works"]:
            found["software"] = any(word in found["driver"].lower() for word in _SOFTWARE)
            return found
        failed.append(found)
    return {"works": False, "error": "; ".join(f"{f['backend']}: {f['error']}" for f in failed)}


# -- rollouts ---------------------------------------------------------------------------------------------

_SEEDS = (0, 1, 2, 3)
_STEPS = 75  # of an episode
_SUMS = 16
_PUSH = 0.3  # in the first step, along the travel: 10 mm/s after it with control="tip"
_WIGGLE = 0.03
RUNS: dict[str, dict[str, Any]] = {
    "tip": {"perception": "oracle", "control": "tip"},
    "rmp": {"perception": "oracle", "control": "rmp"},
    # tip control: what vision sees does not move the arm, so that images differ only if the camera does
    "vision": {"perception": "vision", "control": "tip", "observation": "features+images"},
}
QUANTITIES = {
    "tip": "oracle features and reward with control='tip': physics, kinematics, geometry",
    "rmp": "oracle features and reward with control='rmp': the same with the resolve",
    "images": "pixels of both ROIs",
    "vision": "features by vision and reward",
}
# Largest root mean square of a difference in the last bits: features in the observation's units (mm, deg,
# rad; float32 has 7 digits), images in grey levels (some pixels a level apart).
_LAST_BITS = {"tip": 1e-6, "rmp": 1e-6, "images": 1e-2, "vision": 1e-6}


class Rollout(NamedTuple):
    """What a rollout gave.

    Attributes:
        hash: Of all values' bytes.
        steps: Number of steps.
        sketch: Sums of all values with random signs over the root of their number, shape (16,).
    """

    hash: str
    steps: int
    sketch: tuple[float, ...]


def _signs(seed: int, rows: int, columns: int) -> Array:
    """Fixed random signs, shape (rows, columns); from raw bits, which no numpy release changes."""
    bits = rows * columns
    raw = np.random.PCG64(seed).random_raw(-(-bits // 64)).astype("<u8")
    return np.where(np.unpackbits(raw.view(np.uint8), count=bits).reshape(rows, columns), 1.0, -1.0)


class Recorder:
    """Hashes and sketches the values of a rollout, step by step."""

    def __init__(self) -> None:
        """Starts empty."""
        self._digest = hashlib.sha256()
        self._sums = np.zeros(_SUMS)
        self._in_step = np.empty((_SUMS, 0))
        self._of_step = _signs(1, len(_SEEDS) * (_STEPS + 1), _SUMS)
        self._steps = self._values = 0

    def add(self, values: np.ndarray) -> None:
        """Takes the values of a step.

        Args:
            values: Always as many, at most ``len(_SEEDS) * (_STEPS + 1)`` times; float64 or uint8.
        """
        if self._in_step.shape[1] != values.size:
            self._in_step = _signs(0, _SUMS, values.size)
        little_endian = values.dtype.newbyteorder("<")
        self._digest.update(np.ascontiguousarray(values, dtype=little_endian).tobytes())
        self._sums += self._of_step[self._steps] * (self._in_step @ values.astype(np.float64).ravel())
        self._steps += 1
        self._values += values.size

    def result(self) -> Rollout:
        """What the values come to.

        Returns:
            Hash, number of steps and sketch.
        """
        sketch = self._sums / np.sqrt(max(self._values, 1))
        return Rollout(self._digest.hexdigest()[:16], self._steps, tuple(sketch.tolist()))


def _features(observation: Any) -> np.ndarray:
    return np.asarray(observation["features"] if isinstance(observation, dict) else observation)


def rollout(env_id: str, run: str) -> dict[str, Rollout]:
    """Runs four short episodes with fixed seeds and actions.

    Args:
        env_id: Of the environment.
        run: Key of ``RUNS``.

    Returns:
        By quantity: the run's own, and with images ``"images"`` too.

    Raises:
        FloatingPointError: If an observation is not finite.
    """
    env = gym.make(env_id, **RUNS[run])
    features, images = Recorder(), Recorder()

    def take(observation: Any, reward: float) -> None:
        row = np.append(_features(observation).astype(np.float64), reward)
        if not np.isfinite(row).all():
            raise FloatingPointError(f"{env_id}, {run}: an observation is not finite")
        features.add(row)
        if isinstance(observation, dict):
            images.add(np.concatenate([observation[k].ravel() for k in ("front", "side")]))

    try:
        for seed in _SEEDS:
            rng = np.random.default_rng(seed)
            take(env.reset(seed=seed)[0], 0.0)
            for step in range(_STEPS):
                action = _WIGGLE * rng.uniform(-1.0, 1.0, env.action_space.shape)
                action[1] += _PUSH * (step == 0)
                observation, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
                take(observation, float(reward))
                if terminated or truncated:
                    break
    finally:
        env.close()  # type: ignore[no-untyped-call]  # gymnasium 0.29 leaves it untyped
    found = {run: features.result()}
    return found | {"images": images.result()} if run == "vision" else found


def rollouts() -> tuple[dict[str, dict[str, Rollout]], dict[str, str]]:
    """Runs every environment id in every way.

    Returns:
        By id and quantity; and by id the error of those that failed.
    """
    found: dict[str, dict[str, Rollout]] = {}
    errors: dict[str, str] = {}
    for env_id in seal_gym.ENV_IDS:
        try:
            rows: dict[str, Rollout] = {}
            for run in RUNS:
                rows |= rollout(env_id, run)
        except Exception as error:  # whatever it is, the report says so and goes on
            errors[env_id] = f"{type(error).__name__}: {error}"
        else:
            found[env_id] = {quantity: rows[quantity] for quantity in QUANTITIES}
    return found, errors


# -- shipped hashes ---------------------------------------------------------------------------------------

_KEY = ("mujoco", "numpy", "numba", "scipy")


def stack() -> dict[str, str]:
    """What decides the last bits.

    Returns:
        Versions of mujoco, numpy, numba and scipy, and the machine's architecture.
    """
    return {name: version(name) or "none" for name in _KEY} | {"machine": platform.machine()}


def _cpu() -> str:
    """Name of the processor: numpy and OpenBLAS choose their kernels by it."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else []
    return names[0] if names else platform.processor() or "unknown"


def code_hash() -> str:
    """Hash of the code and assets that decide a rollout.

    Returns:
        16 hexadecimal digits.
    """
    roots = {"seal_gym": _PACKAGE, "assets": asset("ur5_sealgun")}
    files = {
        f"{name}/{file.relative_to(root).as_posix()}": file
        for name, root in roots.items()
        for file in root.rglob("*")
        if file.suffix in (".py", ".xml", ".toml")
        and file != Path(__file__)
        # of the installed package: its own assets are counted under their own name
        and not (name == "seal_gym" and file.is_relative_to(root / "assets"))
    }
    return digest(files)


def entry(found: dict[str, dict[str, Rollout]]) -> dict[str, Any]:
    """What is shipped for a stack.

    Args:
        found: From ``rollouts``.

    Returns:
        Plain data for JSON.
    """
    also = {name: version(name) for name in ("python", "opencv-python-headless", "filterpy", "gymnasium")}
    return {
        "stack": stack(),
        "seal_gym": seal_gym.__version__,
        "code": code_hash(),
        "also": also | {"system": platform.system(), "cpu": _cpu()},
        "rollouts": {
            env_id: {quantity: row._asdict() for quantity, row in rows.items()}
            for env_id, rows in found.items()
        },
    }


def shipped(path: Path = HASHES) -> list[dict[str, Any]]:
    """The shipped entries.

    Args:
        path: The file.

    Returns:
        One for each stack; none if there is no file.
    """
    return list(json.loads(path.read_text(encoding="utf-8"))["entries"]) if path.exists() else []


def write_hashes(new: dict[str, Any], path: Path = HASHES) -> None:
    """Ships an entry; entries of this stack, and those made with other code, are dropped.

    Args:
        new: From ``entry``.
        path: The file.
    """
    kept = [e for e in shipped(path) if e["code"] == new["code"] and e["stack"] != new["stack"]]
    lines = ",\n  ".join(_entry_text(e) for e in [*kept, new])
    path.write_text(f'{{\n "entries": [\n  {lines}\n ]\n}}\n', encoding="utf-8")


def _entry_text(e: dict[str, Any]) -> str:
    """JSON with a line for each rollout, so that changes can be read as a diff."""
    head = ",\n   ".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in e.items() if k != "rollouts")
    ids = []
    for env_id, rows in e["rollouts"].items():
        lines = ",\n     ".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in rows.items())
        ids.append(f"{json.dumps(env_id)}: {{\n     {lines}\n    }}")
    body = ",\n    ".join(ids)
    return f'{{\n   {head},\n   "rollouts": {{\n    {body}\n   }}\n  }}'


def reference(entries: list[dict[str, Any]], here: dict[str, str]) -> dict[str, Any] | None:
    """The entry to compare with: of this MuJoCo release, the one with the most in common.

    Args:
        entries: The shipped ones.
        here: From ``stack``.

    Returns:
        The entry, None if there is none for this MuJoCo.
    """
    same_physics = [e for e in entries if e["stack"]["mujoco"] == here["mujoco"]]
    return max(same_physics, key=lambda e: sum(e["stack"][k] == v for k, v in here.items()), default=None)


class Verdict(NamedTuple):
    """How a rollout compares with the shipped one.

    Attributes:
        verdict: ``same`` to the bit, ``last bits``, ``different`` or ``unknown``.
        rms: Estimated root mean square of the difference, in the observation's units or grey levels; None
            where it cannot be told.
    """

    verdict: str
    rms: float | None


def compare(found: Rollout, ours: dict[str, Any] | None, quantity: str) -> Verdict:
    """Compares a rollout with the shipped one.

    Args:
        found: On this machine.
        ours: What was shipped, None if nothing was.
        quantity: Key of ``QUANTITIES``.

    Returns:
        The verdict.
    """
    if ours is None:
        return Verdict("unknown", None)
    if found.hash == ours["hash"]:
        return Verdict("same", 0.0)
    if found.steps != ours["steps"]:  # an episode ended sooner or later
        return Verdict("different", None)
    rms = float(np.sqrt(np.mean((np.array(found.sketch) - np.array(ours["sketch"])) ** 2)))
    return Verdict("last bits" if rms <= _LAST_BITS[quantity] else "different", rms)


MEANING = {
    "same": (
        "To the bit, runs are here what they are where the published numbers were made: the commands beside "
        "the numbers write the same rows again, where the numbers are of this version."
    ),
    "last bits": (
        "Runs differ here from the published ones by rounding only. Expect the published rates and the "
        "printed digits of RMSE and time; a trial on the border between two outcomes may end otherwise."
    ),
    "different": (
        "Runs differ here from the published ones. Do not set numbers from this machine against published "
        "ones: install the versions named above, or run every method that you compare here."
    ),
    "unknown": (
        "No rollouts are shipped for this MuJoCo release, so whether the published numbers hold here is not "
        "known: install a release named above, or run every method that you compare here."
    ),
    "broken": "An environment does not run: see the error above.",
}
_SEVERITY = ("same", "last bits", "unknown", "different", "broken")

# -- the report -------------------------------------------------------------------------------------------


def _import_without_gl() -> None:
    """Has MuJoCo imported without OpenGL: rollouts do not use it, and its absence would end the import."""
    if "mujoco" not in sys.modules:
        os.environ["MUJOCO_GL"] = "disabled"


def examine() -> dict[str, Any]:
    """Looks at everything.

    Returns:
        The report as plain data.
    """
    gl = check_gl()
    _import_without_gl()
    found, errors = rollouts()
    entries, here = shipped(), stack()
    ours = reference(entries, here)
    verdicts = {
        env_id: {
            quantity: compare(
                row, ours["rollouts"].get(env_id, {}).get(quantity) if ours else None, quantity
            )._asdict()
            for quantity, row in rows.items()
        }
        for env_id, rows in found.items()
    }
    seen = [v["verdict"] for rows in verdicts.values() for v in rows.values()] + ["broken"] * len(errors)
    overall = max(seen, key=_SEVERITY.index)
    listed = packages()
    return {
        "seal_gym": seal_gym.__version__,
        "system": f"{platform.system()} {platform.release()}",
        "cpu": _cpu(),
        "stack": here,
        "packages": [p._asdict() for p in listed],
        "gl": gl,
        "reference": None if ours is None else {k: v for k, v in ours.items() if k != "rollouts"},
        "same_code": ours is not None and ours["code"] == code_hash(),
        "shipped_mujoco": sorted({e["stack"]["mujoco"] for e in entries}),
        "rollouts": verdicts,
        "errors": errors,
        "verdict": overall,
        "meaning": MEANING[overall],
        "broken": bool(errors) or any(p.state == "missing" for p in listed),
    }


def _package_lines(report: dict[str, Any]) -> list[str]:
    notes = {
        "ok": "",
        "outside": "OUTSIDE the tested range",
        "unknown": "cannot tell",
        "missing": "MISSING: pip install seal-gym",
    }
    lines, absent = [], []
    for p in report["packages"]:
        if p["state"] == "absent":
            absent.append(p["name"])
            continue
        lines.append(
            f"  {p['name']:<24}{p['installed'] or '-':<14}{p['tested']:<16}{notes[p['state']]}".rstrip()
        )
    if absent:
        lines.append(f"  not installed, of the extras: {', '.join(absent)}")
    return ["Packages: installed, tested range", *lines]


def _gl_lines(gl: dict[str, Any]) -> list[str]:
    lines = [
        "Renderers",
        '  sensor images, renderer="raycast" (default): needs no OpenGL; every published number uses it',
    ]
    if not gl["works"]:
        return [
            *lines,
            f"  OpenGL does not work: {gl['error']}",
            '  Only pictures, videos and renderer="gl" need it. Debian, Ubuntu: apt-get install libegl1 '
            "libgl1 libgl1-mesa-dri",
        ]
    kind = "SOFTWARE, slow: no GPU is used" if gl["software"] else "hardware"
    lines.append(f"  OpenGL by {gl['backend']}: {gl['driver']} ({gl['vendor']}, {gl['version']}): {kind}")
    for key, name in (("picture", "picture of 640 x 480"), ("roi", "one ROI of 50 x 100")):
        plain, shadows = gl[f"{key}_plain_ms"], gl[f"{key}_shadows_ms"]
        lines.append(
            f"  {name}: {plain:.1f} ms, with shadows {shadows:.1f} ms: shadows cost {shadows / plain:.1f} x"
        )
    return lines


def _versions(pairs: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v}" for k, v in pairs.items())


def _reference_lines(report: dict[str, Any]) -> list[str]:
    ours = report["reference"]
    if ours is None:
        releases = ", ".join(report["shipped_mujoco"]) or "no release"
        return [f"  shipped for mujoco {releases}; here is mujoco {report['stack']['mujoco']}"]
    other = {k: v for k, v in ours["stack"].items() if report["stack"][k] != v}
    lines = [f"  shipped ones made with {_versions(ours['stack'])}"]
    if other:
        here = {k: report["stack"][k] for k in other}
        lines.append(f"  here instead {_versions(here)}")
    elif ours["also"]["cpu"] != report["cpu"]:
        lines.append(f"  and on another processor ({ours['also']['cpu']})")
    if not report["same_code"] and report["verdict"] != "same":
        lines.append("  and with other code or assets of seal_gym: a change of those may be the cause")
    return lines


def _rollout_lines(report: dict[str, Any]) -> list[str]:
    def cell(v: dict[str, Any]) -> str:
        return f"{v['verdict']} ({v['rms']:.0e})" if v["rms"] else str(v["verdict"])

    columns = list(QUANTITIES)
    lines = [f"  {'':<24}" + "".join(f"{c:<22}" for c in columns).rstrip()]
    for env_id, rows in report["rollouts"].items():
        lines.append(f"  {env_id:<24}" + "".join(f"{cell(rows[c]):<22}" for c in columns).rstrip())
    lines += [f"  {env_id:<24}BROKEN: {error}" for env_id, error in report["errors"].items()]
    notes = [f"  {name}: {text}" for name, text in QUANTITIES.items()]
    return [
        f"Rollouts of {len(_SEEDS)} x {_STEPS} steps against the shipped ones",
        *_reference_lines(report),
        *lines,
        *notes,
        "  in brackets: root mean square of the difference, in the observation's units or grey levels",
    ]


def text(report: dict[str, Any]) -> str:
    """The report for people.

    Args:
        report: From ``examine``.

    Returns:
        Some lines.
    """
    head = (
        f"seal_gym {report['seal_gym']} on {report['system']} ({report['stack']['machine']}), {report['cpu']}"
    )
    parts = [
        [head],
        _package_lines(report),
        _gl_lines(report["gl"]),
        _rollout_lines(report),
        [f"Verdict: {report['verdict']}", f"  {report['meaning']}"],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Examines this machine.

    Args:
        arguments: Without the program's name; the process's own by default.

    Returns:
        Exit status: 1 if a core package is missing or an environment does not run, else 0.
    """
    parser = argparse.ArgumentParser(
        prog="python -m seal_gym.doctor",
        description="What this machine can do, and whether the published numbers hold on it.",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument(
        "--write-hashes", action="store_true", help="ship this machine's rollouts as the reference"
    )
    parser.add_argument("--probe-gl", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.probe_gl:
        sys.stdout.write(json.dumps(probe_gl()) + "\n")
        return 0
    sys.stderr.write("looking (a first time compiles the kernels, which takes tens of seconds) ...\n")
    if options.write_hashes:
        _import_without_gl()
        found, errors = rollouts()
        for env_id, error in errors.items():
            sys.stderr.write(f"{env_id}: {error}\n")
        if errors:
            return 1
        write_hashes(entry(found))
        sys.stdout.write(f"written to {HASHES}: {_versions(stack())}\n")
        return 0
    report = examine()
    sys.stdout.write(json.dumps(report, indent=1) + "\n" if options.json else text(report))
    return int(report["broken"])


if __name__ == "__main__":
    sys.exit(main())
