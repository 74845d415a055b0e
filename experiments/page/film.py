"""Episodes as films: the lines to draw in each frame, and the running return and cost.

A film is recorded while a policy acts; or made from a demonstration, where its observations say where the bodies are.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ccil_jax.demonstrations.trajectories import Demonstrations
from envs.locomotion_tasks import LocomotionTask
from envs.safety_gym.tasks import ARENA
from experiments.page.strokes import Strokes, bodies, discs
from experiments.policies.evaluating import Loaded

View = Literal["side", "above", "arena"]
_FRAME_SECONDS = 0.035  # that a frame lasts at least: some 25 frames a second
_MARGIN = 0.4  # m around everything that is seen of an arena


@dataclasses.dataclass(frozen=True, kw_only=True)
class Film:
    """F frames of an episode of T steps. The first frame shows the start, and the last one the end."""

    view: View  # bodies seen from the side or from above, or a map of the whole arena
    strokes: Strokes  # [F]
    centre: np.ndarray  # [F, 2] m: the point in the middle of the picture
    span: float  # m from bottom to top of the picture
    way: np.ndarray | None  # [F, 2] m: where the robot of an arena is; None elsewhere
    steps: np.ndarray  # [F] steps taken before the frame
    returns: np.ndarray  # [F] sum of rewards so far; NaN where rewards are unknown
    costs: np.ndarray  # [F] sum of costs so far
    paid: np.ndarray  # [F] bool: a cost was paid since the last frame
    dt: float  # s, of a step

    @property
    def aspect(self) -> float:
        """Width of the picture divided by its height."""
        return 1.0 if self.view == "arena" else 2.0


def record(loaded: Loaded, index: int, *, seed: int = 0, deterministic: bool = False) -> Film:
    """A whole episode of a policy in our simulator.

    Args:
        loaded: policies of a task that can be drawn: its `TaskInfo.view` is not None.
        index: of the policy that acts.
        seed: of the episode.
        deterministic: act with the mode of the policy instead of sampling.
    """
    import jax

    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from envs.jax_tools import full_precision

    env, view = loaded.env, _view(loaded)
    apply = networks.policy_of(loaded.config, env).apply

    def look(state: Any) -> Any:
        objects = env.situation(state.physics).objects if view == "arena" else {}
        return env.engine_arrays(state), objects, (state.episode_return, state.episode_cost, state.done)

    @jax.jit
    @full_precision
    def run(actor: Any, key: Any) -> Any:
        reset_key, noise_key = jax.random.split(key)

        def step(state: Any, noise: Any) -> Any:
            state = env.step(state, act(apply, actor, state.obs, noise))
            return state, look(state)

        noise = jax.random.normal(noise_key, (env.max_episode_steps, env.action_dim))
        start = env.reset(reset_key)
        return look(start), jax.lax.scan(step, start, noise * (not deterministic))[1]

    actor = jax.tree.map(lambda leaf: leaf[index], loaded.actor)
    first, later = jax.device_get(run(actor, jax.random.key(seed)))
    arrays, objects, (returns, costs, done) = jax.tree.map(
        lambda one, others: np.concatenate([np.asarray(one)[None], others]), first, later
    )
    length = int(np.argmax(done)) if done.any() else len(done) - 1
    return _make(env, view, arrays, objects, returns[: length + 1], costs[: length + 1])


def of_demonstration(env: Any, view: View, demonstrations: Demonstrations) -> Film | None:
    """The first trajectory of demonstrations; None where their observations do not say where the bodies are.

    The observations of a locomotion task leave out the root's first coordinates. These are summed up here from the
    velocities, which are observed. The state after the last action is not recorded, so the last frame repeats a pose.
    """
    task = getattr(env, "task", None)
    if not isinstance(task, LocomotionTask) or task.observe is not None:
        return None
    length, hidden = int(demonstrations.episode_lengths[0]), task.num_hidden
    obs = demonstrations.obs[:length].astype(np.float64)
    shown = env.model.nq - hidden
    velocity = obs[:, shown : shown + hidden]
    moved = np.concatenate([np.zeros((1, hidden)), env.dt * (velocity[:-1] + velocity[1:]) / 2])
    qpos = np.concatenate([np.cumsum(moved, axis=0), obs[:, :shown]], axis=1)
    rewards = np.full(length, np.nan) if demonstrations.rewards is None else demonstrations.rewards[:length]
    returns, costs = (np.cumsum([0.0, *values]) for values in (rewards, demonstrations.costs[:length]))
    return _make(env, view, {"qpos": np.concatenate([qpos, qpos[-1:]])}, {}, returns, costs)


def _view(loaded: Loaded) -> View:
    if loaded.task.view is None:
        raise ValueError(f"{loaded.task.name}: cannot be drawn, its `TaskInfo.view` is None")
    return loaded.task.view


def _make(
    env: Any,
    view: View,
    arrays: Mapping[str, np.ndarray],
    objects: Mapping[str, np.ndarray],
    returns: np.ndarray,
    costs: np.ndarray,
) -> Film:
    """The film of states that are [T + 1]-leading or longer; `returns` and `costs` are [T + 1]."""
    every = max(1, int(np.ceil(_FRAME_SECONDS / env.dt - 1e-9)))
    steps = np.unique([*range(0, len(costs), every), len(costs) - 1])
    arrays, objects = ({name: values[steps] for name, values in part.items()} for part in (arrays, objects))
    way = None
    if view == "arena":
        strokes, way = _arena(env, arrays, objects)
        centre = np.zeros((len(steps), 2))
        span = 2 * (max(ARENA, float(np.abs(strokes.places).max())) + _MARGIN)
    else:
        moving = dict.fromkeys(range(1, env.model.nbody), "body")
        strokes = bodies(env.model, arrays, moving, above=view == "above")
        centre, span = _follow(strokes.places, view)
    return Film(
        view=view,
        strokes=strokes,
        centre=centre,
        span=span,
        way=way,
        steps=steps,
        returns=returns[steps],
        costs=costs[steps],
        paid=np.diff(costs[steps], prepend=0.0) > 0,
        dt=env.dt,
    )


def _arena(env: Any, arrays: Mapping[str, np.ndarray], objects: Mapping[str, np.ndarray]) -> tuple[Strokes, np.ndarray]:
    """The objects and the robot of a Safety Gym task, the robot last, and where the robot is, [F, 2]."""
    model = env.model
    free = [kind.name for kind in env.task.objects if kind.free]
    names = {body: model.body(body).name.rpartition("_")[0] for body in range(1, model.nbody)}
    boxes = {body: name for body, name in names.items() if name in free}
    robot = model.body("robot").id
    parts = {body: "robot" for body in range(model.nbody) if model.body_rootid[body] == robot}
    drawn = bodies(model, arrays, {**boxes, **parts}, above=True)
    for kind in reversed([kind for kind in env.task.objects if not kind.free]):
        drawn = drawn.over(discs(kind, objects[kind.name][:, :, :2]))
    first = next(i for i, shape in enumerate(drawn.shapes) if shape.kind == "robot")
    return drawn, drawn.places[:, first, :2] / 2 + drawn.places[:, first, 2:] / 2


def _follow(places: np.ndarray, view: View) -> tuple[np.ndarray, float]:
    """The middle of a picture that follows the bodies, [F, 2], and its height."""
    ends = places.reshape(len(places), -1, 2)
    middle = ends.mean(axis=1)
    width, height = np.ptp(ends, axis=1).max(axis=0)
    extent = max(width / 2, height) if view == "above" else ends[..., 1].max()
    span = float(np.clip(1.5 * extent, 1.6, 8.0))
    if view == "side":  # the floor stays where it is, near the bottom
        middle[:, 1] = 0.36 * span
    return middle, span
