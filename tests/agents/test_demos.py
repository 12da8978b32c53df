import hashlib
import json
import pickle
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from agents import demos
from agents.demos import DemonstrationError
from agents.episodes import Episode
from seal_gym.core.errors import SealGymError

STEPS = (5, 8, 3)


def episode(number, steps):
    rng = np.random.default_rng(number)

    def rows(n, size, dtype=np.float32):
        return rng.uniform(-1.0, 1.0, (n, size)).astype(dtype)

    return Episode(
        number=number,
        observations=rows(steps + 1, 35),
        tip=rows(steps, 6),
        rmp=rows(steps, 27),
        rewards=rows(steps, 1, np.float64)[:, 0],
        terminations=np.arange(steps) == steps - 1,
        truncations=np.zeros(steps, np.bool_),
        offset=rows(steps + 1, 6),
        tip_error_mm=rows(steps + 1, 1)[:, 0],
        info={"seed": number, "workpiece": "flat", "total_steps": steps},
    )


EPISODES = [episode(k, steps) for k, steps in enumerate(STEPS)]


@pytest.fixture
def folder(tmp_path):
    data = tmp_path / "data"
    data.mkdir()
    for e in EPISODES:
        demos.write_episode(data, e)
    assert demos.finish(data, len(EPISODES), {"dataset_id": "a-v0"}, {"command": "made up"}) == sum(STEPS)
    return tmp_path


def sign_again(data, k):
    """Makes the checksums fit, as one who forges a file would."""
    shard, path = data / str(k) / "part-0.arrow", data / str(k) / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["sha256"] = hashlib.sha256(shard.read_bytes()).hexdigest()
    path.write_text(json.dumps(metadata))
    whole = json.loads((data / "metadata.json").read_text())
    parts = [(data / str(i) / "metadata.json").read_bytes() for i in range(len(STEPS))]
    whole["seal_gym"]["sha256"] = hashlib.sha256(b"".join(parts)).hexdigest()
    (data / "metadata.json").write_text(json.dumps(whole))


def test_what_was_written_is_read(folder):
    read = demos.load(folder)
    np.testing.assert_array_equal(read.episodes, [[0, 5], [5, 13], [13, 16]])
    for e, (first, last) in zip(EPISODES, read.episodes, strict=True):
        np.testing.assert_array_equal(read.observations[first:last], e.observations[:-1])
        np.testing.assert_array_equal(read.final_observations[e.number], e.observations[-1])
        np.testing.assert_array_equal(read.actions("tip")[first:last], e.tip)
        np.testing.assert_array_equal(read.actions("rmp")[first:last], e.rmp)
        np.testing.assert_array_equal(read.infos["offset"][first:last], e.offset[:-1])
        np.testing.assert_array_equal(read.infos["tip_error_mm"][first:last], e.tip_error_mm[:-1])
    assert [m["seed"] for m in read.meta["episodes"]] == [0, 1, 2]
    assert read.meta["command"] == "made up"
    with pytest.raises(DemonstrationError, match=r"control = 'joint'.*rmp.*tip"):
        read.actions("joint")


def test_the_first_episodes_alone_are_read(folder):
    read = demos.load(folder / "data", episodes=2)
    assert len(read.observations) == 13
    assert len(read.meta["episodes"]) == 2
    for wrong in (0, 4, 1.5):
        with pytest.raises(DemonstrationError, match=r"episodes = .*1\.\.3"):
            demos.load(folder, episodes=wrong)


def test_an_episode_written_twice_is_the_same_file(folder):
    shard = folder / "data" / "1" / "part-0.arrow"
    before = shard.read_bytes()
    demos.write_episode(folder / "data", EPISODES[1])
    assert shard.read_bytes() == before
    assert not list((folder / "data").glob(".*"))


def truncated(data):
    shard = data / "1" / "part-0.arrow"
    shard.write_bytes(shard.read_bytes()[:-100])
    return "1/part-0.arrow: truncated or damaged"


def one_bit(data):
    shard = data / "2" / "part-0.arrow"
    raw = bytearray(shard.read_bytes())
    raw[len(raw) // 2] ^= 1
    shard.write_bytes(bytes(raw))
    return "2/part-0.arrow: truncated or damaged"


def no_shard(data):
    (data / "0" / "part-0.arrow").unlink()
    return "0/part-0.arrow: missing"


def other_columns(data):
    table = pa.table({"observations": [1.0, 2.0]})
    with pa.ipc.new_file(str(data / "1" / "part-0.arrow"), table.schema) as writer:
        writer.write_table(table)
    sign_again(data, 1)
    return "1/part-0.arrow: has other columns"


def no_arrow(data):
    (data / "1" / "part-0.arrow").write_bytes(b"ARROW1\0\0" + bytes(200))
    sign_again(data, 1)
    return "1/part-0.arrow: no readable Arrow file"


def too_few_rows(data):
    path = data / "1" / "metadata.json"
    path.write_text(path.read_text().replace('"total_steps": 8', '"total_steps": 9'))
    sign_again(data, 1)
    return "1/part-0.arrow: 9 rows where 10"


def beyond_the_limits(data):
    demos.write_episode(data, EPISODES[1]._replace(tip=np.full((8, 6), 1.5, np.float32)))
    sign_again(data, 1)
    return "1/part-0.arrow: tip are not finite or beyond"


def not_finite(data):
    demos.write_episode(data, EPISODES[2]._replace(observations=np.full((4, 35), np.nan, np.float32)))
    sign_again(data, 2)
    return "2/part-0.arrow: observations are not finite"


def edited_metadata(data):
    path = data / "1" / "metadata.json"
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 7'))
    return "data/metadata.json: its checksum"


def no_json(data):
    (data / "1" / "metadata.json").write_bytes(b"\x80\x04]")
    return "1/metadata.json: damaged or no JSON"


def a_list(data):
    (data / "metadata.json").write_text("[]")
    return "data/metadata.json: no JSON object"


def another_minari_dataset(data):
    (data / "metadata.json").write_text('{"total_episodes": 3, "data_format": "hdf5"}')
    return "data/metadata.json: a dataset, but not of agents.collect"


def another_format(data):
    path = data / "metadata.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    return "data/metadata.json: format 2, this version reads 1"


def a_huge_count(data):
    path = data / "metadata.json"
    path.write_text(path.read_text().replace('"total_episodes": 3', '"total_episodes": 3000000000'))
    return "data/metadata.json: total_episodes = 3000000000"


@pytest.mark.parametrize(
    "damage",
    [
        truncated,
        one_bit,
        no_shard,
        other_columns,
        no_arrow,
        too_few_rows,
        beyond_the_limits,
        not_finite,
        edited_metadata,
        no_json,
        a_list,
        another_minari_dataset,
        another_format,
        a_huge_count,
    ],
)
def test_damaged_and_foreign_files_are_named(folder, damage):
    message = damage(folder / "data")
    with pytest.raises(DemonstrationError, match=message) as caught:
        demos.load(folder)
    assert isinstance(caught.value, SealGymError)


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_pickle_in_a_shards_place_is_not_executed(folder, tmp_path):
    shard = folder / "data" / "1" / "part-0.arrow"
    shard.write_bytes(pickle.dumps(Bomb(tmp_path / "executed")))
    sign_again(folder / "data", 1)
    with pytest.raises(DemonstrationError, match="no readable Arrow file"):
        demos.load(folder)
    assert not (tmp_path / "executed").exists()


def test_what_is_not_there_or_not_complete_is_told_apart(tmp_path):
    with pytest.raises(DemonstrationError, match=r"no demonstrations here.*agents\.collect"):
        demos.load(tmp_path / "nowhere")
    (tmp_path / "data").mkdir()
    (tmp_path / "collect.json").write_text("{}")
    demos.write_episode(tmp_path / "data", EPISODES[0])
    with pytest.raises(DemonstrationError, match=r"not complete \(1 episodes so far\).*goes on"):
        demos.load(tmp_path)


def test_minari_reads_the_committed_sample_as_we_do():
    minari = pytest.importorskip("minari")
    ours = demos.load(demos.SAMPLE)
    theirs = minari.MinariDataset(demos.SAMPLE / "data")
    assert theirs.total_episodes == len(ours.episodes) == 2
    assert theirs.total_steps == len(ours.observations)
    for e, (first, last) in zip(theirs.iterate_episodes(), ours.episodes, strict=True):
        np.testing.assert_array_equal(e.observations[:-1], ours.observations[first:last])
        for control in ("tip", "rmp"):
            np.testing.assert_array_equal(e.actions[control], ours.actions(control)[first:last])
        np.testing.assert_array_equal(e.infos["offset"][:-1], ours.infos["offset"][first:last])
        assert theirs.action_space.contains({k: v[0] for k, v in e.actions.items()})
        assert theirs.observation_space.contains(e.observations[0])
        assert e.terminations[-1]
        assert not e.terminations[:-1].any()


def test_the_committed_sample_is_small_and_says_where_it_is_from():
    assert sum(f.stat().st_size for f in demos.SAMPLE.rglob("*") if f.is_file()) < 500_000
    meta = demos.load(demos.SAMPLE).meta
    assert meta["command"] == "python -m agents.collect --episodes 2 --seed 0"
    assert {"config", "stack", "code", "git_commit", "seed"} <= set(meta)
    assert [e["workpiece"] for e in meta["episodes"]] == ["flat", "cylinder"]
    assert [e["seed"] for e in meta["episodes"]] == [0, 1]
