"""Where the jobs of a sweep are carried out: in processes on this machine, on a Ray cluster, or by SLURM.

Each of these runs `experiments.sweeps.worker` on the folder of a job. All machines must see that folder under the same
path. A job whose worker dies is started once more and goes on from its last checkpoint.
"""

import concurrent.futures
import dataclasses
import importlib.util
import math
import os
import queue
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from experiments.cli.command_line import UsageError
from experiments.cli.subprocesses import python_path
from experiments.sweeps import machine

_WRONG_INPUT = 2  # exit status of a worker; a second try would end in the same way
_TRIES = 2  # of each job
_POLL_SECONDS = 2.0  # between two looks at the state of SLURM's jobs; submitit asks SLURM itself less often
_LONGEST_JOB_MINUTES = 24 * 60  # time limit of a SLURM job, unless the user sets it; submitit's default is 5 minutes

_STOPPED = "stopped before it began"

Outcomes = Iterator[tuple[Path, str | None]]  # folder of a job that ended; if it failed, the last line of its output


def run_worker(
    folder: Path,
    cpus: Sequence[int] = (),
    stopping: threading.Event | None = None,
    variables: Mapping[str, str] = MappingProxyType({}),
) -> str | None:
    """Carries out the job in `folder` in a process of its own, and starts another one if that process dies.

    Args:
        folder: of the job.
        cpus: that the process may use; none stands for all.
        stopping: once it is set, the process is ended and no other is started.
        variables: of the environment, besides those of this process.

    Returns:
        None if the job is done; otherwise the exit status and the last line of the worker's output.
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
                stdin=subprocess.PIPE,  # closes when this process ends, which ends the worker
                start_new_session=True,  # so that Ctrl-C reaches this process only, which then ends the worker
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
    """Carries out jobs in processes on this machine; each process gets its share of the CPUs and GPUs."""
    cpus, gpus = machine.usable_cpus(), machine.visible_gpus(os.environ)
    num_workers = max(1, min(num_workers, len(folders), len(cpus)))
    shares: queue.SimpleQueue[tuple[list[int], dict[str, str]]] = queue.SimpleQueue()
    for i in range(num_workers):
        shares.put((cpus[i::num_workers], machine.gpu_share(i, num_workers, gpus, os.environ)))
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
            for future in futures:  # at first those that have not begun, so that no free thread begins one of them
                future.cancel()
            stopping.set()


def on_ray(folders: Sequence[Path], num_workers: int) -> Outcomes:
    """Carries out jobs as tasks of the Ray cluster that RAY_ADDRESS names, or else of one on this machine."""
    import ray

    ray.init(runtime_env={"env_vars": {"PYTHONPATH": python_path()}}, log_to_driver=False)
    try:
        cpus = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
        # No task may ask for more CPUs than a single machine has: Ray would wait for such a machine for ever.
        share = max(1, min(max(cpus), sum(cpus) // num_workers))
        gpus = sum(node["Resources"].get("GPU", 0) for node in ray.nodes() if node["Alive"])
        # Ray hides the GPUs from a task that asks for none. Tasks that ask for less than one GPU share its memory.
        gpu = min(1.0, math.floor(1000 * gpus / num_workers) / 1000)
        shared = 0 < gpu < 1 and not any(name in os.environ for name in machine.GPU_MEMORY)
        variables = {machine.GPU_MEMORY[0]: f"{machine.SHARED_GPU_MEMORY * gpu:.3f}"} if shared else {}
        # If the machine of a task is lost, Ray starts the task once more on another one.
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
    """Carries out jobs as an array of SLURM jobs, by submitit, which runs them on this machine where there is no SLURM.

    SLURM's accounting (`sacct`) tells that a job was lost; it is then submitted once more. If this process stops
    waiting, the jobs that have not ended are cancelled.

    Args:
        folders: of the jobs.
        num_workers: so many SLURM jobs run at a time.
        log_folder: for the output of the SLURM jobs.
        settings: parameters of `submitit.AutoExecutor`, such as timeout_min or slurm_partition.
    """
    import submitit

    executor = submitit.AutoExecutor(folder=log_folder)
    # With PYTHONSAFEPATH a job's Python does not look for our packages in the folder that it was submitted from.
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
        for job in submitit.helpers.as_completed(jobs, poll_frequency=_POLL_SECONDS):  # which sees replacements too
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


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Backend:
    """One row of the table: a place where jobs are carried out."""

    # Carries out the jobs in `folders`, `num_workers` at a time, and yields them as they end. Logs of its own go into
    # the folder `logs`; `settings` are those of the option that is described below.
    launch: Callable[[Sequence[Path], int, Path, Mapping[str, Any]], Outcomes]
    package: str | None = None  # that has to be installed
    install: str = ""  # what pip has to install for it
    settings: str | None = None  # help of an option with the row's name that takes settings; None: there are none


# By the name that --launcher takes. Another row here makes another launcher.
BACKENDS: Mapping[str, Backend] = {
    "processes": Backend(launch=lambda folders, num_workers, logs, settings: in_processes(folders, num_workers)),
    "ray": Backend(
        launch=lambda folders, num_workers, logs, settings: on_ray(folders, num_workers),
        package="ray",
        install="ccil_jax[ray]",
    ),
    "slurm": Backend(
        launch=lambda folders, num_workers, logs, settings: on_slurm(folders, num_workers, logs, settings),
        package="submitit",
        install="ccil_jax[slurm]",
        settings="parameters of submitit's executor, such as cpus_per_task=8 timeout_min=600 slurm_partition=cpu",
    ),
}


def check_launcher(name: str) -> None:
    """Raises `UsageError` where the package that a launcher needs is not installed."""
    backend = BACKENDS[name]
    if backend.package and importlib.util.find_spec(backend.package) is None:
        raise UsageError(f"--launcher {name}: {backend.package} is not installed; pip install '{backend.install}'")


def check_settings(launcher: str, given: Mapping[str, Any]) -> None:
    """Raises `UsageError` where settings were `given`, by the launcher that they are of, but another is used."""
    for name, settings in given.items():
        if settings and name != launcher:
            raise UsageError(f"--{name}: --launcher {launcher} does not use it; leave it out, or add --launcher {name}")
