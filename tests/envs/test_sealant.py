"""Sealant in the environment: spaces, conservation, what cameras and metrics see of the bead."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import seal_gym  # noqa: F401  # registers the ids
from agents import load_policy
from agents.pressure import WithPressure
from seal_gym.core.errors import ActionError, ConfigError
from seal_gym.envs.config import SealCfg
from seal_gym.envs.core import FEATURES, SealCore
from seal_gym.sealant.config import SealantCfg
from seal_gym.sealant.pneumatics import Sealant

GREY = Sealant(
    name="grey",
    density_kg_m3=1400,
    yield_stress_pa=200,
    consistency_pa_sn=250,
    flow_index=0.4,
    rgb=(0.5, 0.5, 0.5),
)


def make(workpiece="flat", **kwargs):
    kwargs = {"control": "rmp", "perception": "oracle", "sealant": True, **kwargs}
    return gym.make("SealGym/Seal-v0", workpiece=workpiece, **kwargs)


def core_of(n=1, seed=0, workpiece="flat", **kwargs):
    kwargs = {"control": "rmp", "perception": "oracle", "sealant": True, **kwargs}
    core = SealCore(SealCfg.of(workpiece=workpiece, **kwargs), n)
    for i in range(n):
        core.reset(i, np.random.Generator(np.random.PCG64(seed + i)))
    return core


def seal(core, policy, frames=10_000):
    """Runs until all have ended; gives the metrics."""
    observation, state, start = core.observe(), None, np.ones(core.n, np.bool_)
    done, out = np.zeros(core.n, np.bool_), [None] * core.n
    for _ in range(frames):
        action, state = policy.predict(observation, state, start)
        start = np.zeros(core.n, np.bool_)
        result = core.step(action)
        for i in np.flatnonzero((result.terminated | result.timeout) & ~done):
            out[i] = core.episode_metrics(int(i), result)
        done |= result.terminated | result.timeout
        observation = core.observe()
        if done.all():
            break
    return out


def policy_for(core, pressure="regulated"):
    from agents.pressure import with_pressure

    return with_pressure(load_policy("rmp_expert"), core.cfg.cell, core.cfg.sealant, pressure)


@pytest.mark.parametrize("perception", ["oracle", "vision"])
def test_the_environment_is_one_of_gymnasiums(perception):
    env = make(perception=perception)
    assert env.action_space.shape == (28,)
    assert env.observation_space.shape == (FEATURES + 3,)
    check_env(env.unwrapped, skip_render_check=True)


def test_without_sealant_nothing_changes():
    plain, laid = make(sealant=False), make()
    assert plain.action_space.shape == (27,)
    a, _ = plain.reset(seed=3)
    b, _ = laid.reset(seed=3)
    np.testing.assert_array_equal(a, b[:FEATURES])
    action = np.zeros(27, np.float32)
    for _ in range(5):
        a = plain.step(action)[0]
        b = laid.step(np.append(action, 1.0))[0]
    np.testing.assert_array_equal(a, b[:FEATURES])


def test_what_leaves_the_nozzle_lies_on_the_part_or_beside_it():
    core = core_of(n=4)
    rng = np.random.default_rng(5)
    for _ in range(60):
        action = np.column_stack((0.2 * rng.uniform(-1, 1, (4, 27)), rng.uniform(-1, 1, 4)))
        core.step(action)
    bead = core.extrusion.bead
    assert (bead.used > 0).all()
    np.testing.assert_allclose(bead.volume.sum(axis=(1, 2)) + bead.missed, bead.used, rtol=1e-12)


@pytest.mark.slow
def test_volume_is_conserved_over_a_thousand_random_episodes():
    core = core_of(n=50, workpiece="rectangular", disturbances=("MovingWorkpiece",))
    rng = np.random.default_rng(6)
    episodes, worst, flow = 0, 0.0, np.zeros(50)
    while episodes < 1000:
        before = core.extrusion.bead.used.copy()
        scale = rng.choice((0.05, 0.3, 1.0), (50, 1))
        action = np.column_stack((scale * rng.uniform(-1, 1, (50, 27)), rng.uniform(-1, 1, 50)))
        result = core.step(action)
        bead = core.extrusion.bead
        flow += bead.used - before
        for i in np.flatnonzero(result.terminated | result.timeout | (core.frames > 120)):
            laid = bead.volume[i].sum() + bead.missed[i]
            worst = max(worst, abs(laid - flow[i]) / max(flow[i], 1e-15))
            core.reset(int(i), rng)
            episodes, flow[i] = episodes + 1, 0.0
    assert worst < 1e-9


def test_the_regulated_bead_is_the_wanted_one_and_the_constant_one_is_not():
    section = {}
    for pressure in ("regulated", "constant"):
        core = core_of(n=3, seed=500_000, perception="vision")
        metrics = seal(core, policy_for(core, pressure))
        assert [m["outcome"] for m in metrics] == ["reached"] * 3
        section[pressure] = np.array([m["bead_section_pct"] for m in metrics])
    assert np.abs(section["regulated"] - 100).max() < 6
    assert np.abs(section["constant"] - 100).max() > 15  # cartridges differ


def test_single_and_vector_and_threads_lay_the_same_bead():
    kwargs = {"perception": "vision", "workpiece": "cylinder", "seed": 7}
    both, threaded = core_of(n=3, **kwargs), core_of(n=3, threads=2, **kwargs)
    alone = core_of(**{**kwargs, "seed": 8})
    action = np.zeros((3, 28))
    action[:, -1] = 0.4
    for core, a in ((both, action), (threaded, action), (alone, action[:1])):
        core.observe()
        for _ in range(25):
            core.step(a)
            core.observe()
    np.testing.assert_array_equal(both.extrusion.bead.volume, threaded.extrusion.bead.volume)
    np.testing.assert_array_equal(both.images.side, threaded.images.side)
    np.testing.assert_array_equal(both.extrusion.bead.volume[1], alone.extrusion.bead.volume[0])
    np.testing.assert_array_equal(both.images.side[1], alone.images.side[0])
    assert both.extrusion.bead.volume[1].sum() > 0


def test_a_reset_cleans_the_part_and_the_same_seed_fills_the_same_cartridge():
    env = make()
    runs = []
    for _ in range(2):
        env.reset(seed=11)
        for _ in range(20):
            observation, *_, info = env.step(np.append(np.zeros(27), 1.0).astype(np.float32))
        runs.append((observation, info["sealant"]))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    assert runs[0][1] == pytest.approx(runs[1][1], nan_ok=True)
    _, info = env.reset(seed=12)
    assert env.unwrapped.core.extrusion.bead.volume.max() == 0.0
    assert info["sealant"]["pressure_kpa"] == 0.0


def test_cameras_and_gauge_see_the_bead_as_it_is():
    core = core_of(n=2, seed=500_000, perception="vision", sealant=SealantCfg(variation=0.0))
    policy = policy_for(core)
    observation, state = core.observe(), None
    errors = []
    for frame in range(400):
        action, state = policy.predict(observation, state)
        core.step(action)
        observation = core.observe()
        if frame > 150:
            seen = core.extrusion.width
            true = core.extrusion._true_width().width_m
            assert seen.seen.all()
            errors.append(seen.width_m - true)
            np.testing.assert_allclose(observation[:, 36], 1e3 * seen.width_m, rtol=1e-6)
    # A pixel is 0.33 mm across.
    assert np.abs(np.mean(errors)) < 0.25e-3
    assert np.std(errors) < 0.25e-3


def test_the_bead_moves_with_the_part():
    core = core_of(n=2, seed=3, workpiece="flat", disturbances=("MovingWorkpiece",))
    metrics = seal(core, policy_for(core))
    assert [m["outcome"] for m in metrics] == ["reached"] * 2
    assert max(m["missed_mm3"] for m in metrics) == 0.0
    assert max(m["gaps_pct"] for m in metrics) < 3.0


def test_metrics_of_a_bead_by_hand():
    core = core_of(workpiece="rectangular")
    extrusion = core.extrusion
    bead, strip = extrusion.bead, extrusion.bead.strip
    from seal_gym.sealant.bead import wanted_heights

    bead.height[0] = wanted_heights(strip, 7e-6, bead.inside)
    bead.volume[0] = strip.volume(bead.height[0])
    m = extrusion.metrics(0)
    assert m["bead_section_pct"] == pytest.approx(100.0)
    assert m["bead_rmse_pct"] == pytest.approx(0.0, abs=1e-9)
    assert m["corner_section_pct"] == pytest.approx(100.0)
    assert m["gaps_pct"] == 0.0
    # A filled right angle: h^2 = 7 mm^2, twice h wide between the toes, 0.2 less where 0.1 mm high; to half a
    # column.
    assert m["bead_height_mm"] == pytest.approx(np.sqrt(7.0), abs=0.02)
    assert m["bead_width_mm"] == pytest.approx(2 * np.sqrt(7.0) - 0.2, abs=0.25)
    rows = np.flatnonzero(bead.inside)
    bead.volume[0, rows[: len(rows) // 4]] = 0.0
    assert extrusion.metrics(0)["gaps_pct"] == pytest.approx(25.0, abs=0.5)


def test_the_wanted_bead_needs_more_round_a_corner():
    core = core_of(workpiece="rectangular")
    profile = core.extrusion.bead.profile(0)
    low, high = core.scene.workpiece.seam.corners[0]
    middle = profile.wanted[(profile.arc > low + 1e-3) & (profile.arc < high - 1e-3)]
    straight = profile.wanted[(profile.arc > 20e-3) & (profile.arc < low - 20e-3)]
    # Pappus: the filled angle's centroid is sqrt(7) sqrt(2) / 3 mm beside the wall, the corner's radius 5 mm.
    expected = 1.0 + np.sqrt(7.0) * np.sqrt(2.0) / 3.0 / 5.0
    assert middle.mean() / straight.mean() == pytest.approx(expected, rel=0.02)
    assert straight.mean() == pytest.approx(7e-6, rel=1e-3)


def test_the_reward_option_counts_the_bead():
    plain, judged = core_of(seed=1), core_of(seed=1, sealant=SealantCfg(reward=2.0))
    policy = policy_for(plain)
    observation, state, differences = plain.observe(), None, []
    judged.observe()
    for _ in range(150):
        action, state = policy.predict(observation, state)
        a, b = plain.step(action), judged.step(action)
        share = judged.extrusion.share(0)
        expected = 0.0 if np.isnan(share) else 2.0 * min(abs(share - 1.0), 1.0)
        differences.append(a.reward[0] - b.reward[0] - expected)
        observation = plain.observe()
        judged.observe()
    np.testing.assert_allclose(differences, 0.0, atol=1e-12)


def test_the_vector_face_has_the_infos_of_the_single_one():
    if gym.__version__.startswith("0."):
        pytest.skip("the vector face needs gymnasium >= 1.0")
    envs = gym.make_vec(
        "SealGym/Seal-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        workpiece="flat",
        control="rmp",
        perception="oracle",
        sealant=True,
    )
    envs.reset(seed=1)
    info = envs.step(np.zeros((2, 28), np.float32))[-1]["sealant"]
    env = make()
    env.reset(seed=2)
    single = env.step(np.zeros(28, np.float32))[-1]["sealant"]
    for name, value in single.items():
        np.testing.assert_equal(info[name][1], value)


def test_load_policy_presses_too():
    env = make()
    policy = load_policy("rmp_expert", env)
    assert isinstance(policy, WithPressure)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    assert action.shape == (28,)
    assert env.action_space.contains(action)
    batch, _ = policy.predict(observation[None], None)
    np.testing.assert_array_equal(batch[0], action)
    with pytest.raises(ConfigError, match=r"pressure = 'full'.*regulated"):
        load_policy("rmp_expert", env, pressure="full")
    with pytest.raises(ConfigError, match="needs 38 entries; make the environment with sealant=True"):
        policy.predict(observation[:FEATURES])


def test_an_action_delay_delays_the_pressure():
    core = core_of(disturbances=({"name": "ActuationDelay", "severity": 2.0},))
    action = np.zeros((1, 28))
    action[0, -1] = 1.0
    pressures = []
    for _ in range(4):
        core.step(action)
        pressures.append(core.extrusion.bead.line.pressure_pa[0])
    # Actions of zero, half pressure, come first: two frames of them.
    half = 75e3 * (1 - np.exp(-2 / 30 / 0.08))
    assert pressures[1] == pytest.approx(half, rel=1e-9)
    assert pressures[2] - pressures[1] > pressures[1] - pressures[0]


@pytest.mark.parametrize(
    ("kwargs", "error", "match"),
    [
        ({"sealant": "silicone"}, ConfigError, "sealant = 'silicone': must be False, True or a SealantCfg"),
        ({"renderer": "gl"}, ConfigError, "renderer = 'gl' with sealant"),
        (
            {"sealant": SealantCfg(sealant=GREY), "perception": "vision"},
            ConfigError,
            "channels differ by 0.00.*dye it",
        ),
    ],
)
def test_bad_arguments_are_named(kwargs, error, match):
    with pytest.raises(error, match=match):
        make(**kwargs)


def test_an_action_without_pressure_is_refused():
    env = make()
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"takes numbers of shape \(28,\)"):
        env.step(np.zeros(27, np.float32))
