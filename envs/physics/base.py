"""The physics interface: what an environment may know of an engine."""

from typing import Any, Protocol

import jax
from flax import struct
from jax.typing import ArrayLike

PyTree = Any


@struct.dataclass(kw_only=True)
class Data:
    """One simulation between two control steps.

    Derived arrays, in `fields`, are those that the engine leaves after a step, as in MuJoCo itself: they belong to the
    substep before `qpos` and `qvel` (with the integrator RK4, to its last stage), unless the engine was built with
    `refresh`. `change` is the value of a tracked quantity after the control step minus its value before, computed at
    the engine's precision. The reason: at x = 100 m, the difference of two float32 positions is exact to 1e-5 m only.
    """

    qpos: jax.Array  # [nq]
    qvel: jax.Array  # [nv]
    fields: dict[str, jax.Array]  # the derived arrays asked for, shaped as in `MjData`
    change: dict[str, jax.Array]  # of the tracked quantities, shaped as in `MjData`; zero after `init`
    backend: PyTree  # all that the engine needs to continue; only the engine knows its form


@struct.dataclass(kw_only=True)
class Mocap:
    """Where the model's mocap bodies are. The engine does not move them, the caller does."""

    pos: jax.Array  # m; [num_mocap, 3] for the whole control step, or [num_substeps, num_mocap, 3]
    quat: jax.Array  # [num_mocap, 4]


class Physics(Protocol):
    """Pure functions of one simulation; callers vmap them. The same arguments give the same values.

    `mocap` has to be given where the model has mocap bodies.
    """

    @property
    def name(self) -> str:
        """The engine's name, as in `envs.engines.ENGINES`."""

    def init(self, qpos: ArrayLike, qvel: ArrayLike, mocap: Mocap | None = None) -> Data:
        """A simulation at time 0 with positions `qpos` `[nq]` and velocities `qvel` `[nv]`, without a warm start."""

    def step(self, data: Data, ctrl: ArrayLike, mocap: Mocap | None = None) -> Data:
        """Advances one control step, that is all its substeps, while `ctrl` `[nu]` stays the same."""
