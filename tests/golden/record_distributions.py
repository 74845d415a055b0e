"""Records what a fixed policy earns, pays and touches in whole episodes of the original safety-gymnasium 1.0.0.

In the environment of `record_safety_gym.py`, from the project's root:

    .venv310/bin/python -m tests.golden.record_distributions --out tests/golden/safety_gym/distributions

`<Task>.npz`, one for each task: arrays [E], one number an episode of the policy `wanderer.py`, float64:
    return, cost         sums of the rewards and costs
    goals                how often the goal was met
    travelled            m, length of the robot's path
    cost_hazards, cost_buttons, cost_gremlins   steps that cost by that, where the task charges for it
    touch_vase, touch_gremlin, touch_button, touch_pillar, touch_box   steps after which the robot touches one
    moved_vase, moved_box   m, from where the object stood at the start to where it is at the end
metadata [] str: JSON with versions, command, seed and the number of steps.
"""

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.golden.record_safety_gym import TASKS, Scene, geom_owners, provenance, touching
from tests.golden.wanderer import act, plan

COSTS = ("cost_hazards", "cost_buttons", "cost_gremlins")


def run_episode(scene: Scene, seed: int, num_steps: int) -> dict[str, float]:
    """The numbers of one episode."""
    obs, _ = scene.env.reset(seed=seed)
    num_lidars = sum(name.endswith("_lidar") for name in scene.env.unwrapped.obs_space_dict)
    followed, noise = plan(np.random.default_rng(seed), num_steps, num_lidars, scene.model.nu)
    kinds = geom_owners(scene.model)[1]
    robot = scene.model.body("agent").id
    free = {kind: ids for kind, ids in kinds.items() if kind in ("vase", "box")}
    starts = {kind: scene.data.xpos[ids].copy() for kind, ids in free.items()}
    totals = dict.fromkeys(("return", "cost", "goals", "travelled", *(f"touch_{kind}" for kind in kinds)), 0.0)
    place = scene.xy("agent")
    for step in range(num_steps):
        action = act(scene.robot, num_lidars, obs[None], followed[step : step + 1], noise[step : step + 1])[0]
        obs, reward, cost, terminated, truncated, info = scene.env.step(action)
        if terminated or truncated:
            raise RuntimeError(f"{scene.name}: the episode ended after {step + 1} steps")
        pairs = touching(scene.model, scene.data)
        partners = pairs[(pairs == robot).any(axis=1)].ravel()
        seen: dict[str, Any] = {f"touch_{kind}": np.isin(ids, partners).any() for kind, ids in kinds.items()}
        seen |= {"return": reward, "cost": cost, "goals": info.get("goal_met", False)}
        seen |= {name: info[name] > 0 for name in COSTS if name in info}
        seen["travelled"] = np.linalg.norm(scene.xy("agent") - place)
        place = scene.xy("agent")
        for name, value in seen.items():
            totals[name] = totals.get(name, 0.0) + float(value)
    moved = {f"moved_{k}": float(np.linalg.norm(scene.data.xpos[ids] - starts[k])) for k, ids in free.items()}
    return totals | moved


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the files")
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=TASKS, metavar="TASK", help=" ".join(TASKS))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--steps", type=int, default=300, help="of each episode")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.tasks:
        scene, episodes = Scene(name), []
        for index in range(options.episodes):
            episodes.append(run_episode(scene, 10_000 * options.seed + index, options.steps))
            if index % 20 == 19:
                print(
                    name,
                    index + 1,
                    {k: round(float(np.mean([e[k] for e in episodes])), 3) for k in episodes[0]},
                    flush=True,
                )
        arrays = {key: np.array([episode[key] for episode in episodes]) for key in episodes[0]}
        command = shlex.join(["python", "-m", "tests.golden.record_distributions", *sys.argv[1:]])
        own = {"command": command, "task": f"Safety{name}-v0", "num_steps": options.steps}
        facts: dict[str, Any] = provenance(options) | own
        np.savez_compressed(options.out / f"{name}.npz", metadata=np.array(json.dumps(facts)), **arrays)


if __name__ == "__main__":
    main()
