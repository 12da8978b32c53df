import zipfile

import cv2
import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import A2C, PPO, SAC

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import sb3_policies
from agents.enjoy import VIDEO_EVERY, film, find_policy, main, parse, policy_at
from agents.sb3_policies import NetCfg
from seal_gym.core.errors import ConfigError
from seal_gym.envs.sb3 import make_sb3_vec
from seal_gym.tasks.progress import SealTaskCfg


def test_it_prints_the_expert_s_metrics_as_a_loop_by_hand_gives_them(capsys):
    status = main(
        ["--env", "SealGym/Cylinder-v0", "--perception", "oracle", "--episodes", "2", "--seed", "500003"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert status == 0 and len(lines) == 3
    env = gym.make("SealGym/Cylinder-v0", control="rmp", perception="oracle")
    policy, errors = agents.load_policy("rmp_expert", env), []
    for seed, line in zip((500_003, 500_004), lines, strict=False):
        observation, _ = env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            observation, reward, terminated, truncated, info = env.step(policy.predict(observation)[0])
            total, done = total + reward, terminated or truncated
        m = info["episode_metrics"]
        errors.append(m["rmse_mm"])
        assert line.startswith(f"seed {seed}: {m['outcome']}, RMSE {m['rmse_mm']:.4f} mm")
        assert line.endswith(f"{m['time_s']:.2f} s, return {total:.2f}")
    assert lines[2] == f"2 of 2 reached, mean RMSE {np.mean(errors):.4f} mm"


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("zips")
    made = {}
    for kind, control in ((PPO, "tip"), (SAC, "rmp"), (A2C, "tip")):
        env = make_sb3_vec("SealGym/Flat-v0", 2, control=control, perception="oracle")
        model = kind("MlpPolicy", env, device="cpu", seed=0)
        model.save(folder / kind.__name__)
        made[kind.__name__] = (model, folder / f"{kind.__name__}.zip")
    return made


@pytest.mark.parametrize(("kind", "control"), [("PPO", "tip"), ("SAC", "rmp")])
def test_a_zip_of_sb3_acts_as_the_model_that_was_saved(models, kind, control):
    model, path = models[kind]
    policy = find_policy(str(path))
    assert policy.control == control
    rows = np.random.default_rng(0).normal(size=(3, 35)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(rows)[0], model.predict(rows, deterministic=True)[0])


def test_six_actions_may_be_joints(models):
    assert policy_at(models["PPO"][1], "joint").control == "joint"


def test_other_zips_are_refused(models, tmp_path):
    with pytest.raises(ConfigError, match="neither PPO nor SAC"):
        policy_at(models["A2C"][1])
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr("hello", "world")
    (tmp_path / "y.zip").write_bytes(b"nothing")
    for name in ("x.zip", "y.zip"):
        with pytest.raises(ConfigError, match="no zip of Stable-Baselines3"):
            policy_at(tmp_path / name)
    with pytest.raises(ConfigError, match="no such file"):
        policy_at(tmp_path / "z.zip")


def test_a_run_s_folder_is_a_policy(tmp_path):
    cfg = NetCfg(hidden=(8,))
    sb3_policies.save(sb3_policies.build(cfg), cfg, tmp_path / "policy.safetensors", {})
    assert policy_at(tmp_path).control == "tip"
    with pytest.raises(ConfigError, match="control = 'rmp'"):
        policy_at(tmp_path, "rmp")


def test_wrong_names_are_named(capsys):
    assert main(["--policy", "rmp_export"]) == 2
    assert "rmp_expert" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="acts with 'rmp'"):
        find_policy("rmp_expert", "tip")
    for wrong in (["--episodes", "0"], ["--video", "x.gif"], ["--video", "x.mp4", "--human"]):
        with pytest.raises(SystemExit):
            parse(wrong)


@pytest.mark.gl
def test_a_film_holds_every_fifth_frame(tmp_path):
    path = tmp_path / "sub" / "film.mp4"
    task = SealTaskCfg(time_factor=0.012)
    kwargs = {"control": "rmp", "perception": "oracle", "task": task}
    row = film(agents.load_policy("rmp_expert"), "SealGym/Flat-v0", kwargs, 500_000, path)
    frames = round(row["time_s"] * 30) + 1  # with the one after the reset
    assert row["outcome"] == "timeout" and frames > VIDEO_EVERY
    video, pictures = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        pictures.append(read[1])
    video.release()
    assert len(pictures) == -(-frames // VIDEO_EVERY)
    assert pictures[0].shape == (720, 1280, 3) and pictures[0].std() > 20
