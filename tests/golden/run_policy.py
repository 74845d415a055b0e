"""Runs policies that `experiments.evaluate --export` wrote in the original safety-gymnasium 1.0.0.

Needs that package and NumPy only (the environment of `record_safety_gym.py`):

    python -m experiments.evaluate runs/NAME --export policy.npz
    .venv310/bin/python tests/golden/run_policy.py policy.npz --out transfer.json

Each seed's policy acts for as many episodes as it was evaluated for here; printed are mean return and cost with 95 %
intervals of both means (Student's t, normal quantile), here and there.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

ACTIVATIONS: dict[str, Any] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "swish": lambda x: x / (1 + np.exp(-x)),
}

LOG_STD_RANGE = (-5.0, 2.0)  # of squashed policies (IQ-Learn)


def act(policy: dict[str, np.ndarray], facts: dict[str, Any], obs: np.ndarray, random: Any) -> np.ndarray:
    """An action drawn from one seed's policy, or its mean if it was evaluated so."""
    x = np.clip((obs - policy["obs_mean"]) / policy["obs_std"], -policy["obs_clip"], policy["obs_clip"])
    num_layers = sum(name.startswith("kernel_") for name in policy)
    for layer in range(num_layers):
        x = x @ policy[f"kernel_{layer}"] + policy[f"bias_{layer}"]
        if layer < num_layers - 1:
            x = ACTIVATIONS[facts["activation"]](x)
    squashed = "action_half_range" in policy
    noise = random.standard_normal(len(x) // 2 if squashed else len(x)) * (not facts["deterministic"])
    if not squashed:
        return x + policy["action_std"] * noise
    mean, spread = np.split(x, 2)
    log_std = LOG_STD_RANGE[0] + (LOG_STD_RANGE[1] - LOG_STD_RANGE[0]) * (np.tanh(spread) + 1) / 2
    return policy["action_center"] + policy["action_half_range"] * np.tanh(mean + np.exp(log_std) * noise)


def run_episode(
    env: Any, policy: dict[str, np.ndarray], facts: dict[str, Any], seed: int, random: Any
) -> tuple[float, float]:
    """Return and cost of one episode."""
    obs, _ = env.reset(seed=seed)
    total, paid, done = 0.0, 0.0, False
    while not done:
        action = np.clip(act(policy, facts, obs, random), env.action_space.low, env.action_space.high)
        obs, reward, cost, terminated, truncated, _ = env.step(action)
        total, paid, done = total + reward, paid + cost, terminated or truncated
    return total, paid


def interval(values: np.ndarray) -> dict[str, float]:
    """Mean of [E] episodes and its 95 % interval."""
    mean, half = float(np.mean(values)), float(1.96 * np.std(values, ddof=1) / np.sqrt(len(values)))
    return {"mean": mean, "low": mean - half, "high": mean + half}


def main() -> None:
    """Entry point."""
    import safety_gymnasium  # type: ignore[import-not-found]

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with np.load(arguments.policy, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    facts = json.loads(str(arrays.pop("metadata")))
    here = {"return": arrays.pop("episode_return"), "cost": arrays.pop("episode_cost")}
    num_seeds, num_episodes = here["return"].shape
    env = safety_gymnasium.make(facts["original"])
    results = []
    for index in range(num_seeds):
        policy = {name: values[index] for name, values in arrays.items()}
        random = np.random.default_rng([arguments.seed, index])
        totals = [run_episode(env, policy, facts, arguments.seed + i, random) for i in range(num_episodes)]
        there = dict(zip(("return", "cost"), np.array(totals).T, strict=True))
        row = {name: {"here": interval(here[name][index]), "there": interval(there[name])} for name in here}
        results.append(row)
        for name, both in row.items():
            texts = [f"{k} {v['mean']:.2f} [{v['low']:.2f}, {v['high']:.2f}]" for k, v in both.items()]
            inside = both["here"]["low"] <= both["there"]["mean"] <= both["here"]["high"]
            print(f"seed {index} {name}: {', '.join(texts)}; inside the interval: {inside}", flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps({"facts": facts, "seeds": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
