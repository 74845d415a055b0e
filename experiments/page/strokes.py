"""What is drawn of a task: thick lines in a plane. Each is a body seen from the side, or from above.

A page and a video draw the same lines. No renderer is involved, because on a machine without a display it is not
certain that MuJoCo finds EGL, OSMesa or GLFW.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from envs.safety_gym.tasks import ObjectKind

_GEOM = mujoco.mjtGeom
_BOX, _CYLINDER, _CAPSULE = (int(kind) for kind in (_GEOM.mjGEOM_BOX, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_CAPSULE))
_DRAWN = (_BOX, _CYLINDER, _CAPSULE, int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_ELLIPSOID))
PAID = "#d1495b"  # the learner's body while it pays a cost
COLORS = {  # by kind; the last two digits are the opacity
    "body": "#0b6e99ff",
    "robot": "#22262bff",
    "hazards": "#3f6fb573",
    "goal": "#6a994e73",
    "vases": "#00a5a5b0",
    "buttons": "#e6c229b0",
    "gremlins": "#7b5ea7b0",
    "pillars": "#8a8f98c0",
    "push_box": "#a44a3fb0",
}


@dataclasses.dataclass(frozen=True)
class Shape:
    """How one line looks. A line of no length with round ends is a disc."""

    kind: str  # key of COLORS
    width: float  # m
    is_round: bool  # whether its ends are round; otherwise the line is a rectangle


@dataclasses.dataclass(frozen=True)
class Strokes:
    """G lines in F frames, in the order in which they are drawn; each is x1, y1, x2, y2 in metres."""

    shapes: tuple[Shape, ...]  # [G]
    places: np.ndarray  # [F, G, 4]

    def over(self, below: "Strokes") -> "Strokes":
        """Both together, `below` being drawn first. They have the same number of frames."""
        return Strokes(below.shapes + self.shapes, np.concatenate([below.places, self.places], axis=1))


def discs(kind: ObjectKind, centres: np.ndarray) -> Strokes:
    """The objects of a kind, at `centres` [F, count, 2], as discs of its size."""
    shapes = (Shape(kind.name, 2 * kind.size, True),) * centres.shape[1]
    return Strokes(shapes, np.concatenate([centres, centres], axis=-1))


def bodies(
    model: mujoco.MjModel, arrays: Mapping[str, np.ndarray], kind_of: Mapping[int, str], *, above: bool
) -> Strokes:
    """The bodies of a model, one line for each geom that is no plane and no mesh.

    Args:
        model: whose bodies they are.
        arrays: arrays of `MjData` by name, such as `qpos`, [F]-leading.
        kind_of: the kind of each body that is drawn, by its number; those drawn last come last.
        above: whether they are seen from above; otherwise from the side, along the y axis.
    """
    order = list(kind_of)
    drawn = [i for i in range(model.ngeom) if model.geom_type[i] in _DRAWN and model.geom_bodyid[i] in kind_of]
    geoms = sorted(drawn, key=lambda i: order.index(model.geom_bodyid[i]))
    axes, depth = ([0, 1], 1) if above else ([0, 2], 2)
    data, places = mujoco.MjData(model), []
    for i in range(len(arrays["qpos"])):
        for name, values in arrays.items():
            getattr(data, name)[:] = values[i]
        mujoco.mj_kinematics(model, data)
        places.append(_ends(model, data, geoms)[:, :, axes].reshape(len(geoms), 4))
    is_box = model.geom_type[geoms] == _BOX
    widths = 2 * np.where(is_box, model.geom_size[geoms, depth], model.geom_size[geoms, 0])
    flat = is_box | (model.geom_type[geoms] == _CYLINDER)
    shapes = (
        Shape(kind_of[model.geom_bodyid[geom]], float(width), not is_flat)
        for geom, width, is_flat in zip(geoms, widths, flat, strict=True)
    )
    return Strokes(tuple(shapes), np.array(places))


def _ends(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int]) -> np.ndarray:
    """Both ends of every geom, [G, 2, 3]: of a capsule's or cylinder's axis; of a box's x axis; else the centre."""
    kinds, sizes = model.geom_type[geoms], model.geom_size[geoms]
    rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
    along_x = kinds == _BOX
    has_axis = np.isin(kinds, (_CAPSULE, _CYLINDER))
    length = np.where(along_x, sizes[:, 0], np.where(has_axis, sizes[:, 1], 0.0))
    half = length[:, None] * np.where(along_x[:, None], rotations[:, :, 0], rotations[:, :, 2])
    centre: Any = data.geom_xpos[geoms]
    return np.stack([centre - half, centre + half], axis=1)
