"""Where programs are carried out: in processes on this machine, on a Ray cluster, or by SLURM.

Each place runs `experiments.sweeps.worker` on a program's folder, which all of them must see under the same path. A
program whose worker dies is carried on once, from its last checkpoint.
"""

import concurrent.futures
import importlib.util
import math
import os
import queue
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from experiments.cli.command_line import UsageError

LAUNCHERS = ("processes", "ray", "slurm")
_PACKAGES = {"ray": "ray", "slurm": "submitit"}  # of the launchers, which are also names of extras
_WRONG_INPUT = 2  # exit status; a second try would end in the same way
_TRIES = 2
_POLL_SECONDS = 2.0  # between two looks at SLURM jobs; submitit asks SLURM itself less often
_GPU_MEMORY = ("XLA_PYTHON_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_PREALLOCATE", "XLA_PYTHON_CLIENT_ALLOCATOR")
_SHARED_GPU_MEMORY = 0.8  # of a GPU that workers share; the rest is for their CUDA contexts
_LONGEST_JOB_MINUTES = 24 * 60  # submitit's own default is five

_STOPPED = "stopped before it began"

Outcomes = Iterator[tuple[Path, str | None]]  # a program's folder and, if it failed, the last words of its worker


def usable_cpus() -> list[int]:
    """The CPUs that this process may run on."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def visible_gpus(environment: Mapping[str, str], driver: Path = Path("/proc/driver/nvidia/gpus")) -> list[str]:
    """The NVIDIA GPUs that a process may use, as CUDA_VISIBLE_DEVICES names them; none without their driver."""
    if (chosen := environment.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in chosen.split(",") if name]
    return [str(i) for i in range(len(list(driver.iterdir())))] if driver.is_dir() else []


def gpu_share(worker: int, num_workers: int, gpus: Sequence[str], environment: Mapping[str, str]) -> dict[str, str]:
    """Variables that give one of several workers on this machine its GPU, and its part of that GPU's memory.

    JAX takes three quarters of a GPU's memory when it starts, so a second worker on the same GPU would find none. What
    the user says of memory has precedence.
    """
    if not gpus or num_workers == 1:
        return {}
    variables = {"CUDA_VISIBLE_DEVICES": gpus[worker % len(gpus)]}
    sharing = math.ceil(num_workers / len(gpus))
    if sharing > 1 and not any(name in environment for name in _GPU_MEMORY):
        variables[_GPU_MEMORY[0]] = f"{_SHARED_GPU_MEMORY / sharing:.3f}"
    return variables


def check_launcher(launcher: str) -> None:
    """Raises `UsageError` where the launcher's package is not installed."""
    package = _PACKAGES.get(launcher)
    if package and importlib.util.find_spec(package) is None:
        raise UsageError(f"--launcher {launcher}: {package} is not installed; pip install 'ccil_jax[{launcher}]'")


def launch(
    launcher: str, folders: Sequence[Path], num_workers: int, log_folder: Path, settings: Mapping[str, Any]
) -> Outcomes:
    """Carries out the programs in `folders`, `num_workers` at a time, and yields them as they end."""
    if launcher == "ray":
        return on_ray(folders, num_workers)
    if launcher == "slurm":
        return on_slurm(folders, num_workers, log_folder, settings)
    return in_processes(folders, num_workers)


def run_worker(
    folder: Path,
    cpus: Sequence[int] = (),
    stopping: threading.Event | None = None,
    variables: Mapping[str, str] = MappingProxyType({}),
) -> str | None:
    """Carries out the program in `folder` in a process of its own, and once more if that dies.

    Returns the last words of a worker that failed for good. `stopping` ends it, and starts none once it is set.
    `variables` are of its environment.
    """
    stopping = stopping or threading.Event()
    command = [sys.executable, "-P", "-m", "experiments.sweeps.worker", str(folder), "--until-eof"]
    command += ["--cpus", ",".join(map(str, cpus))] if cpus else []
    log, status = folder / "worker.log", 0
    for _ in range(_TRIES):
        if stopping.is_set():
            return _STOPPED
        with (
            log.open("ab") as output,
            subprocess.Popen(
                command,
                stdin=subprocess.PIPE,  # it ends with this process, whose end closes the pipe,
                start_new_session=True,  # and not by a Ctrl-C, after which it would be tried again
                stdout=output,
                stderr=output,
                env={**os.environ, **variables, "PYTHONPATH": python_path()},
            ) as process,
        ):
            while process.poll() is None:
                if stopping.wait(0.2):
                    process.terminate()
                    process.wait()
        status = process.returncode
        if status in (0, _WRONG_INPUT) or stopping.is_set():
            break
    return None if status == 0 else f"exit status {status}: {_last_line(log)} ({log})"


def in_processes(folders: Sequence[Path], num_workers: int) -> Outcomes:
    """Worker processes on this machine; each gets its share of the CPUs."""
    cpus, gpus = usable_cpus(), visible_gpus(os.environ)
    num_workers = max(1, min(num_workers, len(folders), len(cpus)))
    shares: queue.SimpleQueue[tuple[list[int], dict[str, str]]] = queue.SimpleQueue()
    for i in range(num_workers):
        shares.put((cpus[i::num_workers], gpu_share(i, num_workers, gpus, os.environ)))
    stopping = threading.Event()

    def carry_out(folder: Path) -> str | None:
        share = shares.get()
        try:
            return run_worker(folder, share[0], stopping, share[1])
        finally:
            shares.put(share)

    with concurrent.futures.ThreadPoolExecutor(num_workers) as pool:
        futures = {pool.submit(carry_out, folder): folder for folder in folders}
        try:
            for future in concurrent.futures.as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:  # those that have not begun, before the pool takes them for free hands
                future.cancel()
            stopping.set()


def on_ray(folders: Sequence[Path], num_workers: int) -> Outcomes:
    """Tasks of a Ray cluster: the one that RAY_ADDRESS names, else one on this machine."""
    import ray

    ray.init(runtime_env={"env_vars": {"PYTHONPATH": python_path()}}, log_to_driver=False)
    try:
        cpus = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
        share = max(1, min(max(cpus), sum(cpus) // num_workers))  # a task that no node can hold would wait for ever
        # Ray, too, starts a task once more whose process dies: the machine may be gone.
        gpus = sum(node["Resources"].get("GPU", 0) for node in ray.nodes() if node["Alive"])
        # Without a share of the GPUs Ray hides them from a task; parts of one are shared, and so is its memory.
        gpu = min(1.0, math.floor(1000 * gpus / num_workers) / 1000)
        shared = 0 < gpu < 1 and not any(name in os.environ for name in _GPU_MEMORY)
        variables = {_GPU_MEMORY[0]: f"{_SHARED_GPU_MEMORY * gpu:.3f}"} if shared else {}
        task = ray.remote(num_cpus=share, num_gpus=gpu, max_retries=_TRIES - 1)(run_worker)
        waiting = {task.remote(folder, variables=variables): folder for folder in folders}
        while waiting:
            done, _ = ray.wait(list(waiting), num_returns=1)
            try:
                failure = ray.get(done[0])
            except ray.exceptions.RayError as error:
                failure = f"lost by Ray: {str(error).splitlines()[0]}"
            yield waiting.pop(done[0]), failure
    finally:
        ray.shutdown()


def on_slurm(folders: Sequence[Path], num_workers: int, log_folder: Path, settings: Mapping[str, Any]) -> Outcomes:
    """An array of SLURM jobs through submitit, which runs them on this machine where there is no SLURM.

    That a job was lost is known from SLURM's accounting (`sacct`). When nobody waits for them any longer, jobs are
    cancelled.

    `settings` are parameters of `submitit.AutoExecutor`, such as timeout_min or slurm_partition.
    """
    import submitit

    executor = submitit.AutoExecutor(folder=log_folder)
    # A job's Python is not to look for our packages in the folder that it is submitted from.
    setup = [f"export PYTHONSAFEPATH=1 PYTHONPATH={shlex.quote(python_path())}"]
    defaults = {
        "slurm_setup": setup,
        "name": "ccil_jax",
        "timeout_min": _LONGEST_JOB_MINUTES,
        "slurm_array_parallelism": num_workers,
    }
    executor.update_parameters(**{**defaults, **settings})
    folder_of = dict(zip(executor.map_array(run_worker, folders), folders, strict=True))
    jobs, running, lost = list(folder_of), set(folder_of), set()
    try:
        for job in submitit.helpers.as_completed(jobs, poll_frequency=_POLL_SECONDS):  # of `jobs` as it grows
            running.remove(job)
            folder, failure = folder_of[job], None
            try:
                failure = job.result()
            except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedJobError):
                if folder not in lost:
                    lost.add(folder)
                    replacement = executor.submit(run_worker, folder)
                    folder_of[replacement] = folder
                    running.add(replacement)
                    jobs.append(replacement)
                    continue
                failure = f"lost by SLURM: job {job.job_id} is {job.state}; see {job.paths.stderr}"
            yield folder, failure
    finally:
        for job in running:
            job.cancel(check=False)


def python_path() -> str:
    """PYTHONPATH of a worker, which imports the packages that this process did."""
    return os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"
