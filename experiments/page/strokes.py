"""What is drawn of a task: thick lines in a plane. Each is a body seen from the side, or from above.

A page and a video draw the same lines. No renderer is involved, because on a machine without a display it is not
certain that MuJoCo finds EGL, OSMesa or GLFW.
"""

import dataclasses
from collections.abc import Container, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from envs.safety_gym.tasks import ObjectKind

_GEOM = mujoco.mjtGeom
_SPHERE, _CAPSULE, _CYLINDER = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_CAPSULE), int(_GEOM.mjGEOM_CYLINDER)
_BOX, _ELLIPSOID, _MESH = int(_GEOM.mjGEOM_BOX), int(_GEOM.mjGEOM_ELLIPSOID), int(_GEOM.mjGEOM_MESH)
_SIMPLE = (_SPHERE, _CAPSULE, _CYLINDER, _BOX, _ELLIPSOID)
PAID = "#d1495b"  # the learner's body while it pays a cost
COLORS = {  # by kind; the last two digits are the opacity
    "scenery": "#cfd2d6ff",
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


def drawn(model: mujoco.MjModel, shown: Container[int]) -> list[int]:
    """The geoms by which the bodies `shown` of a model are drawn: no planes, and a mesh only where there is no other.

    Many models have meshes to look at and simpler shapes for contacts; those look clearer as lines.
    """
    geoms = [i for i in range(model.ngeom) if model.geom_bodyid[i] in shown]
    simple = [i for i in geoms if model.geom_type[i] in _SIMPLE]
    covered = {model.geom_bodyid[i] for i in simple}
    return sorted(simple + [i for i in geoms if model.geom_type[i] == _MESH and model.geom_bodyid[i] not in covered])


def bodies(
    model: mujoco.MjModel, arrays: Mapping[str, np.ndarray], kind_of: Mapping[int, str], *, above: bool
) -> Strokes:
    """The bodies of a model, one line for each geom that is `drawn`.

    Args:
        model: whose bodies they are.
        arrays: arrays of `MjData` by name, such as `qpos`, [F]-leading.
        kind_of: the kind of each body that is drawn, by its number; those drawn last come last.
        above: whether they are seen from above; otherwise from the side, along the y axis.
    """
    order, plane = list(kind_of), [0, 1] if above else [0, 2]
    geoms = sorted(drawn(model, kind_of), key=lambda i: order.index(model.geom_bodyid[i]))
    data, places = mujoco.MjData(model), []
    lines: list[_Line] = []
    for i in range(len(arrays["qpos"])):
        for name, values in arrays.items():
            getattr(data, name)[:] = values[i]
        mujoco.mj_kinematics(model, data)
        rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
        lines = lines or [_line(model, geom, turned[plane]) for geom, turned in zip(geoms, rotations, strict=True)]
        own = np.array([line.ends for line in lines]).reshape(-1, 2, 3)
        ends = data.geom_xpos[geoms][:, None] + own @ rotations.swapaxes(1, 2)
        places.append(ends[:, :, plane].reshape(len(geoms), 4))
    shapes = (
        Shape(kind_of[model.geom_bodyid[geom]], line.width, line.is_round)
        for geom, line in zip(geoms, lines, strict=True)
    )
    return Strokes(tuple(shapes), np.array(places))


class _Line(NamedTuple):
    """The line by which a geom is drawn."""

    ends: np.ndarray  # [2, 3] m, in the geom's own frame
    width: float  # m
    is_round: bool


def _line(model: mujoco.MjModel, geom: int, seen: np.ndarray) -> _Line:
    """The line of a geom, whose axes are the columns of `seen` [2, 3] in the first picture.

    A capsule's or cylinder's line is its axis, unless a cylinder is seen from its end, as a disc. Of a box, and of the
    boxes around an ellipsoid or a mesh, it is the axis that is longest in the picture.
    """
    kind, size, middle = model.geom_type[geom], model.geom_size[geom], np.zeros(3)
    half, width, is_round = np.zeros(3), 2 * size[0], kind != _CYLINDER
    if kind in (_CAPSULE, _CYLINDER):
        half[2] = size[1]
        if kind == _CYLINDER and np.hypot(*seen[:, 2]) < np.sin(np.pi / 6):
            half, is_round = np.zeros(3), True
    elif kind != _SPHERE:
        if kind == _MESH:
            middle, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        axes = seen * size
        lengths = np.hypot(*axes)
        longest, is_round = int(np.argmax(lengths.round(6))), kind == _ELLIPSOID
        across = np.array([-axes[1, longest], axes[0, longest]]) / lengths[longest]
        width = 2 * np.abs(across @ np.delete(axes, longest, axis=1)).max()
        half[longest] = size[longest] * (max(0.0, 1 - width / 2 / lengths[longest]) if is_round else 1.0)
    return _Line(np.array([middle - half, middle + half]), float(width), bool(is_round))
