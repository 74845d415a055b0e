"""Interchangeable physics: one pure `step`, several engines. `make_physics` builds one by its name."""

from collections.abc import Sequence
from typing import Any

import mujoco

from envs.engines import find_engine
from envs.lookup import own_object
from envs.physics.base import Data, Mocap, Physics

__all__ = ["Data", "Mocap", "Physics", "make_physics", "resolve"]


def resolve(name: str) -> str:
    """The name of the engine that "auto" stands for on this machine (see `find_engine`); other names pass."""
    return find_engine(name).name


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
    """Builds an engine for a model.

    Args:
        name: "auto" or a row of `envs.engines.ENGINES`.
        model: the compiled model; the engine does not modify it.
        num_substeps: engine steps per control step.
        fields: derived `MjData` arrays that `Data.fields` shall hold, for example "cfrc_ext".
        track: `MjData` arrays whose change over the control step `Data.change` shall hold, for example "qpos".
        refresh: whether a control step ends with a forward pass, so that `Data.fields` belong to the new state.
        num_threads: threads of an engine that has some ("native"); None shares the usable CPUs among JAX's local
            devices.

    Raises:
        ValueError: there is no such engine, or `num_threads` is given for one without threads.
        ImportError: "warp" without the extra `mujoco-mjx[warp]`.
    """
    engine = find_engine(name)
    arguments: dict[str, Any] = {"fields": fields, "track": track, "refresh": refresh, **engine.arguments}
    if engine.has_threads:
        arguments["num_threads"] = num_threads
    elif num_threads is not None:
        raise ValueError(f"num_threads {num_threads} has no effect with physics {engine.name!r}; leave it out")
    physics: Physics = own_object(engine.build)(model, num_substeps, **arguments)
    return physics
