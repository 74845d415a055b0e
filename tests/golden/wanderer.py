"""A fixed policy of the observation alone, for the original safety-gymnasium and for ours: it provokes contacts.

It follows the nearest object of one lidar and now and then turns to another lidar; Doggo, which nobody can steer in a
few lines, moves its legs at random. NumPy only: the original runs in a Python of its own.
"""

import numpy as np

NUM_BINS = 16
FOLLOW_STEPS = 60  # control steps for which a lidar is followed
HOLD_STEPS = 5  # for which a disturbance is held


def plan(random: np.random.Generator, num_steps: int, num_lidars: int, num_actions: int) -> tuple[np.ndarray, ...]:
    """An episode's lidars to follow `[num_steps]` and standard normal disturbances `[num_steps, num_actions]`."""
    followed = random.integers(num_lidars, size=1 + num_steps // FOLLOW_STEPS)
    noise = random.standard_normal((1 + num_steps // HOLD_STEPS, num_actions))
    return np.repeat(followed, FOLLOW_STEPS)[:num_steps], np.repeat(noise, HOLD_STEPS, axis=0)[:num_steps]


def act(robot: str, num_lidars: int, obs: np.ndarray, followed: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Actions `[N, num_actions]` for observations `[N, obs_dim]`, with a step of each episode's plan."""
    if robot == "Doggo":
        return noise
    lidars = obs[:, -NUM_BINS * num_lidars :].reshape(-1, num_lidars, NUM_BINS)
    nearest = lidars[np.arange(len(obs)), followed].argmax(axis=1)
    ahead = {"Point": 0.0, "Car": -np.pi / 2}[robot]
    error = (2 * np.pi * (nearest + 0.5) / NUM_BINS - ahead + np.pi) % (2 * np.pi) - np.pi
    if robot == "Point":
        return np.stack([np.maximum(np.cos(error), 0), np.clip(2 * error, -1, 1)], axis=1) + 0.3 * noise
    thrust, turn = np.cos(error), np.sin(2 * error)  # Car runs backwards just as well
    return 0.03 * np.stack([thrust + turn, thrust - turn], axis=1) + 0.01 * noise
