"""A Safety Gym episode as one picture from above: the layout, the robot's path, its costs, and the goals that it met.

It is drawn with matplotlib, and needs no renderer, display or GPU.
"""

import dataclasses
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from envs.safety_gym.environment import SafetyGym
from envs.safety_gym.tasks import ARENA, ObjectKind
from experiments.policies.numpy_policy import NumpyPolicy
from experiments.runs import figures

COLORS = {  # of the kinds of objects
    "hazards": "#3f6fb5",
    "goal": "#6a994e",
    "vases": "#00a5a5",
    "buttons": "#e6c229",
    "gremlins": "#7b5ea7",
    "pillars": "#8a8f98",
    "push_box": "#a44a3f",
}
_PAID, _WAY = "#d1495b", "viridis"


@dataclasses.dataclass(frozen=True)
class Episode:
    """T control steps; positions on the floor in metres."""

    robot: np.ndarray  # [T + 1, 2]
    objects: dict[str, np.ndarray]  # by kind, [T + 1, count, 2]; a goal's row is the goal that holds after the step
    costs: np.ndarray  # [T] 0 or 1
    met: np.ndarray  # [T] bool: whether the task's goal was met in this step
    episode_return: float


def record(env: SafetyGym, policy: NumpyPolicy, *, num_steps: int = 1000, seed: int = 0) -> Episode:
    """The first `num_steps` steps of an episode, or all of a shorter one."""
    import jax

    def seen(state: Any) -> tuple[Any, Any]:
        situation = env.situation(state.physics)
        return situation.robot[:2], {name: centres[:, :2] for name, centres in situation.objects.items()}

    step, look, random = jax.jit(env.step), jax.jit(seen), np.random.default_rng(seed)
    state = jax.jit(env.reset)(jax.random.key(seed))
    places, costs, met = [jax.device_get(look(state))], list[float](), list[bool]()
    while len(costs) < num_steps and not state.done:
        state = step(state, np.asarray(policy.sample(np.asarray(state.obs), random), np.float32))
        places.append(jax.device_get(look(state)))
        costs.append(float(state.cost))
        met.append(bool(state.terms["bonus"]))
    return Episode(
        robot=np.array([robot for robot, _ in places]),
        objects={name: np.array([objects[name] for _, objects in places]) for name in places[0][1]},
        costs=np.array(costs),
        met=np.array(met),
        episode_return=float(state.episode_return),
    )


def draw(env: SafetyGym, episode: Episode) -> Figure:
    """Draws the picture. The path is coloured by time, from dark to light; red dots show where a cost is paid."""
    with mpl.rc_context(figures.STYLE):
        figure = Figure(figsize=(7.2, 6.4), layout="constrained")
        axes = figure.add_subplot()
        _draw_arena(axes)
        reach = max(ARENA + 0.7, float(np.abs(episode.robot).max()) + 0.2)
        axes.set_xlim(-reach, reach)
        axes.set_ylim(-reach, reach)
        for kind in env.task.objects:
            _draw_kind(axes, kind, episode)
        _draw_way(axes, episode)
        steps, paid = len(episode.costs), int(episode.costs.sum())
        axes.set_title(
            f"{env.name}: {steps:,} steps, return {episode.episode_return:.1f}, cost {paid:,}, met {episode.met.sum()}"
        )
        axes.set_xlabel("m")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        axes.set_aspect("equal")
    return figure


def _draw_arena(axes: Axes) -> None:
    square = Rectangle(
        (-ARENA, -ARENA), 2 * ARENA, 2 * ARENA, fill=False, ls="--", ec="#8a8f98", label="layouts within"
    )
    axes.add_patch(square)


def _draw_kind(axes: Axes, kind: ObjectKind, episode: Episode) -> None:
    """Draws where the objects of a kind start and, as thin lines, the paths of those that can move."""
    color, places = COLORS[kind.name], episode.objects[kind.name]
    label: str | None = kind.name.replace("_", " ")
    if kind.name == "goal":
        turns = np.flatnonzero(np.concatenate([[True], episode.met]))
        for number, place in enumerate(places[turns, 0], start=1):
            axes.add_patch(Circle(tuple(place), kind.size, fc=color, alpha=0.18, ec=color, label=label))
            axes.annotate(str(number), tuple(place), ha="center", va="center", color=color, fontweight="bold")
            label = None
        return
    for path in np.moveaxis(places, 1, 0):
        if kind.free:
            axes.plot(*path.T, color=color, lw=0.8, alpha=0.7)
        style: Any = {"fc": color, "alpha": 0.45, "ec": color, "label": label}
        if kind.shape in ("none", "sphere", "cylinder"):
            axes.add_patch(Circle(tuple(path[0]), kind.size, **style))
        else:
            axes.add_patch(Rectangle(tuple(path[0] - kind.size), 2 * kind.size, 2 * kind.size, **style))
        label = None


def _draw_way(axes: Axes, episode: Episode) -> None:
    robot = episode.robot
    segments = np.stack([robot[:-1], robot[1:]], axis=1)
    way = LineCollection(list(segments), cmap=_WAY, array=np.arange(len(segments)), lw=1.4, label="the robot's way")
    axes.add_collection(way)
    axes.plot(*robot[0], marker="o", color="black", ms=5, ls="none", label="start")
    paid = robot[1:][episode.costs > 0]
    axes.plot(*paid.T, marker=".", ms=4, ls="none", color=_PAID, label="a cost is paid")
