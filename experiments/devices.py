"""Spreads seeds over the cores of a CPU, before JAX starts."""

import contextlib
import os


def num_cpu_devices(num_seeds: int, num_cores: int, *, several: bool = False) -> int:
    """How many virtual devices share `num_seeds` evenly: about one per core, at most two; `several`: no single one.

    XLA runs the small matrix products of one device's program on one core, so one device would leave the others idle.
    """
    divisors = [n for n in range(1, num_seeds + 1) if num_seeds % n == 0]
    if several and num_seeds > 1:
        divisors.remove(1)
    enough = [n for n in divisors if num_cores <= n <= 2 * num_cores]
    return enough[0] if enough else max((n for n in divisors if n <= num_cores), default=divisors[0])


def spread_seeds(num_seeds: int, *, several: bool = False) -> None:
    """Asks JAX for that many CPU devices; no effect on accelerators. Call it before JAX is used."""
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    num_devices = num_cpu_devices(num_seeds, num_cores, several=several)
    # Enough threads that each device's program can wait for a LAPACK kernel (see `program.run_mesh`); XLA reads the
    # size of its pool from this variable.
    os.environ.setdefault("PJRT_NPROC", str(num_cores + num_devices))
    import jax

    with contextlib.suppress(RuntimeError):  # JAX has started already (a notebook, a test): it keeps its devices
        jax.config.update("jax_num_cpu_devices", num_devices)
