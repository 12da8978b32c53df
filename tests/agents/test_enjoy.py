import cv2
import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC

import agents
import seal_gym  # noqa: F401  # registers the ids
from agents import policies, sb3_policies
from agents.enjoy import VIDEO_EVERY, film, find_policy, main, parse
from agents.sb3_policies import NetCfg
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


def test_a_zip_of_sb3_acts_as_the_model_that_was_saved(tmp_path):
    env = make_sb3_vec("SealGym/Flat-v0", 2, control="rmp", perception="oracle")
    model = SAC("MlpPolicy", env, device="cpu", seed=0)
    model.save(tmp_path / "mine")
    policy = find_policy(str(tmp_path / "mine.zip"))
    assert policy.control == "rmp"
    rows = np.random.default_rng(0).normal(size=(3, 35)).astype(np.float32)
    np.testing.assert_array_equal(policy.predict(rows)[0], model.predict(rows, deterministic=True)[0])


def test_a_run_s_folder_is_a_policy_of_either_kind(tmp_path):
    path, cfg = tmp_path / "policy.safetensors", NetCfg(hidden=(8,))
    sb3_policies.save(sb3_policies.build(cfg), cfg, path, {})
    assert isinstance(find_policy(str(tmp_path)), sb3_policies.Sb3Policy)
    policies.save(policies.LearnedPolicy.fresh("neural_rmp", 0), path, {})
    assert isinstance(find_policy(str(path)), policies.LearnedPolicy)


def test_wrong_names_are_named(capsys):
    assert main(["--policy", "rmp_export"]) == 2
    assert "rmp_expert" in capsys.readouterr().err
    assert main(["--policy", "missing.safetensors"]) == 2
    assert "missing" in capsys.readouterr().err
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
