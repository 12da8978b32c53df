"""Where units of work run."""

import argparse
import os
import subprocess
import sys
from functools import partial

import pytest

from agents import engines
from agents.provenance import ROOT
from seal_gym.core.errors import ConfigError, SealGymError


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_unit_comes_back_with_its_result(jobs):
    done = dict(engines.local(jobs)(partial(pow, 2), range(8)))
    assert done == {k: 2**k for k in range(8)}


def test_a_worker_that_dies_is_named_and_the_rest_can_be_run_again():
    with pytest.raises(SealGymError, match="start the same command again"):
        list(engines.local(2)(os._exit, [0, 0, 0]))


def test_what_the_work_raises_comes_out():
    with pytest.raises(ZeroDivisionError):
        list(engines.local(2)(partial(divmod, 1), [1, 0, 2]))


def test_options_that_do_not_go_together():
    parser = argparse.ArgumentParser()
    engines.add_options(parser)
    parser.add_argument("--jobs", type=int, default=1)
    with pytest.raises(ConfigError, match="only with --engine ray"):
        engines.of(parser.parse_args(["--address", "auto"]), str)


TABLE = """
import sys
from experiments import severity, table4

common = ["--method", "rmp_expert", "--perception", "oracle", "--trials", "1", "--workpiece", "flat"]
common += [*sys.argv[2:], "--out", sys.argv[1]]
assert table4.main([*common, "--training-seeds"]) == 0
assert severity.main([*common, "--disturbance", "CameraNoise", "--severities", "1"]) == 0
"""


@pytest.mark.slow
def test_tables_are_the_same_on_a_ray_cluster(tmp_path):
    pytest.importorskip("ray")
    logs = {}
    for name, options in (("local", []), ("ray", ["--engine", "ray"])):
        out = tmp_path / name
        subprocess.run(
            [sys.executable, "-c", TABLE, str(out), *options],
            cwd=ROOT,
            env={**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "RAY_raylet_start_wait_time_s": "300"},
            check=True,
            timeout=900,
        )
        logs[name] = {f.name: f.read_text() for f in sorted(out.glob("*.trials.jsonl"))}
    assert logs["local"] == logs["ray"]
    assert len(logs["ray"]) == 2
