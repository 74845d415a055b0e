"""Settings of JAX that must be made before it starts: CPU devices, XLA's flags, and the cache of compiled programs."""

import contextlib
import hashlib
import os
import platform
from pathlib import Path

_CACHE_BYTES = 2 * 2**30  # size of the cache; the programs that were not used for the longest time are removed first


def num_cpu_devices(num_seeds: int, num_cores: int) -> int:
    """The number of virtual CPU devices that share `num_seeds` evenly: one to two per core, if a divisor allows it.

    XLA runs the small matrix products of a device's program on one core, so a single device would leave the other cores
    idle.
    """
    divisors = [n for n in range(1, num_seeds + 1) if num_seeds % n == 0]
    enough = [n for n in divisors if num_cores <= n <= 2 * num_cores]
    return enough[0] if enough else max((n for n in divisors if n <= num_cores), default=divisors[0])


def spread_seeds(num_seeds: int) -> None:
    """Asks JAX for `num_cpu_devices` devices, and Linux to schedule our threads as those of a batch job.

    It has no effect on accelerators. Call it before JAX is used.
    """
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    num_devices = num_cpu_devices(num_seeds, num_cores)
    # XLA reads the number of its threads from this variable. There must be enough that each device's program can wait
    # for a LAPACK kernel (see `ccil_jax.meshes`).
    os.environ.setdefault("PJRT_NPROC", str(num_cores + num_devices))
    if hasattr(os, "SCHED_BATCH"):
        # XLA wakes threads for small pieces of work. As batch threads they do not interrupt threads that compute.
        # Threads that are started later inherit this.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    import jax

    with contextlib.suppress(RuntimeError):  # JAX has already started (in a notebook or test) and keeps its devices
        jax.config.update("jax_num_cpu_devices", num_devices)


def widen_vectors() -> None:
    """Lets XLA use vectors of 512 bits instead of 256, on processors that keep their clock rate with them.

    These are the processors with `avx512_bf16` (AMD from Zen 4 on, Intel from Cooper Lake on). If XLA_FLAGS already
    has --xla_cpu_prefer_vector_width, that value stays. Call it before JAX is used.
    """
    if "avx512_bf16" in _processor_features().split():
        _ask_xla("xla_cpu_prefer_vector_width", "512")


def tune_gpus() -> None:
    """Lets XLA run loops as CUDA graphs, and stops it from trying several kernels for each product of matrices.

    Physics and learning are loops of many small kernels; to launch a kernel takes longer than to run it. A CUDA graph
    launches many at once. If XLA_FLAGS already has --xla_gpu_enable_command_buffer or --xla_gpu_enable_triton_gemm,
    that value stays. It has no effect on a CPU. Call it before JAX is used.
    """
    _ask_xla("xla_gpu_enable_command_buffer", "+WHILE")
    _ask_xla("xla_gpu_enable_triton_gemm", "false")


def _ask_xla(name: str, value: str) -> None:
    """Sets a flag of XLA, unless the user has set it."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    if not any(flag.startswith(f"--{name}") for flag in flags):
        os.environ["XLA_FLAGS"] = " ".join([*flags, f"--{name}={value}"])


def keep_programs() -> None:
    """Lets JAX keep compiled programs in the user's cache folder, so that the same program is not compiled again.

    JAX's own variables hold where the user has set them: JAX_COMPILATION_CACHE_DIR, JAX_ENABLE_COMPILATION_CACHE. If
    there is no home folder, or it cannot be written, there is no cache, and every start compiles.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(caches) / "ccil_jax" / "programs" / _processor()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # `Path.home` raises RuntimeError for a user whom the system does not know
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(_CACHE_BYTES))


def _processor() -> str:
    """A name for the machine code that runs here. Machines of different processors may share a home folder."""
    return f"{platform.machine()}-{hashlib.sha256(_processor_features().encode()).hexdigest()[:12]}"


def _processor_features() -> str:
    """The line of Linux about the processor, such as `flags : fpu sse2 avx2`; elsewhere the name of the processor."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else [platform.processor()]
    return next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
