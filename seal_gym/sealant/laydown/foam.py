"""OpenFOAM from Python: finding it, its text format, running a solver."""

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.config import LaydownError

_FIELD_TYPES = {1: "scalar", 3: "vector"}
_LIST = re.compile(r"nonuniform\s+List<(scalar|vector)>\s*(\d+)\s*\(", re.S)
_DEBIAN_PROJECT = "/usr/share/openfoam"  # its package sets no environment, without which etc/ is not found
_UNIFORM = re.compile(r"internalField\s+uniform\s+([^;]+);")

Entry = str | float | int | Mapping[str, "Entry"]


def find(program: str) -> Path:
    """Finds one of OpenFOAM's programs.

    Args:
        program: Its name.

    Returns:
        Its path.

    Raises:
        LaydownError: If it is not installed, with the command that installs it.
    """
    path = shutil.which(program)
    if path is None:
        raise LaydownError(
            f"OpenFOAM's {program} is not installed; the laydown reference needs it and nothing else does. "
            "On Debian and Ubuntu: apt-get install openfoam"
        )
    return Path(path)


def header(cls: str, name: str) -> str:
    """The head of an OpenFOAM file.

    Args:
        cls: Class of its content.
        name: Of the object.

    Returns:
        Text.
    """
    return f"FoamFile {{ version 2.0; format ascii; class {cls}; object {name}; }}\n"


def dictionary(entries: Mapping[str, Entry], depth: int = 0) -> str:
    """A dictionary in OpenFOAM's notation.

    Args:
        entries: Values and dictionaries by keyword.
        depth: Of indentation.

    Returns:
        Text.
    """
    pad = "    " * depth
    lines = []
    for key, value in entries.items():
        if isinstance(value, Mapping):
            lines.append(f"{pad}{key}\n{pad}{{\n{dictionary(value, depth + 1)}{pad}}}\n")
        else:
            text = f"{value:.10g}" if isinstance(value, float) else str(value)
            lines.append(f"{pad}{key} {text};\n")
    return "".join(lines)


def values(array: Array) -> str:
    """A list of scalars or vectors in OpenFOAM's notation.

    Args:
        array: Shape (n,) or (n, 3).

    Returns:
        Text, ten digits each.
    """
    if array.ndim == 1:
        body = "\n".join("0" if v == 0 else f"{v:.10g}" for v in array.tolist())
    else:
        rows = array.tolist()
        body = "\n".join("({:.10g} {:.10g} {:.10g})".format(*v) if any(v) else "(0 0 0)" for v in rows)
    return f"{len(array)}\n(\n{body}\n)\n"


def read_field(path: Path, cells: int) -> Array:
    """The internal values of a field written in ASCII.

    Args:
        path: The field's file.
        cells: How many the mesh has.

    Returns:
        Shape (cells,) for a scalar, (cells, 3) for a vector.

    Raises:
        LaydownError: If the file is missing or holds something else.
    """
    if not path.is_file():
        raise LaydownError(f"{path}: not written; the solver did not come to its end")
    text = path.read_text(encoding="utf-8")
    uniform = _UNIFORM.search(text)
    if uniform:
        numbers = np.array(uniform[1].strip(" ()").split(), dtype=float)
        return np.full(cells, numbers[0]) if len(numbers) == 1 else np.tile(numbers, (cells, 1))
    found = _LIST.search(text)
    width = {name: n for n, name in _FIELD_TYPES.items()}[found[1]] if found else 0
    end = text.find("\n)", found.end()) if found else -1
    if found is None or end < 0:
        raise LaydownError(f"{path}: holds no ASCII list of scalars or vectors")
    numbers = np.array(text[found.end() : end].replace("(", " ").replace(")", " ").split(), dtype=float)
    if len(numbers) != cells * width:
        raise LaydownError(f"{path}: {len(numbers)} numbers for {cells} cells of {width}: of another mesh?")
    return numbers if width == 1 else numbers.reshape(cells, width)


def run(program: str, case: Path, *, limit_s: float) -> float:
    """Runs a solver in a case folder; its output goes to ``log.<program>`` there.

    Args:
        program: Its name.
        case: The folder.
        limit_s: Wall-clock time after which it is stopped [s].

    Returns:
        The processor time it took [s].

    Raises:
        LaydownError: If it is not installed, fails, or takes too long.
    """
    path, log = find(program), case / f"log.{program}"
    environment = {"WM_PROJECT_DIR": _DEBIAN_PROJECT, **os.environ}
    before = os.times()
    with log.open("w", encoding="utf-8") as file:
        process = subprocess.Popen(
            [path, "-case", case],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            status = process.wait(timeout=limit_s)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise LaydownError(f"{program} took more than {limit_s:g} s: see {log}") from error
            raise
    if status != 0:
        tail = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-15:])
        raise LaydownError(f"{program} ended with status {status}, its last lines (all in {log}):\n{tail}")
    after = os.times()
    took = after.children_user + after.children_system - before.children_user - before.children_system
    return max(took, 0.0)  # differences of large sums may round below
