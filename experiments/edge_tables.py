"""Files of the edge experiments: rows of any columns as JSON, CSV and Markdown, and a log to resume from."""

import csv
import json
import shlex
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import seal_gym
from agents.provenance import commit
from experiments import results, trials

Row = dict[str, Any]


class Log:
    """Rows of earlier calls with the same code, one JSON line each: a stopped run goes on where it was.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, list[Row]] = {}
        code = trials.code()
        self._code = code
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue  # the line a killed run was writing
            if entry["code"] == code:
                self._rows[entry["key"]] = entry["rows"]

    def get(self, key: Row, make: Callable[[], list[Row]]) -> list[Row]:
        """Rows of the log, or new ones, which are then logged.

        Args:
            key: What decides the rows.
            make: Makes them.

        Returns:
            The rows, as JSON gives them back.
        """
        name = json.dumps(key, sort_keys=True)
        if name not in self._rows:
            text = json.dumps({"code": self._code, "key": name, "rows": make()})
            self._rows[name] = json.loads(text)["rows"]
            with self._path.open("a", encoding="utf-8") as file:
                file.write(text + "\n")
        return self._rows[name]


def text(value: object) -> str:
    """A cell of a table for people.

    Args:
        value: A number, a word, an interval or None.

    Returns:
        Its text.
    """
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(text(v) for v in value) + "]"
    if isinstance(value, dict):
        return ", ".join(f"{k} {v:g}" if isinstance(v, float | int) else f"{k} {v}" for k, v in value.items())
    return str(value)


def markdown(rows: Iterable[Row], columns: dict[str, str]) -> str:
    """A table.

    Args:
        rows: The rows.
        columns: Heading by key.

    Returns:
        Markdown.
    """
    body = [[text(row.get(k)) for k in columns] for row in rows]
    lines = [list(columns.values()), ["---"] * len(columns), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _rounded(value: Any) -> Any:
    """Five digits are more than any figure here is good for."""
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return value


def write(out: Path, name: str, arguments: list[str], rows: list[Row], document: Row, page: str) -> None:
    """Writes ``<name>.json``, ``.csv`` and ``.md``.

    Args:
        out: The folder.
        name: Of the experiment.
        arguments: Of the command line.
        rows: The table.
        document: More for the JSON file.
        page: The Markdown page.
    """
    rows = _rounded(rows)
    head = {
        "name": name,
        "version": seal_gym.__version__,
        "command": shlex.join(["python", "-m", f"experiments.{name}", *arguments]),
        "git_commit": commit(),
        "stack": results.stack(),
        "renderer": "raycast",
        "regime": "static",
    }
    whole = results.document_text({**head, **document, "rows": rows})
    (out / f"{name}.json").write_text(whole, encoding="utf-8")
    keys = list(dict.fromkeys(k for row in rows for k in row))
    with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=keys, restval="")
        writer.writeheader()
        writer.writerows(rows)
    (out / f"{name}.md").write_text(page + "\n", encoding="utf-8")


def command_line(arguments: list[str] | None) -> list[str]:
    """The arguments of a command, given or the process's own.

    Args:
        arguments: Without the program's name, or None.

    Returns:
        The same.
    """
    return sys.argv[1:] if arguments is None else arguments
