"""CPUs and GPUs of this machine, and how workers share them."""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

GPU_MEMORY = ("XLA_PYTHON_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_PYTHON_CLIENT_ALLOCATOR")
SHARED_GPU_MEMORY = 0.8  # share of a GPU's memory that its workers divide; the rest is for their CUDA contexts


def usable_cpus() -> list[int]:
    """The CPUs that this process may run on."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def visible_gpus(environment: Mapping[str, str], driver: Path = Path("/proc/driver/nvidia/gpus")) -> list[str]:
    """The NVIDIA GPUs that a process may use, as CUDA_VISIBLE_DEVICES names them; none without their driver."""
    if (chosen := environment.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in chosen.split(",") if name]
    return [str(i) for i in range(len(list(driver.iterdir())))] if driver.is_dir() else []


def gpu_share(worker: int, num_workers: int, gpus: Sequence[str], environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables of one of several workers on this machine: its GPU, and its part of that GPU's memory.

    JAX takes three quarters of a GPU's memory when it starts, so a second worker on the same GPU would find too little.
    Where `environment` says anything about GPU memory, that holds instead.
    """
    if not gpus or num_workers == 1:
        return {}
    variables = {"CUDA_VISIBLE_DEVICES": gpus[worker % len(gpus)]}
    sharing = math.ceil(num_workers / len(gpus))
    if sharing > 1 and not any(name in environment for name in GPU_MEMORY):
        variables[GPU_MEMORY[0]] = f"{SHARED_GPU_MEMORY / sharing:.3f}"
    return variables
