"""What JAX is told before it starts: CPU devices, the width of vectors, and where compiled programs are kept."""

import contextlib
import hashlib
import os
import platform
from pathlib import Path

_CACHE_BYTES = 2 * 2**30  # of compiled programs; those not used for longest go first


def num_cpu_devices(num_seeds: int, num_cores: int) -> int:
    """How many virtual devices share `num_seeds` evenly: about one per core, at most two.

    XLA runs the small matrix products of one device's program on one core, so one device would leave the others idle.
    """
    divisors = [n for n in range(1, num_seeds + 1) if num_seeds % n == 0]
    enough = [n for n in divisors if num_cores <= n <= 2 * num_cores]
    return enough[0] if enough else max((n for n in divisors if n <= num_cores), default=divisors[0])


def spread_seeds(num_seeds: int) -> None:
    """Asks JAX for that many CPU devices, and Linux to schedule their threads as those of a batch job.

    Accelerators take no notice. Call it before JAX is used.
    """
    num_cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    num_devices = num_cpu_devices(num_seeds, num_cores)
    # Enough threads that each device's program can wait for a LAPACK kernel (see `ccil_jax.meshes`); XLA reads the
    # size of its pool from this variable.
    os.environ.setdefault("PJRT_NPROC", str(num_cores + num_devices))
    if hasattr(os, "SCHED_BATCH"):
        # XLA wakes threads to help with small pieces of work: they must not push aside those that compute. Threads
        # that start from here on inherit it.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    import jax

    with contextlib.suppress(RuntimeError):  # JAX has started already (a notebook, a test): it keeps its devices
        jax.config.update("jax_num_cpu_devices", num_devices)


def widen_vectors() -> None:
    """Has XLA compile for vectors of 512 bits, not its 256, where the processor has them at full clock rate.

    Processors before those with `avx512_bf16` (AMD from Zen 4, Intel from Cooper Lake) slow down for them. The user's
    own --xla_cpu_prefer_vector_width in XLA_FLAGS has precedence. Call it before JAX is used.
    """
    if "avx512_bf16" in _processor_features().split():
        _ask_xla("xla_cpu_prefer_vector_width", "512")


def tune_gpus() -> None:
    """Has XLA capture loops in CUDA graphs, and not try out kernels for each product of matrices while it compiles.

    Physics and learning are loops of many small kernels, whose launches take longer than they do. The user's own
    --xla_gpu_enable_command_buffer and --xla_gpu_enable_triton_gemm in XLA_FLAGS have precedence. A CPU takes no
    notice. Call it before JAX is used.
    """
    _ask_xla("xla_gpu_enable_command_buffer", "+WHILE")
    _ask_xla("xla_gpu_enable_triton_gemm", "false")


def _ask_xla(name: str, value: str) -> None:
    """Sets a flag of XLA that the user has not set."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    if not any(flag.startswith(f"--{name}") for flag in flags):
        os.environ["XLA_FLAGS"] = " ".join([*flags, f"--{name}={value}"])


def keep_programs() -> None:
    """Has JAX keep compiled programs in the user's cache folder, so that the second start of one compiles nothing.

    JAX's own variables have precedence: JAX_COMPILATION_CACHE_DIR, JAX_ENABLE_COMPILATION_CACHE=false. Without a home
    folder, or where it cannot be written, there is no cache: every start compiles, which is slower and not wrong.
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
    """A name for what machine code runs here: home folders are shared between machines."""
    return f"{platform.machine()}-{hashlib.sha256(_processor_features().encode()).hexdigest()[:12]}"


def _processor_features() -> str:
    """Linux's line about them, such as `flags : fpu sse2 avx2`; elsewhere the processor's name."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else [platform.processor()]
    return next((line for line in lines if line.startswith(("flags", "Features"))), lines[0])
