import json

import numpy as np
import pytest

import agents
from agents import engines
from agents.expert import RmpExpert
from agents.policies import LearnedPolicy, save
from experiments import shapes, trials
from seal_gym.core.errors import SeamError

SHORT = {"perception": "oracle"}


def write_seam(path, length=0.06):
    c = np.sqrt(0.5)
    rows = [f"{x:.4f},0,0,0,{-c:.4f},{c:.4f}" for x in np.linspace(-length / 2, length / 2, 3)]
    path.write_text("# a short one\nx,y,z,ax,ay,az\n" + "\n".join(rows) + "\n")
    return str(path)


def test_reads_points_and_unit_directions(tmp_path):
    points, approach = trials.read_seam(trials.Path(write_seam(tmp_path / "a.csv")))
    np.testing.assert_allclose(points[:, 0], [-0.03, 0.0, 0.03])
    np.testing.assert_allclose(np.linalg.norm(approach, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [("0,0,0,0,0\n", "line 1.*six numbers"), ("0,0,0,0,0,1\n1,2,x,0,0,1\n", "line 2.*six numbers")],
)
def test_a_bad_row_is_named(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(SeamError, match=message):
        trials.read_seam(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SeamError, match=r"nowhere\.csv"):
        trials.read_seam(tmp_path / "nowhere.csv")


def test_trials_resume_and_do_not_depend_on_the_number_of_jobs(tmp_path):
    seam = write_seam(tmp_path / "short.csv")
    wanted = [trials.Trial(method="rmp_expert", workpiece=seam, seed=s, env=SHORT) for s in (5, 6, 7)]
    log = tmp_path / "log.jsonl"
    rows = trials.run_all(wanted, engine=engines.local(1), log=log, title="t")
    assert [r["outcome"] for r in rows] == ["reached"] * 3
    assert [r["seed"] for r in rows] == [5, 6, 7]

    # Killed while writing the last line: that trial alone runs again, and comes out the same.
    lines = log.read_text().splitlines()
    marked = json.loads(lines[0])
    marked["rmse_mm"] = 123.0
    log.write_text("\n".join([json.dumps(marked), lines[1], lines[2][:40]]) + "\n")
    again = trials.run_all(wanted, engine=engines.local(2), log=log, title="t")
    assert again[0]["rmse_mm"] == 123.0
    assert again[1:] == rows[1:]

    fresh = trials.run_all(wanted, engine=engines.local(2), log=tmp_path / "other.jsonl", title="t")
    assert fresh == rows


def test_rows_of_other_code_are_run_again(tmp_path):
    wanted = [trials.Trial(method="rmp_expert", workpiece=write_seam(tmp_path / "s.csv"), seed=1, env=SHORT)]
    log = tmp_path / "log.jsonl"
    (row,) = trials.run_all(wanted, engine=engines.local(1), log=log, title="t")
    stale = json.loads(log.read_text())
    stale["rmse_mm"], stale["code"] = 77.0, "another"
    log.write_text(json.dumps(stale) + "\n")
    assert trials.run_all(wanted, engine=engines.local(1), log=log, title="t") == [row]


@pytest.mark.parametrize("first", ["nan,0,0,0,-0.7071,0.7071", "0.O,0,0,0,-0.7071,0.7071"])
def test_a_bad_first_row_is_no_header(tmp_path, first):
    path = tmp_path / "bad.csv"
    path.write_text(f"{first}\n0.1,0,0,0,-0.7071,0.7071\n0.2,0,0,0,-0.7071,0.7071\n")
    with pytest.raises(SeamError, match=r"line 1|not finite"):
        trials.workpiece(str(path))


def test_a_seam_file_may_come_from_a_spreadsheet_but_not_be_empty(tmp_path):
    path = tmp_path / "bom.csv"
    path.write_bytes(b"\xef\xbb\xbf0,0,0,0,0,1\r\n0.1,0,0,0,0,1\r\n")
    assert len(trials.read_seam(path)[0]) == 2
    path.write_text("x,y,z,ax,ay,az\n")
    with pytest.raises(SeamError, match=r"bom\.csv' has 0 points"):
        trials.read_seam(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SeamError, match="no text file"):
        trials.read_seam(path)


class Counting:
    """The expert, counting the frames of each row's episode in its state."""

    control = "rmp"

    def __init__(self):
        self.expert, self.counts = RmpExpert(), []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        state = np.zeros(len(observation), int) if state is None else state
        state = np.where(episode_start, 0, state + 1)
        self.counts.append(state)
        return self.expert.predict(observation)[0], state


def test_a_batch_is_its_single_trials_to_the_bit(tmp_path, monkeypatch):
    seam = write_seam(tmp_path / "short.csv")
    wanted = [trials.Trial(method="rmp_expert", workpiece=seam, seed=s, env=SHORT) for s in range(7)]
    alone = [trials.run(t) for t in wanted]
    counting = Counting()
    monkeypatch.setattr(agents, "load_policy", lambda name, env=None: counting)
    together = trials.run_together(wanted)
    for row in together:
        path = np.array(row.pop("path_mm"))
        assert path.shape[1] == 3
        assert path[-1, 0] == pytest.approx(30.0, abs=0.5)  # the seam's end in the part's frame [mm]
    assert together == alone
    # Each row's memory begins anew with each of its trials.
    frames = [round(30 * row["time_s"]) for row in alone]
    counts = np.array(counting.counts)
    assert (counts == 0).sum() >= 7
    assert counts.max() == max(frames) - 1


def test_the_code_of_a_method_knows_its_own_weights_and_no_others(tmp_path, monkeypatch):
    monkeypatch.setattr(agents, "WEIGHTS", tmp_path)
    names = ("neural_rmp", "neural_control", "neural_rmp_identity")
    for name in names:
        save(LearnedPolicy.fresh(name, 0), tmp_path / f"{name}.safetensors", {"seed": 0})

    def codes():
        trials.code_of.cache_clear()
        return {name: trials.code_of(name) for name in (*names, "rmp_expert")}

    before = codes()
    assert len(set(before.values())) == 4
    save(LearnedPolicy.fresh("neural_rmp", 1), tmp_path / "neural_rmp.safetensors", {"seed": 1})
    save(LearnedPolicy.fresh("neural_rmp", 1), tmp_path / "neural_rmp-seed1.safetensors", {"seed": 1})
    after = codes()
    assert {name for name in before if before[name] != after[name]} == {"neural_rmp"}
    (tmp_path / "neural_control.json").write_text("{}")
    assert codes()["neural_control"] != after["neural_control"]
    trials.code_of.cache_clear()


def test_new_weights_are_run_anew(tmp_path):
    file = tmp_path / "neural_rmp.safetensors"
    save(LearnedPolicy.fresh("neural_rmp", 0), file, {"seed": 0})
    seam = write_seam(tmp_path / "s.csv", length=0.04)
    learned = trials.Trial(
        method="neural_rmp", workpiece=seam, seed=1, env=SHORT, weights=str(file), training_seed=0
    )
    expert = trials.Trial(method="rmp_expert", workpiece=seam, seed=1, env=SHORT)
    log = tmp_path / "log.jsonl"
    trials.run_all([learned, expert], engine=engines.local(1), log=log, title="t", together=2)
    lines = log.read_text().splitlines()
    save(LearnedPolicy.fresh("neural_rmp", 5), file, {"seed": 0})
    trials.run_all([learned, expert], engine=engines.local(1), log=log, title="t", together=2)
    new = [json.loads(line)["method"] for line in log.read_text().splitlines()[len(lines) :]]
    assert new == ["neural_rmp"]


@pytest.mark.parametrize("part", ["file", "groove"])
def test_a_trial_is_rebuilt_from_its_specification_alone(tmp_path, part):
    name = write_seam(tmp_path / "short.csv") if part == "file" else part
    t = trials.Trial(method="rmp_expert", workpiece=name, seed=4, env=SHORT)
    here = trials.workpiece(name)
    (row,) = ({"workpiece": t.part, "env_spec": t.spec()},)
    environments, (light,) = trials.shared([row])
    assert set(light["env_spec"]) == {"environment", "seed"}
    for spec, known in ((t.spec(), ()), (light["env_spec"], environments)):
        env = trials.rebuild(*json.loads(json.dumps([spec, known])))
        core = env.unwrapped.core
        built = core.scene.workpiece
        np.testing.assert_array_equal(built.seam.position, here.seam.position)
        np.testing.assert_array_equal(built.surface.triangles, here.surface.triangles)
        assert (core.cfg.control, core.cfg.perception) == ("rmp", "oracle")
        assert spec["seed"] == 4
        env.close()


def test_rows_share_an_environment_only_if_all_but_the_seed_is_alike():
    wanted = [
        trials.Trial(method=m, workpiece=w, seed=s, env=SHORT)
        for m in ("rmp_expert", "neural_control")
        for w in ("flat", "groove")
        for s in (1, 2)
    ]
    rows = [{"workpiece": t.workpiece, "env_spec": t.spec()} for t in wanted]
    environments, light = trials.shared(rows)
    assert len(environments) == 4
    named = {e["environment"]: e for e in environments}
    for row, t in zip(light, wanted, strict=True):
        spec = named[row["env_spec"]["environment"]]
        assert spec["kwargs"]["control"] == agents.control_of(t.method)
        shape = spec["workpiece"]
        assert (shape if isinstance(shape, str) else shape["name"]) == t.workpiece
        assert row["env_spec"]["seed"] == t.seed


def test_an_environment_that_is_not_in_the_document_is_named():
    with pytest.raises(ValueError, match=r"'flat-0' is there 0 times"):
        trials.rebuild({"environment": "flat-0", "seed": 1}, [])


def test_shapes_have_names_of_their_own():
    assert not set(shapes.NAMES) & set(trials.NAMES)
