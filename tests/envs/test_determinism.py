"""Seeds, independence of what is returned, and that every number of the observation means something."""

import numpy as np
import pytest

import seal_gym

IDS = seal_gym.ENV_IDS
CONTROLS = ("tip", "rmp", "joint")
FLAGS = [2, 5]


def same(a, b):
    """Exact equality of observations or infos, NaN included."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            same(a[key], b[key])
    else:
        np.testing.assert_array_equal(a, b)


def arrays(x):
    """All arrays in an observation or info."""
    if isinstance(x, dict):
        return [leaf for value in x.values() for leaf in arrays(value)]
    return [x] if isinstance(x, np.ndarray) else []


def rollout(env, seeds, steps, rng):
    """Records resets with the given seeds (None goes on) and random steps after each."""
    out = []
    for seed in seeds:
        out.append(env.reset(seed=seed))
        out += [env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)) for _ in range(steps)]
    return out


@pytest.mark.parametrize("observation", ["features", "features+images"])
@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("env_id", IDS)
def test_the_same_seed_gives_the_same_run(make, env_id, control, observation):
    """Two environments, exactly; and one again, after other seeds and a reset that just goes on."""
    one, two = (make(env_id, control=control, observation=observation) for _ in range(2))
    seeds = (7, None, 8, None)
    first = rollout(one, seeds, 3, np.random.default_rng(0))
    same_again = rollout(two, seeds, 3, np.random.default_rng(0))
    re_seeded = rollout(one, seeds, 3, np.random.default_rng(0))
    for a, b, c in zip(first, same_again, re_seeded, strict=True):
        for x, y, z in zip(a, b, c, strict=True):
            same(x, y)
            same(x, z)


@pytest.mark.parametrize("env_id", IDS)
def test_an_ended_episode_leaves_nothing_behind(make, env_id):
    """A reset after a collision or a lost seam gives what a fresh environment gives."""
    used, fresh = make(env_id), make(env_id)
    used.reset(seed=1)
    down = np.array([0.3, 0.1, -1.0, 0.5, 0.2, 0.1], np.float32)
    for _ in range(60):
        if used.step(down)[2]:
            break
    else:
        pytest.fail("no end in 60 steps")
    for a, b in zip(
        rollout(used, (2,), 12, np.random.default_rng(3)),
        rollout(fresh, (2,), 12, np.random.default_rng(3)),
        strict=True,
    ):
        for x, y in zip(a, b, strict=True):
            same(x, y)


@pytest.mark.parametrize("env_id", IDS)
def test_different_seeds_differ(make, env_id):
    env = make(env_id)
    starts = np.array([env.reset(seed=s)[0] for s in range(5)] + [env.reset()[0] for _ in range(5)])
    assert len(np.unique(starts, axis=0)) == 10


@pytest.mark.parametrize("env_id", IDS)
def test_initial_states_fill_the_protocols_ranges(make, env_id):
    """Pose of part and gun, from the physics: +-20 mm, +-15 deg; 7-12 mm, +-5 mm, +-5 deg."""
    env = make(env_id)
    core = env.unwrapped.core
    nominal, seam = core.scene.workpiece.pose, core.scene.workpiece.seam
    start = seam.at(0.0)
    y, z = start.tangent, start.approach
    frame = np.column_stack((np.cross(y, z), y, z))
    draws = []
    for k in range(150):
        _, info = env.reset(seed=1000 + k)
        part = core.arm.data(0).body("part")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = part.xmat.reshape(3, 3), part.xpos
        shift = np.linalg.inv(nominal) @ pose
        tip = np.linalg.inv(pose) @ core.tip.pose[0]
        offset = frame.T @ (tip[:3, 3] - start.position)
        turn = frame.T @ tip[:3, :3]  # about z, then about x: its y column shows both
        draws.append(
            [
                *1e3 * shift[:2, 3], np.rad2deg(np.arctan2(shift[1, 0], shift[0, 0])),
                1e3 * offset[2] - 3.0, 1e3 * offset[0],
                np.rad2deg(np.arctan2(turn[1, 0], turn[0, 0])), np.rad2deg(np.arcsin(turn[2, 1])),
            ]
        )  # fmt: skip
        assert abs(offset[1]) < 1e-6 and abs(shift[2, 3]) < 1e-12
        assert info["roi"]["valid_front"] and info["roi"]["valid_side"]
        assert info["tip_error_mm"] > 6.9 and not info["collision"]
        assert core.arm.data(0).ncon == 0
    draws = np.array(draws)
    low, high = np.array([[-20, 20], [-20, 20], [-15, 15], [7, 12], [-5, 5], [-5, 5], [-5, 5]]).T
    assert (draws >= low - 1e-6).all() and (draws <= high + 1e-6).all()
    # 150 draws come within a tenth of both ends.
    assert (draws.min(axis=0) < low + 0.15 * (high - low)).all()
    assert (draws.max(axis=0) > high - 0.15 * (high - low)).all()


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("env_id", IDS)
def test_no_element_of_the_observation_is_constant(make, env_id, control):
    env = make(env_id, control=control)
    rng = np.random.default_rng(0)
    rows = [x[0] for x in rollout(env, range(6), 12, rng)]
    constant = np.flatnonzero(np.ptp(np.array(rows), axis=0) == 0).tolist()
    assert set(constant) <= set(FLAGS)


def test_the_validity_flags_are_not_constant_either(make):
    env = make()
    env.reset(seed=0)
    flags = np.array([env.step(np.array([0, 0, 1, 0, 0, 0], np.float32))[0][FLAGS] for _ in range(20)])
    assert set(flags.ravel()) == {0.0, 1.0}


@pytest.mark.parametrize("observation", ["features", "features+images"])
@pytest.mark.parametrize("env_id", IDS)
def test_nothing_returned_shares_memory(make, env_id, observation):
    """Not among calls, and not with the environment: scribbling over it all changes no number."""
    env, clean = (make(env_id, observation=observation, control="rmp") for _ in range(2))
    actions = np.random.default_rng(1).uniform(-1, 1, (6, 27)).astype(np.float32)
    kept = []
    for action in actions:
        mine = action.copy()
        result = env.step(mine) if kept else env.reset(seed=3)
        expected = clean.step(action) if kept else clean.reset(seed=3)
        for x, y in zip(result, expected, strict=True):
            same(x, y)
        returned = arrays(result[0]) + arrays(result[-1])
        for array in returned:
            assert array.flags.writeable
            assert not any(np.shares_memory(array, other) for other in kept)
        kept += returned
        for array in [*returned, mine]:
            array[...] = 77
    assert len(kept) >= 12
