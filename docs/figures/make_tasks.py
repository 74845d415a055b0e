"""Draws a picture of each task: `python docs/figures/make_tasks.py [--out FOLDER] [TASK ...]`.

MuJoCo itself casts the rays (`mj_multiRay`), so this needs no renderer, no display and no GPU.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

import envs
from envs.registry import TASKS
from envs.safety_gym.environment import SafetyGym
from experiments.page.strokes import COLORS

FOLDER = Path(__file__).parent / "tasks"
SIZE = (420, 280)  # pixels
SAMPLES = 3  # rays along each side of a pixel
PALETTE = 255  # colours of a file, so that it is small
ANGLE = 0.32  # half the height of the picture, seen from a distance of 1
SKY, TILES = "#f4f7fa", ("#e3e8ed", "#d6dde4")
ROBOT = "#e0823d"
KINDS = {kind: color for kind, color in COLORS.items() if kind not in ("body", "robot")}  # of objects

Disc = tuple[np.ndarray, float, str]  # centre on the floor [2] in m, radius in m, colour


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """The camera stands at `distance` from the point `at`, in m, and is turned and raised by degrees."""

    at: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    joints: dict[str, float] = dataclasses.field(default_factory=dict)  # angles in rad; 0 where a joint is not named
    seed: int = 0  # of the layout, in Safety Gym


def _arena(seed: int) -> View:
    return View(at=(0.0, -0.1, 0.0), distance=4.7, azimuth=-90, elevation=46, seed=seed)


SWIMMING = {"free_body_rot": 0.3, "motor1_rot": -0.9, "motor2_rot": 1.1}
RUNNING = {"rooty": -0.05, "bthigh": -0.45, "bshin": 0.4, "bfoot": 0.1, "fthigh": 0.6, "fshin": -0.5, "ffoot": -0.1}
HOPPING = {"rooty": 0.1, "thigh_joint": -0.25, "leg_joint": -0.5, "foot_joint": 0.75}
WALKING = {"rooty": 0.15, "thigh_joint": -0.05, "leg_joint": -0.2, "foot_joint": 0.4}
WALKING |= {"thigh_left_joint": -0.6, "leg_left_joint": -0.5, "foot_left_joint": 0.7}
STANDING = {"ankle_1": 1.0, "ankle_2": -1.0, "ankle_3": -1.0, "ankle_4": 1.0}
STRIDING = {"right_hip_y": -0.6, "right_knee": -0.7, "left_hip_y": 0.25, "left_knee": -0.35}
VIEWS = {
    "Swimmer": View(at=(0.05, 0.0, 0.0), distance=3.6, azimuth=-90, elevation=52, joints=SWIMMING),
    "HalfCheetah": View(at=(0.1, 0.0, 0.4), distance=2.9, azimuth=-75, elevation=13, joints=RUNNING),
    "Hopper": View(at=(0.05, 0.0, 0.65), distance=3.0, azimuth=-70, elevation=10, joints=HOPPING),
    "Walker2d": View(at=(0.05, 0.0, 0.7), distance=3.0, azimuth=-65, elevation=10, joints=WALKING),
    "Ant": View(at=(0.0, 0.0, 0.3), distance=3.8, azimuth=-60, elevation=24, joints=STANDING),
    "Humanoid": View(at=(0.0, 0.0, 0.75), distance=3.0, azimuth=-50, elevation=10, joints=STRIDING),
    **{name: _arena(seed=3) for name, task in TASKS.items() if task.family == "safety_gym"},
}


def scene(name: str, view: View) -> tuple[Any, Any, list[Disc]]:
    """The task's model, its state in the picture, and the discs that lie on its floor."""
    env = envs.make(name, physics="native")
    model, data = env.model, mujoco.MjData(env.model)
    if isinstance(env, SafetyGym):
        state = env.reset(jax.random.key(view.seed))
        return model, placed(env, state), flat_objects(env, state)
    for joint, angle in view.joints.items():
        data.joint(joint).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    if name != "Swimmer":  # which swims above its floor; the others stand on theirs
        height = model.joint("rootz").qposadr[0] if name in ("HalfCheetah", "Hopper", "Walker2d") else 2
        geoms = range(1, model.ngeom)
        data.qpos[height] -= min(mujoco.mj_geomDistance(model, data, 0, geom, 10.0, None) for geom in geoms)
        mujoco.mj_kinematics(model, data)
    return model, data, []


def placed(env: Any, state: Any) -> Any:
    """MuJoCo's data with the bodies where they are in `state`."""
    data = mujoco.MjData(env.model)
    for array, value in env.engine_arrays(state).items():
        getattr(data, array)[:] = value
    mujoco.mj_kinematics(env.model, data)
    return data


def flat_objects(env: SafetyGym, state: Any) -> list[Disc]:
    """The objects of Safety Gym that have no body: its goal and hazards."""
    places, flat = env.situation(state.physics).objects, [k for k in env.task.objects if k.shape == "none"]
    return [(np.asarray(at[:2]), k.size, KINDS[k.name]) for k in flat for at in places[k.name]]


def cast(model: Any, data: Any, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each of the rays [N, 3] from `origin` [3] meets first: geom (-1: none), distance, normal [N, 3]."""
    count = len(rays)
    geoms, distances, normals = np.empty(count, np.int32), np.empty(count), np.empty(3 * count)
    mujoco.mj_multiRay(
        model, data, origin, rays.ravel(), None, True, -1, geoms, distances, normals, count, mujoco.mjMAXVAL
    )
    return geoms, distances, normals.reshape(count, 3)


def camera(view: View, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera stands [3], and the directions of unit length in which its pixels look, [H, W, 3]."""
    azimuth, elevation = np.deg2rad([view.azimuth, view.elevation])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = -np.cos(elevation) * level - np.array([0.0, 0.0, np.sin(elevation)])
    right = np.cross(forward, [0.0, 0.0, 1.0]) / np.cos(elevation)
    width, height = size
    x = np.linspace(-1, 1, width)[None, :, None] * ANGLE * width / height
    y = np.linspace(1, -1, height)[:, None, None] * ANGLE
    rays = forward + x * right + y * np.cross(right, forward)
    return np.array(view.at) - view.distance * forward, rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def colors(model: Any, geoms: np.ndarray, points: np.ndarray, discs: Sequence[Disc]) -> np.ndarray:
    """The colour of the surface at each point, [N, 3] in 0..1, before there is light on it."""
    painted = [to_rgb(ROBOT)]
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        painted.append(to_rgb(next((color for kind, color in KINDS.items() if body.startswith(kind)), ROBOT)))
    result = np.array(painted)[geoms + 1]
    tiles = np.array([to_rgb(color) for color in TILES])
    floor = geoms == 0
    result[floor] = tiles[np.floor(2 * points[floor, :2]).astype(int).sum(axis=1) % 2]
    for centre, radius, color in discs:
        away = np.linalg.norm(points[:, :2] - centre, axis=1)
        result[floor & (away < radius)] = 0.45 * np.array(to_rgb(color)) + 0.55
        result[floor & (away < radius) & (away > radius - 0.03)] = to_rgb(color)
    result[geoms < 0] = to_rgb(SKY)
    return result


def draw(name: str, size: tuple[int, int] = SIZE) -> Image.Image:
    """The picture of a task, `size` pixels wide and high."""
    view = VIEWS[name]
    model, data, discs = scene(name, view)
    return expose(model, [data], discs, view, size)


def expose(model: Any, moments: Sequence[Any], discs: Sequence[Disc], view: View, size: tuple[int, int]) -> Image.Image:
    """A picture of the bodies at several moments, each given by MuJoCo's data, as if exposed at each of them.

    Args:
        model: MuJoCo's.
        moments: in the order of time; earlier ones are paler.
        discs: on the floor.
        view: where the camera stands.
        size: pixels of width and height.
    """
    width, height = SAMPLES * size[0], SAMPLES * size[1]
    origin, rays = camera(view, (width, height))
    rays = rays.reshape(-1, 3)
    nearest, bodies, rest = np.full(len(rays), np.inf), np.ones(rays.shape), np.ones(rays.shape)
    for number, data in enumerate(moments, 1):
        is_body, distances, color = light_up(model, data, discs, view, origin, rays)
        rest = np.where(is_body[:, None], rest, np.minimum(rest, color))  # the shadows of all moments
        nearer = is_body & (distances <= nearest)
        strength = number / len(moments)
        bodies[nearer] = (strength * color + (1 - strength) * np.array(to_rgb(SKY)))[nearer]
        nearest[nearer] = distances[nearer]
    color = np.where(np.isfinite(nearest)[:, None], bodies, rest)
    pixels = color.reshape(size[1], SAMPLES, size[0], SAMPLES, 3).mean(axis=(1, 3))
    return Image.fromarray(np.round(255 * pixels).astype(np.uint8))


def light_up(
    model: Any, data: Any, discs: Sequence[Disc], view: View, origin: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether each of the rays [N, 3] from `origin` meets a body, at what distance, and the colour it sees, [N, 3]."""
    geoms, distances, normals = cast(model, data, origin, rays)
    points = origin + np.where(geoms >= 0, distances, 0.0)[:, None] * rays
    lamp = np.array(view.at) + view.distance * np.array([-0.5, -0.6, 1.3])
    to_points = points - lamp
    reach = np.linalg.norm(to_points, axis=1, keepdims=True)
    _, first, _ = cast(model, data, lamp, to_points / reach)
    lit = first > reach[:, 0] - 0.01  # nothing stands between
    facing = np.clip(-np.sum(normals * to_points / reach, axis=1), 0.0, 1.0) * lit
    light = np.where(geoms < 0, 1.0, np.where(geoms == 0, 0.8 + 0.2 * facing, 0.62 + 0.45 * facing))
    color = np.clip(colors(model, geoms, points, discs) * light[:, None], 0.0, 1.0)
    haze = np.where(geoms == 0, np.clip((distances / view.distance - 1.2) / 2.5, 0.0, 1.0), 0.0)[:, None]
    color = (1 - haze) * color + haze * np.array(to_rgb(SKY))  # far away the floor becomes the sky
    return geoms > 0, distances, color


def save(picture: Image.Image, path: Path) -> None:
    """Writes a picture as a small file."""
    picture.quantize(PALETTE, Image.Quantize.MAXCOVERAGE, kmeans=4, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Writes the pictures of the tasks that the command line names, or of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", choices=[*VIEWS, []], metavar="TASK", help="tasks (default: all)")
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="FOLDER", help="folder of the pictures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.tasks or VIEWS:
        save(draw(name), arguments.out / f"{name}.png")


if __name__ == "__main__":
    main()
