"""An episode as an animation on the page: recorded poses, projected on a plane, which a short script draws.

The page needs no network. No renderer is involved, because on a machine without a display it is not certain that EGL,
OSMesa or GLFW works.
"""

import dataclasses
import html
import json
from typing import Any

import mujoco
import numpy as np

from experiments.page import top_down
from experiments.policies.evaluating import Loaded
from experiments.policies.numpy_policy import NumpyPolicy, policies
from experiments.runs import figures

_STEPS_PER_FRAME = 2

_SCRIPT = """
(() => {
  const data = DATA, canvas = document.getElementById(data.id), pen = canvas.getContext("2d");
  const scale = canvas.height / data.span, floor = data.above ? null : canvas.height * 0.88;
  let frame = 0;
  const draw = () => {
    const bones = data.frames[frame];
    const mean = i => bones.reduce((sum, b) => sum + b[i] + b[i + 2], 0) / (2 * bones.length);
    const centre = mean(0), middle = mean(1);
    const x = v => (v - centre) * scale + canvas.width / 2;
    const y = v => floor === null ? canvas.height / 2 - (v - middle) * scale : floor - v * scale;
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.strokeStyle = "#d5d9de"; pen.lineWidth = 1; pen.beginPath();
    for (let m = Math.floor(centre - 9); m < centre + 9; m++) { pen.moveTo(x(m), 0); pen.lineTo(x(m), canvas.height); }
    if (floor !== null) { pen.moveTo(0, floor); pen.lineTo(canvas.width, floor); }
    pen.stroke();
    pen.lineCap = "round"; pen.strokeStyle = data.costs[frame] ? "#d1495b" : "#0b6e99";
    bones.forEach((b, i) => {
      pen.lineWidth = Math.max(2, 2 * data.radii[i] * scale); pen.beginPath();
      pen.moveTo(x(b[0]), y(b[1])); pen.lineTo(x(b[2]) + 0.01, y(b[3])); pen.stroke();
    });
    frame = (frame + 1) % data.frames.length;
  };
  draw(); setInterval(draw, data.milliseconds);
})();
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Poses:
    """F frames of G line segments in a plane, each x1, y1, x2, y2 in metres."""

    frames: np.ndarray  # [F, G, 4]
    radii: np.ndarray  # [G]
    costs: np.ndarray  # [F] bool: a cost was paid in this frame
    num_steps: int  # steps of the episode that were recorded; the episode may be longer
    seconds_per_frame: float
    above: bool  # whether the plane is the floor; otherwise it is vertical, with y upwards


def record_poses(env: Any, policy: NumpyPolicy, *, above: bool = False, num_steps: int = 300, seed: int = 0) -> Poses:
    """The first `num_steps` steps of an episode of a locomotion task, or all steps of a shorter episode.

    Args:
        env: the task.
        policy: that acts.
        above: whether the bodies are seen from above; otherwise they are seen from the side.
        num_steps: that are recorded at most.
        seed: of the episode.
    """
    import jax

    step, random = jax.jit(env.step), np.random.default_rng(seed)
    state = jax.jit(env.reset)(jax.random.key(seed))
    model, data = env.model, mujoco.MjData(env.model)
    geoms = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    axes = [0, 1] if above else [0, 2]
    frames, costs, cost, taken = [], [], False, 0
    for i in range(num_steps):
        if i % _STEPS_PER_FRAME == 0:
            data.qpos[:] = np.asarray(env.engine_arrays(state)["qpos"])
            mujoco.mj_kinematics(model, data)
            frames.append(_segments(model, data, geoms)[:, :, axes].reshape(len(geoms), 4))
            costs.append(cost)
            cost = False
        if bool(state.done):
            break
        state = step(state, np.asarray(policy.sample(np.asarray(state.obs), random), np.float32))
        cost, taken = cost or bool(state.cost > 0), taken + 1
    return Poses(
        frames=np.array(frames),
        radii=model.geom_size[geoms, 0],
        costs=np.array(costs),
        num_steps=taken,
        seconds_per_frame=_STEPS_PER_FRAME * env.dt,
        above=above,
    )


def play(loaded: Loaded, index: int, name: str, caption: str) -> str:
    """The HTML of an episode of a policy: an animation, or of a task with an arena one picture from above.

    Args:
        loaded: policies of a task that can be drawn.
        index: of the one that acts.
        name: of the element; no other on the page has it.
        caption: says whose episode it is.
    """
    policy = policies(loaded.config, loaded.actor, loaded.env)[index]
    if loaded.task.view != "arena":
        return to_html(record_poses(loaded.env, policy, above=loaded.task.view == "above"), name, caption)
    image = figures.png(top_down.draw(loaded.env, top_down.record(loaded.env, policy)))
    caption = f"{html.escape(caption)} From dark to light as time goes by; red: a cost is paid."
    return f"<figure>{figures.html_image(image, 'an episode from above')}<figcaption>{caption}</figcaption></figure>"


def _segments(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray) -> np.ndarray:
    """Both ends of every geom, [G, 2, 3]: those of a capsule's axis; of a sphere both are its centre."""
    capsule = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_CAPSULE
    half = np.where(capsule, model.geom_size[geoms, 1], 0.0)[:, None] * data.geom_xmat[geoms].reshape(-1, 3, 3)[:, :, 2]
    centre = data.geom_xpos[geoms]
    return np.stack([centre - half, centre + half], axis=1)


def to_html(poses: Poses, name: str, caption: str) -> str:
    """The HTML of a figure that plays the poses in a loop, in red where a cost is paid.

    `name` is that of the element; no other on the page has it.
    """
    heights = poses.frames[:, :, [1, 3]]
    extent = np.ptp(heights, axis=(1, 2)).max() if poses.above else heights.max()
    span = float(np.clip(1.5 * extent, 1.6, 8.0))  # metres from bottom to top of the canvas
    content = {
        "id": name,
        "frames": np.round(poses.frames, 3).tolist(),
        "radii": np.round(poses.radii, 3).tolist(),
        "costs": poses.costs.astype(int).tolist(),
        "milliseconds": round(1000 * poses.seconds_per_frame),
        "span": span,
        "above": poses.above,
    }
    script = _SCRIPT.replace("DATA", json.dumps(content, separators=(",", ":")))
    return (
        f"<figure><canvas id='{html.escape(name)}' width=900 height=240></canvas>"
        f"<figcaption>{html.escape(caption)} Its first {poses.num_steps} steps are "
        "played; lines are one metre apart; red: a cost is paid.</figcaption></figure>"
        f"<script>{script}</script>"
    )
