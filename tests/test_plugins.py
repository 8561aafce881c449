"""The environment in the hands of others: Gymnasium, Stable-Baselines3, RL Baselines3 Zoo, TorchRL."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

from magenv import ENV_ID

ZOO_FILE = Path(__file__).parents[1] / "agents" / "zoo" / "ppo.yml"
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a new Python in which every warning is an error."""
    command = [sys.executable, "-W", "error", *arguments]
    result = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=300, check=False)
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
    return result


def test_gymnasium_imports_the_package_by_its_prefix():
    made = f"import gymnasium; print(gymnasium.make('magenv:{ENV_ID}').reset(seed=0)[0].shape)"
    expected = gymnasium.make(ENV_ID).observation_space.shape
    assert run("-c", made).stdout.strip() == str(expected)


def test_stable_baselines_ppo_learns_on_a_dummy_vec_env():
    venv = DummyVecEnv([lambda: gymnasium.make(ENV_ID)] * 4)
    model = PPO("MlpPolicy", venv, n_steps=64, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(512)
    after = model.policy.state_dict()
    assert model.num_timesteps == 512
    assert all(bool(torch.isfinite(value).all()) for value in after.values())
    assert not any(torch.equal(before[name], after[name]) for name in before if name.endswith("weight"))


def test_stable_baselines_is_told_how_episodes_end():
    venv = DummyVecEnv([lambda: gymnasium.make(ENV_ID, scenario="approach-60")] * 2)
    venv.seed(3)
    venv.reset()
    rng = np.random.default_rng(3)
    ends = []
    for _ in range(250):  # longer than the reference, so every episode ends
        actions = rng.uniform(-1.0, 1.0, (2, *venv.action_space.shape)).astype(np.float32)
        _, _, dones, infos = venv.step(actions)
        ends += [info for done, info in zip(dones, infos, strict=True) if done]
    assert len(ends) >= 2
    for info in ends:
        assert info["is_success"] == info["TimeLimit.truncated"]
        assert info["terminal_observation"] in venv.observation_space


def test_rl_zoo_trains_from_the_shipped_file(tmp_path):
    settings = yaml.safe_load(ZOO_FILE.read_text())[ENV_ID]
    rollout = settings["n_envs"] * settings["n_steps"]
    assert rollout % settings["batch_size"] == 0
    run(
        *("-m", "rl_zoo3.train", "--algo", "ppo", "--env", ENV_ID, "--gym-packages", "magenv"),
        *("--conf-file", str(ZOO_FILE), "-f", str(tmp_path), "--seed", "1", "--num-threads", "1", "-n", str(rollout)),
        *("--eval-freq", str(rollout), "--eval-episodes", "2", "--eval-env-kwargs", "scenario:'approach-60'"),
    )
    (folder,) = (tmp_path / "ppo").iterdir()
    assert (folder / f"{folder.name.removesuffix('_1')}.zip").is_file()
    evaluations = np.load(folder / "evaluations.npz", allow_pickle=False)
    assert evaluations["timesteps"].tolist() == [rollout]
    assert evaluations["successes"].shape == (1, 2)


def replay(rollout, scalar, seed, resets):
    """Repeat a TorchRL rollout of one episode after another in ``scalar``; every number must be the same, bit for bit.

    ``resets[t]`` is how often TorchRL resets after an episode that ended at step t.
    """
    scalar.reset(seed=seed)
    observation, _ = scalar.reset()  # TorchRL resets with the seed in set_seed, and without it in rollout
    for step, count in zip(rollout.unbind(0), resets, strict=True):
        assert np.array_equal(step["observation"].numpy(), observation)
        observation, reward, terminated, truncated, _ = scalar.step(step["action"].numpy())
        after = step["next"]
        assert np.array_equal(after["observation"].numpy(), observation)
        assert after["reward"].item() == np.float32(reward)
        assert (after["terminated"].item(), after["truncated"].item()) == (terminated, truncated)
        if terminated or truncated:
            for _ in range(count):
                observation, _ = scalar.reset()


def test_torchrl_gym_env_equals_gymnasium():
    env = GymEnv(ENV_ID, scenario="approach-60")
    check_env_specs(env)
    torch.manual_seed(5)
    env.set_seed(5)
    rollout = env.rollout(300, break_when_any_done=False)
    assert rollout.shape == (300,)
    replay(rollout, gymnasium.make(ENV_ID, scenario="approach-60"), seed=5, resets=[1] * 300)


@pytest.mark.parametrize("autoreset_mode", ["SameStep", "Disabled"])
def test_torchrl_over_the_batched_env_equals_gymnasium(autoreset_mode):
    def batched():
        return GymWrapper(
            gymnasium.make_vec(
                ENV_ID, num_envs=8, vectorization_mode="vector_entry_point", autoreset_mode=autoreset_mode
            )
        )

    # With SameStep, TorchRL 0.14 may open a rollout with observations left over from the one before: hence two envs.
    check_env_specs(batched())
    env = batched()
    torch.manual_seed(11)
    env.set_seed(11)
    rollout = env.rollout(50, break_when_any_done=False)
    assert rollout.shape == (8, 50)
    done = rollout["next", "done"].squeeze(-1)
    assert done.any(), "no episode ended: autoreset was not tried"
    # Where all episodes end at once TorchRL resets by itself, whatever the environment has done.
    resets = [2 if autoreset_mode == "SameStep" and together else 1 for together in done.all(0).tolist()]
    for row in range(8):
        replay(rollout[row], gymnasium.make(ENV_ID), seed=11 + row, resets=resets)
