"""Which local devices share the runs of a program."""

import os
from collections.abc import Sequence

import jax
from jax.sharding import AxisType


def run_mesh(num_runs: int) -> jax.sharding.Mesh:
    """A mesh of the most local devices that can share the runs evenly: their number divides that of the runs."""
    devices = usable_devices()
    size = max(n for n in range(1, len(devices) + 1) if num_runs % n == 0)
    return mesh_of(devices[:size])


def usable_devices() -> list[jax.Device]:
    """The local devices; of CPU devices at most one fewer than the threads that they share."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        # Every CPU device runs its program in a thread of a pool that they share. A LAPACK kernel in it (MJX factorises
        # matrices with these) waits for helper threads from the same pool. So one thread must stay free, else all wait
        # for ever. XLA reads the size of the pool from this variable, as is done here.
        num_threads = int(os.environ.get("PJRT_NPROC") or os.cpu_count() or 1)
        devices = devices[: max(1, num_threads - 1)]
    return devices


def mesh_of(devices: Sequence[jax.Device]) -> jax.sharding.Mesh:
    """The devices as a mesh of one axis, `runs`."""
    return jax.make_mesh((len(devices),), ("runs",), axis_types=(AxisType.Auto,), devices=devices)
