"""Which local devices share the runs of a program."""

import os
from collections.abc import Sequence

import jax
from jax.sharding import AxisType


def run_mesh(num_runs: int) -> jax.sharding.Mesh:
    """The local devices that share the runs evenly: as many as divide their number."""
    devices = usable_devices()
    size = max(n for n in range(1, len(devices) + 1) if num_runs % n == 0)
    return mesh_of(devices[:size])


def usable_devices() -> list[jax.Device]:
    """The local devices, but no more CPU devices than can wait for one another."""
    devices = jax.local_devices()
    if devices[0].platform == "cpu":
        # A LAPACK kernel (MJX factorises with them) waits, in a thread of XLA's pool, for helpers from that pool: one
        # thread must stay free, or all wait for ever. XLA reads the pool's size from this variable too.
        num_threads = int(os.environ.get("PJRT_NPROC") or os.cpu_count() or 1)
        devices = devices[: max(1, num_threads - 1)]
    return devices


def mesh_of(devices: Sequence[jax.Device]) -> jax.sharding.Mesh:
    """The devices as a mesh of one axis, `runs`."""
    return jax.make_mesh((len(devices),), ("runs",), axis_types=(AxisType.Auto,), devices=devices)
