"""Steps per second of GAIL in `imitation` on HalfCheetah. Runs in that package's own environment; prints JSON.

PPO of Stable-Baselines3 collects batches of 2000 steps; all other settings are the defaults of the packages.

    python imitation_gail.py DEMONSTRATIONS SIMULATIONS dummy|subproc THREADS SECONDS
"""

import contextlib
import json
import sys
import time
from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from imitation.algorithms.adversarial.gail import GAIL
from imitation.data.rollout import flatten_trajectories
from imitation.data.types import Trajectory
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.rewards.reward_nets import BasicRewardNet
from imitation.util.networks import RunningNorm
from imitation.util.util import make_vec_env
from stable_baselines3 import PPO

BATCH_SIZE = 2000


def demonstrations(path: str) -> Any:
    """The shipped file's episodes as one list of transitions."""
    with np.load(path, allow_pickle=False) as file:
        obs, actions, ends = file["obs"], file["actions"], file["episode_ends"]
    starts = [0, *ends[:-1]]
    episodes = [
        Trajectory(obs=obs[start:end], acts=actions[start : end - 1], infos=None, terminal=False)
        for start, end in zip(starts, ends, strict=True)
    ]
    return flatten_trajectories(episodes)


def main(path: str, num_envs: int, kind: str, num_threads: int, seconds: float) -> None:
    """Trains until the time is up. The first round is not counted, because it includes the setup."""
    torch.set_num_threads(num_threads)
    env = make_vec_env(
        "HalfCheetah-v4",
        rng=np.random.default_rng(0),
        n_envs=num_envs,
        parallel=kind == "subproc",
        post_wrappers=[lambda env, _: RolloutInfoWrapper(env)],
    )
    learner = PPO("MlpPolicy", env, n_steps=BATCH_SIZE // num_envs, seed=0, device="cpu")
    reward = BasicRewardNet(env.observation_space, env.action_space, normalize_input_layer=RunningNorm)
    trainer = GAIL(
        demonstrations=demonstrations(path),
        demo_batch_size=1024,
        gen_replay_buffer_capacity=BATCH_SIZE,
        n_disc_updates_per_round=8,
        venv=env,
        gen_algo=learner,
        reward_net=reward,
        allow_variable_horizon=True,
    )
    with contextlib.redirect_stdout(sys.stderr):
        trainer.train(BATCH_SIZE)
        rounds, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            trainer.train(BATCH_SIZE)
            rounds += 1
    rate = rounds * BATCH_SIZE / (time.perf_counter() - start)
    packages = ("imitation", "stable-baselines3", "torch", "gymnasium", "mujoco", "numpy")
    env.close()
    print(json.dumps({"steps_per_second": rate, "versions": {name: version(name) for name in packages}}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4]), float(sys.argv[5]))
