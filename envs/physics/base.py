"""The physics interface: what an environment may know of an engine."""

from typing import Any, Protocol

import jax
from flax import struct
from jax.typing import ArrayLike

PyTree = Any


@struct.dataclass(kw_only=True)
class Data:
    """One simulation between two control steps.

    Derived `fields` are what the engine leaves after a step, as in MuJoCo itself: one substep behind `qpos` and
    `qvel` (with RK4, of its last stage), unless the backend was made with `refresh`. `change` has the tracked
    quantities after the control step minus before, taken at the engine's precision: at x = 100 m a float32 difference
    of positions would keep no more than 1e-5 m.
    """

    qpos: jax.Array  # [nq]
    qvel: jax.Array  # [nv]
    fields: dict[str, jax.Array]  # the derived arrays asked for, shaped as in `MjData`
    change: dict[str, jax.Array]  # tracked quantities, shaped as in `MjData`; zero after `init`
    backend: PyTree  # all the engine needs to continue; opaque


@struct.dataclass(kw_only=True)
class Mocap:
    """Where the model's mocap bodies are; the caller leads them."""

    pos: jax.Array  # [num_mocap, 3] throughout a control step, or [num_substeps, num_mocap, 3]
    quat: jax.Array  # [num_mocap, 4]


class Physics(Protocol):
    """Pure functions of one simulation; callers vmap them. Same values in, same values out.

    `mocap` is needed where the model has mocap bodies.
    """

    @property
    def name(self) -> str:
        """The backend's name, as in `make_physics`."""

    def init(self, qpos: ArrayLike, qvel: ArrayLike, mocap: Mocap | None = None) -> Data:
        """A simulation at rest in time at `qpos` `[nq]`, `qvel` `[nv]`, without a warm start."""

    def step(self, data: Data, ctrl: ArrayLike, mocap: Mocap | None = None) -> Data:
        """Advances one control step (all its substeps) under constant `ctrl` `[nu]`."""
