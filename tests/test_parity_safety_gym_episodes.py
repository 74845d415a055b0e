"""Whole episodes under a fixed policy, here and in safety-gymnasium 1.0.0 (`tests/golden/record_distributions.py`).

The original runs on MuJoCo 2.3.3, which finds other contact points between two boxes: where robot and objects touch, no
step can be compared (on the same MuJoCo they agree, see `test_parity_safety_gym.py`). What an episode earns, pays and
touches must then be alike in distribution.
"""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.stats import ks_2samp

from envs.base import State
from envs.safety_gym.environment import SafetyGym
from envs.safety_gym.tasks import TABLE
from tests.golden.wanderer import act, plan

pytestmark = pytest.mark.once

FOLDER = Path(__file__).parent / "golden" / "safety_gym" / "distributions"
KINDS = {"vase": "vases", "gremlin": "gremlins", "button": "buttons", "pillar": "pillars", "box": "push_box"}
SETTLED = 1e-3  # m
SIGNIFICANCE = 1e-3  # of each comparison; there are some 70


def objects_of(env: SafetyGym) -> dict[str, list[int]]:
    """Kind, by the recorder's name -> its bodies."""
    names = [env.model.body(i).name for i in range(env.model.nbody)]
    found = {
        kind: [i for i, name in enumerate(names) if name.startswith(f"{ours}_") and not name.endswith("target")]
        for kind, ours in KINDS.items()
    }
    return {kind: bodies for kind, bodies in found.items() if bodies}


class Onlooker:
    """What the recorder notes of a step, beside what `State` says: places, and contacts by C MuJoCo's own list."""

    def __init__(self, env: SafetyGym):
        self.env, self.data, self.objects = env, mujoco.MjData(env.model), objects_of(env)
        self.owners = env.model.body_rootid[env.model.geom_bodyid]

    @functools.partial(jax.jit, static_argnums=0)
    def look(self, state: State) -> dict[str, jax.Array]:
        """Where the robot is [N, 2], and the only vase and box [N, 3]; and the engine's arrays."""

        def one(state: State) -> dict[str, jax.Array]:
            world = state.physics
            seen = {k: self.env._centres(world, KINDS[k])[0] for k in ("vase", "box") if k in self.objects}
            return self.env.engine_arrays(state) | seen | {"robot": self.env._robot_pose(world.data)[0][:2]}

        return jax.vmap(one)(state)

    def touches(self, seen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """touch_<kind> -> [N] bool."""
        robot, num_episodes = self.env.model.body("robot").id, len(seen["qpos"])
        touched = {f"touch_{kind}": np.zeros(num_episodes, bool) for kind in self.objects}
        for i in range(num_episodes):
            for name in seen.keys() & {"qpos", "mocap_pos", "mocap_quat"}:
                getattr(self.data, name)[:] = seen[name][i]
            mujoco.mj_fwdPosition(self.env.model, self.data)
            pairs = np.stack([self.owners[self.data.contact.geom1], self.owners[self.data.contact.geom2]], axis=1)
            partners = pairs[(pairs == robot).any(axis=1)]
            for kind, bodies in self.objects.items():
                touched[f"touch_{kind}"][i] = np.isin(bodies, partners).any()
        return touched


def episodes(env: SafetyGym, num_episodes: int, num_steps: int, seed: int) -> dict[str, np.ndarray]:
    """The recorder's numbers, of our episodes: [num_episodes] each."""
    num_lidars, onlooker, step = len(env.task.lidars), Onlooker(env), jax.jit(jax.vmap(env.step))
    randoms = [np.random.default_rng([seed, i]) for i in range(num_episodes)]
    plans = [plan(random, num_steps, num_lidars, env.action_dim) for random in randoms]
    followed, noise = (np.stack(column, axis=1) for column in zip(*plans, strict=True))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(seed), num_episodes))
    start = before = jax.device_get(onlooker.look(state))
    totals: dict[str, Any] = {}
    for t in range(num_steps):
        action = act(env.scene.robot.name, num_lidars, np.asarray(state.obs), followed[t], noise[t])
        state = step(state, jnp.asarray(action, jnp.float32))
        now = jax.device_get(onlooker.look(state))
        seen: dict[str, Any] = onlooker.touches(now)
        seen |= {f"cost_{name}": state.terms[f"cost_{name}"] for name in env.task.costs}
        seen |= {"goals": state.terms["bonus"], "travelled": np.linalg.norm(now["robot"] - before["robot"], axis=1)}
        totals = {name: totals.get(name, 0.0) + np.asarray(value, float) for name, value in seen.items()}
        before = now
    moved = {
        f"moved_{kind}": np.linalg.norm(before[kind] - start[kind], axis=1) for kind in ("vase", "box") if kind in start
    }
    return totals | moved | {"return": np.asarray(state.episode_return), "cost": np.asarray(state.episode_cost)}


def compare(name: str, num_episodes: int, **options: Any) -> dict[str, tuple[float, float, float]]:
    """Number -> mean there, mean here, p value of the two-sample Kolmogorov-Smirnov test."""
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
        theirs = {key: file[key] for key in file.files if key != "metadata"}
    env = SafetyGym(name, physics="native", **options)
    ours = episodes(env, num_episodes, 300, seed=0)
    assert set(ours) == set(theirs)
    for name in ours:
        if name.startswith("moved_"):  # what nobody pushes settles by micrometres, each engine's own
            theirs[name], ours[name] = (np.where(moved[name] < SETTLED, 0, moved[name]) for moved in (theirs, ours))
    p_value = {name: ks_2samp(theirs[name], ours[name], method="asymp").pvalue for name in ours}
    return {name: (theirs[name].mean(), ours[name].mean(), p_value[name]) for name in sorted(ours)}


QUICK = ("PointGoal1", "PointButton1")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in TABLE])
def test_episodes_are_alike_in_distribution(name: str) -> None:
    found = compare(name, num_episodes=100 if name in QUICK else 200)
    differing = {key: values for key, values in found.items() if values[2] < SIGNIFICANCE}
    assert not differing
    if not name.startswith("Doggo"):  # else nothing is compared
        assert min(there for key, (there, _, _) in found.items() if key.startswith("touch_")) > 1
