"""The table of physics engines. Everything that is particular to one of them is a field of its row.

Importing this file imports neither JAX nor an engine, so that command lines can name the engines at once.
"""

import dataclasses
import importlib.util
from collections.abc import Callable, Mapping
from typing import Any

from envs.lookup import hint


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineInfo:
    """One row of the table."""

    name: str
    build: str  # "module:attribute": a class that keeps the contract of `envs.physics.Physics`
    arguments: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of `build`, the same for every model
    is_fastest: Callable[[], bool]  # whether "auto" stands for it on this machine; true of exactly one row
    has_threads: bool  # whether the option `num_threads` has an effect
    needs_prisms: bool  # whether cylinders need the help of prisms, see `envs.safety_gym.scene.build`


def _on_cpu() -> bool:
    import jax

    return jax.default_backend() == "cpu"


def _warp_can_run() -> bool:
    import jax

    nvidia = jax.devices()[0].device_kind.startswith("NVIDIA")
    return nvidia and importlib.util.find_spec("warp") is not None


ENGINES = (
    EngineInfo(
        name="native",
        build="envs.physics.native:NativePhysics",
        is_fastest=_on_cpu,
        has_threads=True,
        needs_prisms=False,
    ),
    EngineInfo(
        name="mjx",
        build="envs.physics.mjx:MjxPhysics",
        arguments={"impl": "jax"},
        is_fastest=lambda: not _on_cpu() and not _warp_can_run(),
        has_threads=False,
        needs_prisms=True,
    ),
    EngineInfo(
        name="warp",
        build="envs.physics.mjx:MjxPhysics",
        arguments={"impl": "warp"},
        is_fastest=lambda: not _on_cpu() and _warp_can_run(),
        has_threads=False,
        needs_prisms=True,
    ),
)
AUTO = "auto"  # stands for the row that is the fastest on this machine
PHYSICS = (AUTO, *(engine.name for engine in ENGINES))  # what the option `physics` may be


def check_physics(name: Any) -> None:
    """Refuses with a `ValueError` what is no value of the option `physics`."""
    if name not in PHYSICS:
        raise ValueError(f"{name}: unknown physics; {hint(str(name), PHYSICS)}choose one of {', '.join(PHYSICS)}")


def find_engine(name: str) -> EngineInfo:
    """The row of an engine.

    Args:
        name: one of `PHYSICS`. "auto" stands for "native" where JAX's default device is a CPU, for "warp" where it is
            an NVIDIA GPU and `mujoco-mjx[warp]` is installed, and for "mjx" elsewhere; to find that out, JAX is
            imported.

    Raises:
        ValueError: there is no such engine.
    """
    check_physics(name)
    return next(engine for engine in ENGINES if (engine.is_fastest() if name == AUTO else engine.name == name))
