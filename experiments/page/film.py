"""Episodes as films: the lines to draw in each frame, and the running return and cost.

A film is recorded while a policy acts; or made from a demonstration, where its observations say where the bodies are.
An environment is drawn from its own MuJoCo model, whatever its name is and whoever has built it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

import mujoco
import numpy as np

from ccil_jax.demonstrations.trajectories import Demonstrations
from envs.locomotion_tasks import LocomotionTask
from envs.safety_gym.tasks import ARENA
from experiments.page.strokes import Strokes, bodies, discs, drawn
from experiments.policies.evaluating import Loaded

View = Literal["side", "above", "arena"]
_FRAME_SECONDS = 0.035  # that a frame lasts at least: some 25 frames a second
_WORLD = 0  # the body of a MuJoCo model that holds what is fixed
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


def obstacle(env: Any) -> str:
    """Why no film can be made of an environment, as "it has no MuJoCo model"; empty where one can be made.

    A film needs four attributes, which `Locomotion` and `SafetyGym` have and wrappers such as `envs.with_cost` hand on:
    `model`, an `mujoco.MjModel`; `engine_arrays(state)`, the arrays of `MjData`, by name, that place its bodies; `dt`,
    the seconds of a step; and `view`, from where it is seen.
    """
    model = getattr(env, "model", None)
    if not isinstance(model, mujoco.MjModel):
        return "it has no MuJoCo model"
    if missing := [name for name in ("engine_arrays", "dt", "view") if not hasattr(env, name)]:
        return f"it has a MuJoCo model, but no attribute {' and no '.join(missing)}"
    if env.view not in get_args(View):
        return f"its attribute view is {env.view!r}, and not one of {', '.join(map(repr, get_args(View)))}"
    return "" if drawn(model, range(1, model.nbody)) else "no body of its MuJoCo model has a shape to draw"


def record(loaded: Loaded, index: int, *, seed: int = 0, deterministic: bool | None = None) -> Film:
    """A whole episode of a policy in our simulator.

    Args:
        loaded: policies of a task that can be drawn, see `obstacle`.
        index: of the policy that acts.
        seed: of the episode.
        deterministic: act with the mode of the policy (true) or sample (false); None does what the training says.
    """
    import jax

    from ccil_jax.acting import networks
    from ccil_jax.acting.rollout import act
    from envs.jax_tools import full_precision

    env = loaded.env
    by_mode = loaded.config.acts_by_mode(deterministic)
    apply = networks.policy_of(loaded.config, env).apply

    def look(state: Any) -> Any:
        objects = env.situation(state.physics).objects if env.view == "arena" else {}
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
        return look(start), jax.lax.scan(step, start, noise * (not by_mode))[1]

    actor = jax.tree.map(lambda leaf: leaf[index], loaded.actor)
    first, later = jax.device_get(run(actor, jax.random.key(seed)))
    arrays, objects, (returns, costs, done) = jax.tree.map(
        lambda one, others: np.concatenate([np.asarray(one)[None], others]), first, later
    )
    length = int(np.argmax(done)) if done.any() else len(done) - 1
    return _make(env, arrays, objects, returns[: length + 1], costs[: length + 1])


def of_demonstration(env: Any, demonstrations: Demonstrations) -> Film | None:
    """The first trajectory of demonstrations; None where their observations do not say where the bodies are.

    The observations of a locomotion task leave out the root's first coordinates. These are summed up here from the
    velocities, which are observed. The state after the last action is not recorded, so the last frame repeats a pose.
    """
    task = getattr(env, "task", None)
    if not isinstance(task, LocomotionTask) or task.observe is not None or task.num_hidden > _num_summable(env.model):
        return None
    length, hidden = int(demonstrations.episode_lengths[0]), task.num_hidden
    obs = demonstrations.obs[:length].astype(np.float64)
    shown = env.model.nq - hidden
    velocity = obs[:, shown : shown + hidden]
    moved = np.concatenate([np.zeros((1, hidden)), env.dt * (velocity[:-1] + velocity[1:]) / 2])
    root = env.model.qpos0[:hidden] + np.cumsum(moved, axis=0)
    qpos = np.concatenate([root, obs[:, :shown]], axis=1)
    rewards = np.full(length, np.nan) if demonstrations.rewards is None else demonstrations.rewards[:length]
    returns, costs = (np.cumsum([0.0, *values]) for values in (rewards, demonstrations.costs[:length]))
    return _make(env, {"qpos": np.concatenate([qpos, qpos[-1:]])}, {}, returns, costs)


def _num_summable(model: mujoco.MjModel) -> int:
    """How many leading coordinates of `qpos` are integrals of the entries of `qvel` at the same places."""
    kinds = model.jnt_type.tolist()
    is_simple = [kind in (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)) for kind in kinds]
    if all(is_simple):
        return int(model.nq)
    first = is_simple.index(False)
    return first + (3 if kinds[first] == int(mujoco.mjtJoint.mjJNT_FREE) else 0)  # its place, and not its rotation


def _make(
    env: Any,
    arrays: Mapping[str, np.ndarray],
    objects: Mapping[str, np.ndarray],
    returns: np.ndarray,
    costs: np.ndarray,
) -> Film:
    """The film of states that are [T + 1]-leading or longer; `returns` and `costs` are [T + 1]."""
    every = max(1, int(np.ceil(_FRAME_SECONDS / env.dt - 1e-9)))
    steps = np.unique([*range(0, len(costs), every), len(costs) - 1])
    arrays, objects = ({name: values[steps] for name, values in part.items()} for part in (arrays, objects))
    if not all(np.isfinite(values[-1]).all() for values in arrays.values()):  # the physics failed and ended the episode
        for values in (*arrays.values(), *objects.values()):
            values[-1] = values[-2]
    way, view = None, env.view
    if view == "arena":
        strokes, way = _arena(env, arrays, objects)
        centre = np.zeros((len(steps), 2))
        span = 2 * (max(ARENA, float(np.abs(strokes.places).max())) + _MARGIN)
    else:
        above = view == "above"
        strokes = bodies(env.model, arrays, dict.fromkeys(range(1, env.model.nbody), "body"), above=above)
        centre, span = _follow(strokes, view)
        strokes = strokes.over(bodies(env.model, arrays, {_WORLD: "scenery"}, above=above))  # walls and rails
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


def _follow(strokes: Strokes, view: View) -> tuple[np.ndarray, float]:
    """The middle of a picture that follows the bodies, [F, 2], and its height.

    The height is 1.6 to 8 m, unless the bodies are smaller than half a metre, or too large for that.
    """
    ends = strokes.places.reshape(len(strokes.places), -1, 2)
    middle = ends.mean(axis=1)
    radii = np.repeat([shape.width / 2 for shape in strokes.shapes], 2)[:, None]
    low, high = (ends - radii).min(axis=1), (ends + radii).max(axis=1)
    width, height = (high - low).max(axis=0)
    extent = size = max(width / 2, height)
    lowest = min(0.0, low[:, 1].min())
    if view == "side":
        extent = max(size, high[:, 1].max() - lowest)
    span = float(np.clip(1.5 * extent, min(1.6, 3.2 * size), max(8.0, 1.5 * size)))
    if view == "side":  # the floor stays where it is, near the bottom, unless something is below it
        middle[:, 1] = 0.36 * span + lowest
    return middle, span
