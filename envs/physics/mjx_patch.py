"""Two changes to MJX 3.17: the friction frame of plane-capsule contacts, and line searches that end.

C MuJoCo aligns a contact's first tangent with the capsule's axis. MJX does so only where the axis's component in the
plane exceeds 0.5 and takes the world's y axis elsewhere. The pyramidal friction cone is not isotropic, so steep legs
slide differently: Ant's velocity error against C over one step has a 90 % quantile of 5e-2, and 1e-14 once corrected.

The solver's line search is a scan over all the turns that the model allows (50), so that reverse-mode derivatives pass
through it; those after its end change nothing. Around it, in the models here, is a while loop that lets none pass. So
here it is a while loop too, of the few turns that some simulation needs: the same bits.
"""

import contextlib
import contextvars
import functools
import importlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

_MIN_NORM = 1e-9  # of the axis's part in the plane: below it there is no direction to align with
_TURNS = 4  # of a line search between two looks at whether it goes on

_searches_end = contextvars.ContextVar("_searches_end", default=False)  # in what is being traced


def align_plane_capsule_frames() -> None:
    """Replaces the plane-capsule routine in MJX's (private) table of collision functions. Idempotent.

    Raises:
        RuntimeError: the table is not the one that this correction was written for.
    """
    driver = importlib.import_module("mujoco.mjx._src.collision_driver")
    primitive = importlib.import_module("mujoco.mjx._src.collision_primitive")
    types = importlib.import_module("mujoco.mjx._src.types")
    pair = (types.GeomType.PLANE, types.GeomType.CAPSULE)
    current = driver._COLLISION_FUNC.get(pair)
    if getattr(current, "aligned", False):
        return
    if current is not primitive.plane_capsule:
        raise RuntimeError(
            "mujoco-mjx has another plane-capsule routine than version 3.17: review envs/physics/mjx_patch"
        )
    plane_capsule = primitive.collider(ncon=2)(_plane_capsule)
    plane_capsule.aligned = True
    driver._COLLISION_FUNC[pair] = plane_capsule


@contextlib.contextmanager
def searches_that_end() -> Iterator[None]:
    """While this is entered, what is traced of MJX has line searches that stop once all simulations' have ended.

    Elsewhere MJX is as it was, also for other code of this process.

    Raises:
        RuntimeError: MJX's line search is not the one that this was written for.
    """
    _let_searches_end()
    token = _searches_end.set(True)
    try:
        yield
    finally:
        _searches_end.reset(token)


@functools.cache  # once in a process
def _let_searches_end() -> None:
    solver: Any = importlib.import_module("mujoco.mjx._src.solver")
    original = getattr(solver, "_while_loop_scan", None)
    if original is None:
        raise RuntimeError("mujoco-mjx has another line search than version 3.17: review envs/physics/mjx_patch")

    def loop(condition: Callable[[Any], jax.Array], body: Callable[[Any], Any], start: Any, length: int) -> Any:
        return (_loop if _searches_end.get() else original)(condition, body, start, length)

    solver._while_loop_scan = loop


def _loop(condition: Callable[[Any], jax.Array], body: Callable[[Any], Any], start: Any, length: int) -> Any:
    """The last value of a search of at most `length` turns, which its condition counts as well.

    On a GPU it is launches that take time. Packed, what is carried is one array to select and copy, not ten; and only
    after some turns is it asked whether another is needed.
    """
    packed, unpack = ravel_pytree(start)

    def turn(packed: jax.Array) -> jax.Array:
        for _ in range(_TURNS):
            value = unpack(packed)
            packed = jnp.where(condition(value), ravel_pytree(body(value))[0], packed)
        return packed

    return unpack(jax.lax.while_loop(lambda packed: condition(unpack(packed)), turn, packed))


def _plane_capsule(plane: Any, capsule: Any) -> tuple[Any, Any, Any]:
    """The contacts at the capsule's two ends: distance `[2]`, position `[2, 3]`, frame `[2, 3, 3]`."""
    normal, axis = plane.mat[:, 2], capsule.mat[:, 2]
    tangent = axis - normal * jnp.dot(normal, axis)
    square = jnp.dot(tangent, tangent)
    aligned = square > _MIN_NORM**2
    # The inner `where` keeps the gradient of the square root finite at zero.
    tangent = tangent / jnp.sqrt(jnp.where(aligned, square, 1.0))
    fallback = jnp.where(jnp.abs(normal[1]) < 0.5, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    tangent = jnp.where(aligned, tangent, fallback)
    frame = jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
    ends = capsule.pos + jnp.outer(jnp.array([1.0, -1.0]), axis * capsule.size[1])
    radius = capsule.size[0]
    distance = (ends - plane.pos) @ normal - radius
    position = ends - jnp.outer(radius + 0.5 * distance, normal)
    return distance, position, jnp.stack([frame, frame])
