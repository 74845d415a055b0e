"""Draws each shipped expert at work: `python docs/figures/make_experts.py [--out FOLDER] [TASK ...]`.

A picture shows an episode at several moments, as if it had been exposed at each of them.
"""

import argparse
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from make_tasks import VIEWS, Disc, expose, flat_objects, placed, save
from PIL import Image

import envs
from ccil_jax.acting import networks
from ccil_jax.acting.rollout import act
from experiments.policies import policy_file

FOLDER = Path(__file__).parent / "experts"
WIDE, SQUARE = (840, 220), (420, 380)  # pixels
EXPOSURES = 6
TRAIL = "#3b4a59"


@dataclasses.dataclass(frozen=True)
class Course:
    """How far the robot goes between exposures, and how far away the camera stands, in m."""

    gap: float
    distance: float


COURSES = {
    "Swimmer": Course(gap=1.3, distance=5.4),
    "HalfCheetah": Course(gap=1.3, distance=3.8),
    "Hopper": Course(gap=0.8, distance=3.9),
    "Walker2d": Course(gap=0.8, distance=3.9),
    "Ant": Course(gap=1.6, distance=4.8),
    "Humanoid": Course(gap=0.9, distance=5.6),
}
FIRST = 60  # step from which on a robot is shown: it has begun to move
ARRIVED = 0.9  # a reward above this has the bonus of 1 for reaching a goal or pressing a button


def load(name: str) -> tuple[Any, Any]:
    """The environment, and a function from a seed to the states of an episode of the shipped expert."""
    env = envs.make(name, physics="native")
    file = policy_file.read(policy_file.shipped() / f"{name}.npz")
    apply = networks.policy_of(file.config, env).apply
    actor = jax.tree.map(lambda leaf: leaf[0], file.actor())
    reset = jax.jit(env.reset)
    step = jax.jit(lambda state, noise: env.step(state, act(apply, actor, state.obs, noise)))

    def episode(seed: int) -> Iterator[Any]:
        reset_key, noise_key = jax.random.split(jax.random.key(seed))
        state = reset(reset_key)
        for noise in jax.random.normal(noise_key, (env.max_episode_steps, env.action_dim)):
            yield state
            state = step(state, noise)
            if state.done:
                return

    return env, episode


def draw_walk(name: str) -> Image.Image:
    """A robot that walks, hops or swims past the camera."""
    course, (env, episode) = COURSES[name], load(name)
    moments: list[Any] = []
    due = -np.inf
    for state in itertools.islice(episode(0), FIRST, None):
        data = placed(env, state)
        place = float(np.mean(data.xpos[1:, 0]))
        if place >= due:
            moments.append(data)
            due = place + course.gap
        if len(moments) == EXPOSURES:
            break
    middle = np.mean([np.mean(data.xpos[1:], axis=0) for data in moments], axis=0)
    at = (float(middle[0]), float(middle[1]), VIEWS[name].at[2])
    view = dataclasses.replace(VIEWS[name], at=at, distance=course.distance, azimuth=-90)
    return expose(env.model, moments, [], view, WIDE)


def draw_arena(name: str) -> Image.Image:
    """The way to the first goal that is reached, button that is pressed, or box that arrives."""
    env, episode = load(name)
    for seed in itertools.count():
        states = list(itertools.takewhile(lambda state: state.reward < ARRIVED, episode(seed)))
        if len(states) < env.max_episode_steps:
            break
    way = [np.asarray(env.situation(state.physics).robot[:2]) for state in states[::4]]
    trail: list[Disc] = [(place, 0.025, TRAIL) for place in way]
    moments = [placed(env, states[round(i)]) for i in np.linspace(0, len(states) - 1, EXPOSURES)]
    distance = 7.2 if "Push" in name else 5.8  # boxes are pushed beyond the square in which a layout is drawn
    view = dataclasses.replace(VIEWS[name], at=(0.0, 0.0, 0.0), distance=distance, elevation=62)
    return expose(env.model, moments, [*flat_objects(env, states[-1]), *trail], view, SQUARE)


def main() -> None:
    """Writes the pictures of the experts that the command line names, or of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    shipped = [name for name in VIEWS if (policy_file.shipped() / f"{name}.npz").is_file()]
    parser.add_argument("tasks", nargs="*", choices=[*shipped, []], metavar="TASK", help="tasks (default: all shipped)")
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER", help="folder of the pictures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks or shipped:
        save(draw_walk(name) if name in COURSES else draw_arena(name), arguments.out / f"{name}.png")


if __name__ == "__main__":
    main()
