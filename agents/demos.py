"""Demonstrations on disk: a Minari dataset in shards of one episode, and its reader.

A folder holds ``collect.json`` (what is being collected) and ``data/``, a Minari dataset of format "arrow":
``data/<k>/part-0.arrow`` and ``data/<k>/metadata.json`` for episode k, ``data/metadata.json`` once all are
there. Arrow files hold plain numbers: nothing in them is executed. Each shard's checksum stands in its
metadata, and the checksum of all metadata in the dataset's.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from agents.episodes import TWIST, Episode
from seal_gym.core.errors import SealGymError, require
from seal_gym.envs.adapters import RmpAdapter
from seal_gym.envs.core import FEATURES

Control = Literal["tip", "rmp"]

SAMPLE = Path(__file__).parent / "data" / "sample"
"""A few committed episodes, made by ``python -m agents.collect --episodes 2 --out agents/data/sample``."""
FORMAT = 1
SIZES: dict[str, int] = {"rmp": RmpAdapter.size, "tip": TWIST}
_SHARD, _METADATA = "part-0.arrow", "metadata.json"
_MAX_STEPS, _MAX_EPISODES, _MAX_BYTES = 100_000, 500_000, 100_000_000


class DemonstrationError(SealGymError, ValueError):
    """Demonstrations are missing, incomplete, damaged or not ours."""


def _rows(size: int) -> pa.DataType:
    return pa.list_(pa.float32(), size)


_SCHEMA = pa.schema(
    [
        ("observations", _rows(FEATURES)),
        ("actions", pa.struct([(name, _rows(size)) for name, size in SIZES.items()])),
        ("rewards", pa.float64()),
        ("terminations", pa.bool_()),
        ("truncations", pa.bool_()),
        (
            "infos",
            pa.struct(
                [
                    # Minari restores an info's shape from this.
                    pa.field("offset", _rows(TWIST), metadata={"shape": str(TWIST)}),
                    pa.field("tip_error_mm", pa.float32()),
                ]
            ),
        ),
    ]
)


# -- writing --------------------------------------------------------------------------------------------


def _fixed(values: NDArray[Any]) -> pa.Array:
    flat = np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=_rows(values.shape[1]))


def _pad(values: NDArray[Any]) -> NDArray[Any]:
    """One more row of zeros: Minari's tables give the last observation an action."""
    return np.concatenate((values, np.zeros_like(values[:1])))


def _shard(episode: Episode) -> bytes:
    actions = [_fixed(_pad(getattr(episode, name))) for name in SIZES]
    infos = [_fixed(episode.offset), pa.array(episode.tip_error_mm)]
    batch = pa.RecordBatch.from_arrays(
        [
            _fixed(episode.observations),
            pa.StructArray.from_arrays(actions, fields=list(_SCHEMA.field("actions").type)),
            pa.array(_pad(episode.rewards)),
            pa.array(_pad(episode.terminations)),
            pa.array(_pad(episode.truncations)),
            pa.StructArray.from_arrays(infos, fields=list(_SCHEMA.field("infos").type)),
        ],
        schema=_SCHEMA,
    )
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, _SCHEMA, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_batch(batch)
    return bytes(sink.getvalue())


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Writes a document in one go: readers see the old one or the new one.

    Args:
        path: The file.
        document: What JSON can hold.
    """
    draft = path.with_name(f".{path.name}.new")
    _write(draft, _json(document))
    draft.replace(path)


def _json(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def write_episode(data: Path, episode: Episode) -> None:
    """Adds an episode's shard; it is there whole or not at all, whenever the process is killed.

    Args:
        data: The folder of shards.
        episode: The episode.
    """
    content = _shard(episode)
    metadata = {
        "id": episode.number,
        **episode.info,
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    draft, final = data / f".{episode.number}.new", data / str(episode.number)
    for old in (draft, final):
        shutil.rmtree(old, ignore_errors=True)
    draft.mkdir()
    _write(draft / _SHARD, content)
    _write(draft / _METADATA, _json(metadata))
    draft.rename(final)


def has_episode(data: Path, index: int) -> bool:
    """Whether an episode's shard is there and whole.

    Args:
        data: The folder of shards.
        index: Number of the episode.

    Returns:
        False also for a damaged one: it is made again.
    """
    try:
        _checked_shard(data, index, _episode_metadata(data, index)[0])
    except DemonstrationError:
        return False
    return True


def finish(data: Path, episodes: int, dataset: Mapping[str, Any], meta: Mapping[str, Any]) -> int:
    """Makes a dataset of the shards.

    Args:
        data: The folder of shards 0 .. episodes - 1.
        episodes: Their number.
        dataset: Minari's entries.
        meta: Ours: how the data was made.

    Returns:
        Number of steps.
    """
    found = [_episode_metadata(data, k) for k in range(episodes)]
    steps = sum(int(m["total_steps"]) for m, _ in found)
    document = {
        "total_episodes": episodes,
        "total_steps": steps,
        "data_format": "arrow",
        **dataset,
        "seal_gym": {**meta, "format": FORMAT, "sha256": _digest([raw for _, raw in found])},
    }
    write_json(data / _METADATA, document)
    return steps


def _digest(parts: list[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


# -- reading --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Steps of all episodes, one after another.

    Attributes:
        observations: What the expert saw before each step, shape (n, 35), float32.
        episodes: First step of each episode and the one after its last, shape (episodes, 2).
        final_observations: What was seen at the end of each episode, shape (episodes, 35), float32.
        infos: ``offset`` (n, 6) in m/s and rad/s, and ``tip_error_mm`` (n,), before each step.
        meta: How the data was made, and ``episodes``: seed, part and metrics of each.
    """

    observations: NDArray[np.float32]
    episodes: NDArray[np.int64]
    final_observations: NDArray[np.float32]
    infos: dict[str, NDArray[np.float32]]
    meta: dict[str, Any]
    _actions: dict[str, NDArray[np.float32]] = field(repr=False)

    def actions(self, control: Control) -> NDArray[np.float32]:
        """The expert's actions in an action space.

        Args:
            control: ``"tip"`` or ``"rmp"``, as the environment's ``control``.

        Returns:
            Shape (n, 6) or (n, 27), in [-1, 1], float32.

        Raises:
            DemonstrationError: If there are none for it.
        """
        if control not in self._actions:
            raise DemonstrationError(f"control = {control!r}: must be one of {sorted(self._actions)}")
        return self._actions[control]


def load(path: str | Path, episodes: int | None = None) -> Demonstrations:
    """Reads demonstrations; checks all it reads and executes nothing of it.

    Args:
        path: The ``--out`` folder of ``python -m agents.collect``, or its ``data``.
        episodes: Read the first ones only; all by default.

    Returns:
        The demonstrations.

    Raises:
        DemonstrationError: If they are missing, incomplete, damaged or not ours; names the file and the fix.
    """
    data = _data_folder(Path(path))
    dataset = _dataset_metadata(data)
    total = dataset["total_episodes"]
    found = [_episode_metadata(data, k) for k in range(total)]
    ours = dataset["seal_gym"]
    require(
        _digest([raw for _, raw in found]) == ours.get("sha256"),
        f"{data / _METADATA}: its checksum is not that of the episodes' {_METADATA}: "
        "files were changed or mixed; collect the data again",
        DemonstrationError,
    )
    count = total if episodes is None else episodes
    require(
        isinstance(count, int) and 1 <= count <= total,
        f"episodes = {episodes!r}: must be a whole number in 1..{total}",
        DemonstrationError,
    )
    rows = [metadata for metadata, _ in found[:count]]
    ends = np.cumsum([int(m["total_steps"]) for m in rows])
    bounds = np.stack((np.concatenate(([0], ends[:-1])), ends), axis=1).astype(np.int64)
    return _read(data, rows, bounds, {k: v for k, v in ours.items() if k != "sha256"})


def _read(
    data: Path, rows: list[dict[str, Any]], bounds: NDArray[np.int64], meta: dict[str, Any]
) -> Demonstrations:
    n = int(bounds[-1, 1])
    observations = np.empty((n, FEATURES), np.float32)
    final = np.empty((len(rows), FEATURES), np.float32)
    actions = {name: np.empty((n, size), np.float32) for name, size in SIZES.items()}
    infos = {"offset": np.empty((n, TWIST), np.float32), "tip_error_mm": np.empty(n, np.float32)}
    for k, (metadata, (first, last)) in enumerate(zip(rows, bounds, strict=True)):
        batch = _batch(data, k, metadata)
        seen = _matrix(batch.column("observations"), FEATURES)
        observations[first:last], final[k] = seen[:-1], seen[-1]
        for name, size in SIZES.items():
            actions[name][first:last] = _matrix(batch.column("actions").field(name), size)[:-1]
        info = batch.column("infos")
        infos["offset"][first:last] = _matrix(info.field("offset"), TWIST)[:-1]
        infos["tip_error_mm"][first:last] = info.field("tip_error_mm").to_numpy()[:-1]
    for name, values in {"observations": observations, **actions}.items():
        bad = ~np.isfinite(values).all(axis=1)
        if name in SIZES:
            bad |= (np.abs(values) > 1.0).any(axis=1)
        if bad.any():
            k = int(np.searchsorted(bounds[:, 1], np.flatnonzero(bad)[0], side="right"))
            raise DemonstrationError(
                f"{_shard_path(data, k)}: {name} are not finite or beyond [-1, 1]: "
                "this was not written by agents.collect; collect the data again"
            )
    return Demonstrations(
        observations=observations,
        episodes=bounds,
        final_observations=final,
        infos=infos,
        meta={**meta, "episodes": rows},
        _actions=actions,
    )


def _matrix(column: pa.Array, size: int) -> NDArray[np.float32]:
    return np.asarray(column.flatten().to_numpy(), np.float32).reshape(-1, size)


def _data_folder(path: Path) -> Path:
    for folder in (path / "data", path):
        if (folder / _METADATA).is_file():
            return folder
    made = len([f for f in (path / "data").glob("*") if f.name.isdecimal()])
    if (path / "collect.json").is_file():
        raise DemonstrationError(
            f"{path}: the collection is not complete ({made} episodes so far): run the command in "
            f"{path / 'collect.json'} with --out {path}; it goes on where it stopped"
        )
    raise DemonstrationError(
        f"{path}: no demonstrations here; make some with python -m agents.collect --out {path}"
    )


def read_json(path: Path) -> tuple[dict[str, Any], bytes]:
    """A JSON object, and the bytes it was read from.

    Args:
        path: The file.

    Returns:
        Both.

    Raises:
        DemonstrationError: If the file is missing, too large or no JSON object.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DemonstrationError(f"{path}: larger than any of ours; collect the data again")
        raw = path.read_bytes()
        document = json.loads(raw)
    except FileNotFoundError:
        raise DemonstrationError(f"{path}: missing; run the collection again, it makes up for it") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DemonstrationError(
            f"{path}: damaged or no JSON ({error}); delete it and run the collection again"
        ) from None
    require(isinstance(document, dict), f"{path}: no JSON object; collect the data again", DemonstrationError)
    return document, raw


def _whole(document: dict[str, Any], key: str, high: int, path: Path) -> int:
    value = document.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= high:
        raise DemonstrationError(
            f"{path}: {key} = {value!r}: must be a whole number in 1..{high}; collect the data again"
        )
    return value


def _dataset_metadata(data: Path) -> dict[str, Any]:
    path = data / _METADATA
    document, _ = read_json(path)
    ours = document.get("seal_gym")
    if not isinstance(ours, dict) or document.get("data_format") != "arrow":
        raise DemonstrationError(
            f"{path}: a dataset, but not of agents.collect; collect one with python -m agents.collect"
        )
    require(
        ours.get("format") == FORMAT,
        f"{path}: format {ours.get('format')!r}, this version reads {FORMAT}; collect the data again",
        DemonstrationError,
    )
    _whole(document, "total_episodes", _MAX_EPISODES, path)
    return document


def _shard_path(data: Path, index: int) -> Path:
    return data / str(index) / _SHARD


def _episode_metadata(data: Path, index: int) -> tuple[dict[str, Any], bytes]:
    path = data / str(index) / _METADATA
    document, raw = read_json(path)
    _whole(document, "total_steps", _MAX_STEPS, path)
    require(
        document.get("id") == index,
        f"{path}: id = {document.get('id')!r}, must be {index}: run the collection again",
        DemonstrationError,
    )
    return document, raw


def _checked_shard(data: Path, index: int, metadata: dict[str, Any]) -> bytes:
    path = _shard_path(data, index)
    require(
        path.is_file() and path.stat().st_size <= _MAX_BYTES,
        f"{path}: missing or not a shard; run the collection again, it makes up for it",
        DemonstrationError,
    )
    raw = path.read_bytes()
    require(
        hashlib.sha256(raw).hexdigest() == metadata.get("sha256"),
        f"{path}: truncated or damaged: its checksum is not the one in {_METADATA}; run the collection "
        "again, it replaces such files",
        DemonstrationError,
    )
    return raw


def _batch(data: Path, index: int, metadata: dict[str, Any]) -> pa.RecordBatch:
    path, raw = _shard_path(data, index), _checked_shard(data, index, metadata)
    try:
        with pa.ipc.open_file(pa.BufferReader(raw)) as reader:
            require(
                reader.schema.equals(_SCHEMA) and reader.num_record_batches == 1,
                f"{path}: has other columns than agents.collect writes; collect the data again",
                DemonstrationError,
            )
            batch = reader.get_batch(0)
            batch.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise DemonstrationError(
            f"{path}: no readable Arrow file ({error}); run the collection again"
        ) from None
    require(
        batch.num_rows == metadata["total_steps"] + 1 and not any(c.null_count for c in batch.columns),
        f"{path}: {batch.num_rows} rows where {metadata['total_steps'] + 1} full ones belong; "
        "run the collection again",
        DemonstrationError,
    )
    return batch
