"""Interchangeable physics: one pure `step`, several engines. `make_physics` chooses."""

import importlib.util
from collections.abc import Sequence

import jax
import mujoco

from envs.physics.base import Data, Mocap, Physics

__all__ = ["Data", "Mocap", "Physics", "make_physics", "resolve"]


def resolve(name: str) -> str:
    """What "auto" stands for; other names pass.

    "native" where JAX's default device is a CPU, "warp" where it is NVIDIA's and `mujoco-mjx[warp]` is installed, "mjx"
    elsewhere.
    """
    if name != "auto":
        return name
    if jax.default_backend() == "cpu":
        return "native"
    nvidia = jax.devices()[0].device_kind.startswith("NVIDIA")
    return "warp" if nvidia and importlib.util.find_spec("warp") else "mjx"


def make_physics(
    name: str,
    model: mujoco.MjModel,
    *,
    num_substeps: int,
    fields: Sequence[str] = (),
    track: Sequence[str] = (),
    refresh: bool = False,
    num_threads: int | None = None,
) -> Physics:
    """Builds a backend.

    Args:
        name: "auto", "native", "mjx" or "warp".
        model: the compiled model; the backend does not modify it.
        num_substeps: engine steps per control step.
        fields: derived `MjData` arrays that `Data.fields` shall hold, e.g. "cfrc_ext".
        track: `MjData` arrays whose change over the control step `Data.change` shall hold, e.g. "qpos".
        refresh: whether a control step ends with a forward pass, so that `Data.fields` belong to the new state.
        num_threads: of `native`; None shares the usable CPUs among the local devices. The other backends ignore it.

    Raises:
        ValueError: unknown name.
        ImportError: "warp" without the extra `mujoco-mjx[warp]`.
    """
    name = resolve(name)
    if name == "native":
        from envs.physics.native import NativePhysics

        return NativePhysics(model, num_substeps, fields=fields, track=track, refresh=refresh, num_threads=num_threads)
    if name in ("mjx", "warp"):
        from envs.physics.mjx import MjxPhysics

        impl = "jax" if name == "mjx" else "warp"
        return MjxPhysics(model, num_substeps, fields=fields, track=track, refresh=refresh, impl=impl)
    raise ValueError(f"unknown physics {name!r}: choose one of auto, native, mjx, warp")
