import os
import signal
import subprocess
import sys
import time
from itertools import groupby
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats

import seal_gym  # noqa: F401  # registers the ids
from agents import collect, demos, episodes, remote
from agents.episodes import CollectCfg, DisturbedAdapter, Work
from agents.expert import RmpExpert
from seal_gym.core.errors import ConfigError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import SealCore
from tests.agents.test_demos import episode

ROOT = Path(__file__).resolve().parents[2]
FRAME_S = 1.0 / 30.0
X, Z, ABOUT_X, ABOUT_Z = 0, 2, 3, 5
STILL = CollectCfg(offset_m_s=0.0, rate_rad_s=0.0)


def holds(column):
    """Values of a piecewise constant column and how long each lasts, but for the last, which is cut."""
    runs = [(value, len(list(run))) for value, run in groupby(column.tolist())][:-1]
    return np.array([v for v, _ in runs]), np.array([n for _, n in runs])


def files(folder):
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def command(out, *more):
    arguments = ["--episodes", "4", "--out", str(out), *more]
    return [sys.executable, "-m", "agents.collect", *arguments]


# -- the disturbance ------------------------------------------------------------------------------------


def test_each_offset_is_uniform_and_lasts_as_in_the_paper():
    # With room for any drift the paper's distributions are left as they are printed.
    drawn = episodes.offsets(np.random.default_rng(0), 120_000, FRAME_S, CollectCfg(drift_m=0.1))
    assert not drawn[:, [1, 4]].any()
    bounds = {X: 0.01, Z: 0.01, ABOUT_X: np.deg2rad(10.0), ABOUT_Z: np.deg2rad(10.0)}
    for axis, bound in bounds.items():
        values, frames = holds(drawn[:, axis])
        assert len(values) > 5000
        assert stats.kstest(values, stats.uniform(-bound, 2 * bound).cdf).pvalue > 1e-3
        assert frames.min() == 9  # 0.3 s
        assert frames.max() == 30  # 1 s
        assert frames.mean() == pytest.approx(19.5, abs=0.3)
    steps = [np.flatnonzero(np.diff(drawn[:, axis])) for axis in bounds]
    assert len(set(steps[0]) & set(steps[1])) < 0.1 * len(steps[0])  # each axis has its own


def test_offsets_on_x_and_z_never_add_up_to_contact_and_rotations_stay_uniform():
    drawn = episodes.offsets(np.random.default_rng(1), 120_000, FRAME_S, CollectCfg())
    # A lasting offset w settles at 16.8 / 12^2 w = 0.1167 s w; z points away from wall and plate.
    drift = (np.abs(drawn[:, X]) - drawn[:, Z]) * 16.8 / 144.0
    assert drift.max() <= 0.9e-3 + 1e-12
    assert drift.max() > 0.85e-3
    for axis, highest in ((X, 0.01), (Z, 0.01)):
        assert np.abs(drawn[:, axis]).max() == pytest.approx(highest, rel=0.01)
    for axis in (ABOUT_X, ABOUT_Z):
        values, frames = holds(drawn[:, axis])
        assert stats.kstest(values, stats.uniform(-np.deg2rad(10), np.deg2rad(20)).cdf).pvalue > 1e-3
    for axis in (X, Z):
        _, frames = holds(drawn[:, axis])
        assert (frames.min(), frames.max()) == (9, 30)


@pytest.mark.parametrize(
    ("axis", "size", "column", "unit"),
    [(X, 5e-3, 0, 1e3), (Z, 5e-3, 3, 1e3), (ABOUT_X, 0.1, 4, 57.3), (ABOUT_Z, -0.1, 1, 57.3)],
)
def test_the_gun_leaves_at_the_offset_and_is_held_where_the_leaves_balance_it(axis, size, column, unit):
    core = SealCore(SealCfg.of(workpiece="flat", perception="oracle", control="rmp"), 1)
    core.adapter = adapter = DisturbedAdapter(core.cfg.cell)
    core.reset(0, np.random.default_rng(0))
    expert, seen = RmpExpert(), core.observe()
    offset = np.zeros((1, 6))
    speed = []
    for t in range(190):
        if t == 150:
            offset[0, axis] = size
        adapter.drift(offset.copy())
        core.step(expert.predict(seen)[0])
        seen = core.observe()
        speed.append(seen[0, 11 + axis])
    # At once the tip drifts at the offset's speed ...
    assert np.abs(speed[140:150]).max() < 0.02 * unit * abs(size)
    assert np.mean(speed[150:152]) == pytest.approx(unit * size, rel=0.15)
    # ... until the spring w = 0.5 (stiffness 216), of 0.75 with damping (16.8), plus 0.05 of regularisation,
    # outweighs 16.8 times the offset: 16.8 / 144 * 0.8 / 0.75 = 0.1244 s times it.
    if abs(size) < 0.05:
        assert abs(seen[0, column]) == pytest.approx(0.1244 * unit * abs(size), rel=0.03)
    # An angle weighs more from 2 deg on; at 0.7 deg a little.
    assert abs(seen[0, column]) == pytest.approx(0.1244 * unit * abs(size), rel=0.15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset_m_s": 10.0}, r"offset_m_s = 10\.0.*0\.\.0\.1.*unit"),
        ({"rate_rad_s": float("nan")}, "rate_rad_s = nan"),
        ({"duration_s": (1.0, 0.3)}, r"duration_s = \(1\.0, 0\.3\)"),
        ({"workpieces": ("cone",)}, r"workpieces = \('cone',\).*flat"),
        ({"workpieces": ()}, r"workpieces = \(\)"),
    ],
)
def test_ranges_are_checked(change, message):
    with pytest.raises(ConfigError, match=message):
        CollectCfg(**change)


# -- the labels -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Four episodes collected in one go by one process."""
    out = tmp_path_factory.mktemp("reference") / "demos"
    assert collect.main(["--episodes", "4", "--out", str(out)]) == 0
    return out


def test_labels_are_the_experts_at_each_state(reference):
    data = demos.load(reference)
    expert, _ = RmpExpert().predict(data.observations)
    np.testing.assert_array_equal(data.actions("rmp"), expert)
    assert np.abs(data.infos["offset"]).max() > 0.15  # while the gun was disturbed


def test_an_episode_starts_as_the_environment_with_its_seed(reference):
    data = demos.load(reference)
    for k, part in enumerate(["Flat", "Cylinder", "Flat", "Cylinder"]):
        env = gym.make(f"SealGym/{part}-v0", control="rmp")
        np.testing.assert_array_equal(env.reset(seed=k)[0], data.observations[data.episodes[k, 0]])
        env.close()


def test_the_tip_label_moves_the_gun_as_the_experts_rmp_does():
    """In a ``tip`` environment the labels are the motion of the ``rmp`` environment."""
    envs = {c: gym.make("SealGym/Flat-v0", control=c, perception="oracle") for c in ("tip", "rmp")}
    label = DisturbedAdapter(envs["rmp"].unwrapped.core.cfg.cell)
    own = envs["rmp"].unwrapped.core.adapter
    seen = {c: env.reset(seed=3)[0] for c, env in envs.items()}
    expert = RmpExpert()

    class Spy:
        size = 27

        def __call__(self, action, state):
            label(action, state)
            return own(action, state)

    envs["rmp"].unwrapped.core.adapter = Spy()
    for _ in range(120):
        action, _ = expert.predict(seen["rmp"])
        seen["rmp"] = envs["rmp"].step(action)[0]
        seen["tip"] = envs["tip"].step(label.label[0])[0]
        np.testing.assert_allclose(seen["tip"][23:29], seen["rmp"][23:29], atol=2e-6)
    assert np.abs(seen["rmp"][23:29] - envs["rmp"].reset(seed=3)[0][23:29]).max() > 0.01  # it did move
    for env in envs.values():
        env.close()


def test_undisturbed_episodes_are_those_of_the_expert_in_the_environment():
    (e,) = episodes.run(Work(indices=(1,), seed=70, cfg=STILL))
    assert not e.offset.any()
    env = gym.make("SealGym/Cylinder-v0", control="rmp")
    seen, _ = env.reset(seed=71)
    expert = RmpExpert()
    for t in range(60):
        np.testing.assert_allclose(seen, e.observations[t], atol=1e-3)
        seen = env.step(expert.predict(seen)[0])[0]
    env.close()
    assert e.info["outcome"] == "reached"
    assert e.info["rmse_mm"] < 0.2


# -- the same data, however it is collected -------------------------------------------------------------


def test_an_episode_is_the_same_in_any_company(reference):
    data = demos.load(reference)
    for e in episodes.run(Work(indices=(2, 0))):
        first, last = data.episodes[e.number]
        np.testing.assert_array_equal(e.observations[:-1], data.observations[first:last])
        np.testing.assert_array_equal(e.tip, data.actions("tip")[first:last])
        np.testing.assert_array_equal(e.rmp, data.actions("rmp")[first:last])


def children(pid):
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(p) for p in found] + [q for p in found for q in children(int(p))]


def wait_for(condition, seconds):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for processes as Linux shows them")
def test_killed_and_started_again_with_two_jobs_it_ends_with_the_same_files(reference, tmp_path):
    out = tmp_path / "demos"
    run = subprocess.Popen(command(out, "--jobs", "2"), cwd=ROOT, stderr=subprocess.DEVNULL)
    wait_for(lambda: any((out / "data").glob("[0-9]*")), 300)
    workers = children(run.pid)
    run.send_signal(signal.SIGKILL)
    run.wait()
    kept = {k: v for k, v in files(out).items() if "/." not in k}
    assert any(name.endswith(".arrow") for name in kept)
    assert not (out / "data" / "metadata.json").exists()
    assert len(workers) >= 2
    wait_for(lambda: not any(Path(f"/proc/{p}/cmdline").exists() for p in workers), 60)

    # Torn shards, as a full disk leaves them, are made again; whole ones stay.
    (out / "data" / ".3.new").mkdir(exist_ok=True)
    again = subprocess.run(command(out, "--jobs", "2"), cwd=ROOT, capture_output=True, text=True, check=True)
    assert f"{len([k for k in kept if k.endswith('.arrow')])}/4" in again.stderr  # the bar starts there
    whole = files(out)
    assert {k: whole[k] for k in kept} == kept
    assert whole == files(reference)


# -- the command ----------------------------------------------------------------------------------------


def fake(work, units):
    for unit in units:
        yield unit, [episode(k, 5 + k) for k in unit.indices]


def gather(out, count, cfg=STILL, engine=fake, seed=0):
    return collect.collect(out, collect.plan(count, seed, cfg), cfg, engine)


def test_a_damaged_shard_is_made_again(tmp_path):
    gather(tmp_path / "a", 3)
    before = files(tmp_path / "a")
    shard = tmp_path / "a" / "data" / "1" / "part-0.arrow"
    shard.write_bytes(shard.read_bytes()[:50])
    ran = []

    def engine(work, units):
        ran.extend(k for u in units for k in u.indices)
        yield from fake(work, units)

    gather(tmp_path / "a", 3, engine=engine)
    assert ran == [1]
    assert files(tmp_path / "a") == before


def test_more_episodes_are_added_to_those_there_are(tmp_path):
    gather(tmp_path / "a", 2)
    gather(tmp_path / "a", 5)
    gather(tmp_path / "b", 5)
    assert files(tmp_path / "a") == files(tmp_path / "b")
    with pytest.raises(ConfigError, match=r"--episodes 3: .*begun with 5"):
        gather(tmp_path / "a", 3)


def test_a_stop_between_episodes_loses_none(tmp_path):
    def stopped(work, units):
        yield from fake(work, units[:2])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gather(tmp_path / "a", 4, engine=stopped)
    assert sorted(f.name for f in (tmp_path / "a" / "data").iterdir()) == ["0", "1"]


def test_another_configuration_or_code_is_refused(tmp_path, monkeypatch):
    gather(tmp_path / "a", 2)
    with pytest.raises(ConfigError, match="begun with config"):
        gather(tmp_path / "a", 2, cfg=CollectCfg())
    with pytest.raises(ConfigError, match="begun with seed = 0, now it is 9"):
        gather(tmp_path / "a", 2, seed=9)
    monkeypatch.setattr(collect, "code_hash", lambda: "another")
    with pytest.raises(ConfigError, match=r"begun with code.*choose another folder"):
        gather(tmp_path / "a", 2)


def test_a_folder_with_something_else_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("x")
    assert collect.main(["--episodes", "1", "--out", str(tmp_path)]) == 1
    assert "thesis.txt" in capsys.readouterr().err
    assert [f.name for f in tmp_path.iterdir()] == ["thesis.txt"]


def test_two_collections_do_not_write_into_one_folder(tmp_path):
    def second(work, units):
        with pytest.raises(ConfigError, match="another collection"):
            gather(tmp_path / "a", 2)
        yield from fake(work, units)

    gather(tmp_path / "a", 2, engine=second)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "499999", "--episodes", "2"], "--seed 499999.*training seeds are 0..499999"),
        (["--address", "auto"], "--address and --send-code: only with --engine ray"),
        (["--send-code"], "--address and --send-code: only with --engine ray"),
    ],
)
def test_wrong_arguments_are_explained(tmp_path, capsys, arguments, message):
    assert collect.main(["--out", str(tmp_path / "a"), *arguments]) == 1
    assert message.split(".*")[0] in (said := capsys.readouterr().err)
    assert message.split(".*")[-1] in said
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("text", ["0", "-3", "two", "1.5"])
def test_numbers_are_checked(text, capsys):
    with pytest.raises(SystemExit):
        collect.main(["--out", "nowhere", "--episodes", text])
    assert "must be a whole number, at least 1" in capsys.readouterr().err


def test_episodes_alternate_between_the_parts_and_units_never_mix_them():
    units = collect.works(list(range(10)), 3, 0, CollectCfg())
    assert sorted(k for u in units for k in u.indices) == list(range(10))
    for unit in units:
        assert {k % 2 for k in unit.indices} == {0 if unit.workpiece == "flat" else 1}
        assert len(unit.indices) <= 3


# -- Ray ------------------------------------------------------------------------------------------------


RAY = """
import sys, threading, time
from pathlib import Path
from ray.cluster_utils import Cluster
out = Path(sys.argv[1])
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]

def kill():
    while not any((out / "data").glob("[0-9]*")):
        time.sleep(0.05)
    cluster.remove_node(nodes[1], allow_graceful=False)
    print("killed a worker", len(list((out / "data").glob("[0-9]*"))), flush=True)

threading.Thread(target=kill, daemon=True).start()
from agents import collect
status = collect.main(
    ["--episodes", "4", "--out", str(out), "--engine", "ray", "--address", cluster.address]
)
print("status", status, flush=True)
cluster.shutdown()
"""


def test_a_node_with_other_code_is_refused():
    with pytest.raises(ConfigError, match=r"this node's code .* is not the caller's \(0123\)"):
        remote.run_checked(len, Work(indices=(0,)), collect.code_hash, "0123")


@pytest.mark.slow
def test_on_a_ray_cluster_that_loses_a_worker_the_files_are_the_same(reference, tmp_path):
    pytest.importorskip("ray")
    out = tmp_path / "demos"
    run = subprocess.run(
        [sys.executable, "-c", RAY, str(out)],
        cwd=ROOT,
        env={
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_raylet_start_wait_time_s": "300",  # starting takes longer where others compute too
        },
        capture_output=True,
        text=True,
        timeout=1500,
        check=False,
    )
    assert "status 0" in run.stdout, run.stderr[-3000:]
    assert "killed a worker" in run.stdout
    assert files(out) == files(reference)
