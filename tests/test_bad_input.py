"""Wrong input ends before JAX is imported, with exit status 2 and one line that names the file or option."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccil_jax.config import Config
from ccil_jax.demonstrations.trajectories import Demonstrations, save_demonstrations

PROBE = """
import sys
from importlib import import_module
try:
    status = import_module("experiments." + sys.argv[1]).main(sys.argv[2:])
except SystemExit as end:
    status = end.code
print("JAX" if "jax" in sys.modules else "no JAX")
sys.exit(status)
"""


def launch(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Runs a launcher in a process of its own; the last line of its output says whether JAX was imported."""
    root = str(Path(__file__).parent.parent)
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {root!r})\n{PROBE}", *map(str, arguments)]
    return subprocess.run(command, check=False, cwd=cwd, capture_output=True, text=True, timeout=120)


def demonstrations(obs_dim: int = 8, action_dim: int = 2, **metadata: Any) -> Demonstrations:
    """Two episodes of five steps on Swimmer, unless said otherwise."""
    flags = np.arange(10) % 5 == 4
    return Demonstrations(
        obs=np.zeros((10, obs_dim), np.float32),
        actions=np.zeros((10, action_dim), np.float32),
        rewards=np.ones(10, np.float32),
        costs=np.ones(10, np.float32),
        terminated=np.zeros(10, bool),
        truncated=flags,
        episode_ends=np.array([5, 10]),
        metadata={"task": "Swimmer", **metadata},
    )


def raw(path: Path, **changes: Any) -> None:
    """A demonstrations file with some keys replaced, written past our own checks."""
    good = demonstrations()
    arrays = {f.name: value for f in dataclasses.fields(good) if (value := getattr(good, f.name)) is not None}
    arrays["metadata"] = np.array(json.dumps(good.metadata))
    np.savez(path, allow_pickle=True, **{**arrays, **changes})


def truncated(path: Path) -> None:
    raw(path)
    path.write_bytes(path.read_bytes()[:-400])


FILES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (lambda path: None, "no such file"),
    "truncated": (truncated, "truncated or damaged"),
    "wrong task": (lambda path: save_demonstrations(path, demonstrations(task="Ant")), "--env Ant"),
    "wrong observations": (lambda path: save_demonstrations(path, demonstrations(obs_dim=17)), "'obs' has 17 columns"),
    "wrong actions": (lambda path: save_demonstrations(path, demonstrations(action_dim=6)), "'actions' has 6 columns"),
    "NaN": (lambda path: raw(path, obs=np.full((10, 8), np.nan)), "'obs' holds NaN"),
    "empty": (lambda path: path.write_bytes(b""), "empty"),
    "zero episodes": (lambda path: raw(path, episode_ends=np.zeros(0, int)), "zero episodes"),
    "pickled": (lambda path: raw(path, obs=np.full((10, 8), None)), "could execute code"),
    "other cost": (lambda path: save_demonstrations(path, demonstrations(cost_threshold=0.5)), "--cost-threshold 0.5"),
    "other horizon": (
        lambda path: save_demonstrations(path, demonstrations(max_episode_steps=5)),
        "--max-episode-steps 5",
    ),
    "directory": (lambda path: path.mkdir(), "not a file"),
}

TRAIN = ("train", "--method", "malm", "--env", "Swimmer", "--demos", "good.npz", "--out", "run")
EXPERT = ("expert", "--env", "Swimmer", "--out", "expert.npz", "--run-dir", "run")
RECORD = ("evaluate", "done", "--record", "new.npz")
OPTIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "no method": (("train", "--env", "Swimmer"), "--method: required"),
    "no task": (("train", "--method", "malm"), "--env: required"),
    "unknown task": ((*TRAIN, "--env", "Swimer"), "--env Swimer: unknown task; did you mean Swimmer?"),
    "unknown method": (
        (*TRAIN, "--method", "mallm"),
        "--method 'mallm': unknown; did you mean malm? choose one of malm",
    ),
    "unknown physics": ((*TRAIN, "--physics", "bullet"), "--physics: invalid choice: 'bullet'"),
    "unknown preset": ((*TRAIN, "--preset", "big"), "--preset: invalid choice: 'big'"),
    "misspelt option": ((*TRAIN, "--max_kll", "0.1"), "--max-kll: unknown; did you mean --max-kl?"),
    "stray word": ((*TRAIN, "Swimmer"), "Swimmer: unknown; see --help"),
    "not a number": ((*TRAIN, "--gamma", "high"), "--gamma: invalid float value: 'high'"),
    "not an integer": ((*TRAIN, "--num_envs", "1.5"), "--num-envs: invalid integer value: '1.5'"),
    "a pattern for a folder": (
        ("train", "--method", "bc", "--env", "Swimmer", "--out", "lr[0.1]"),
        "--out lr[0.1]: checkpoints cannot be kept below a folder with [ in its name",
    ),
    "a report over something else": (("theorem1", "--out", "good.npz"), "--out good.npz: exists; choose another name"),
    "a benchmark over something else": (("benchmark", "--out", "good.npz"), "--out good.npz: exists; choose another"),
    "a figure in the place of a folder": (("theorem1", "--out", "full", "--overwrite"), "--out full: is a folder"),
    "a task without contacts": ((*TRAIN, "--contact-cost", "false"), "--contact-cost: Swimmer has no such option"),
    "not a boolean": ((*TRAIN, "--contact-cost", "maybe"), "--contact-cost: 'maybe': give true or false"),
    "not sizes": ((*TRAIN, "--hidden-sizes", "a,b"), "--hidden-sizes: 'a,b': give sizes such as 100,100"),
    "not a limit": ((*TRAIN, "--cost-limit", "low"), "--cost-limit: 'low': give a number or none"),
    "NaN option": ((*TRAIN, "--max-kl", "nan"), "--max-kl nan"),
    "no value": ((*TRAIN, "--seed"), "--seed: expected one argument"),
    "negative seed": ((*TRAIN, "--seed=-1"), "--seed: -1: must be at least 0"),
    "no seeds": ((*TRAIN, "--num-seeds", "0"), "--num-seeds: 0: must be at least 1"),
    "batch not divisible": (
        (*TRAIN, "--batch-size", "2000", "--num-envs", "17"),
        "--batch-size 2000 is not divisible by --num-envs 17; use --batch-size 1989",
    ),
    "minibatch too large": (
        (*TRAIN, "--discriminator-minibatch-size", "8000"),
        "--discriminator-minibatch-size 8000 exceeds the batch; use --discriminator-minibatch-size 4000",
    ),
    "nothing held out": ((*TRAIN, "--held-out-fraction", "0"), "--held-out-fraction 0.0"),
    "limit missing": ((*TRAIN, "--method", "lgail"), "--cost-limit"),
    "negative threshold": ((*TRAIN, "--cost-threshold=-1"), "--cost-threshold -1.0: must be finite and not negative"),
    "too many trajectories": ((*TRAIN, "--num-demos", "3"), "--num-demos 3: good.npz holds 2"),
    "too many trajectories for a folder": (
        ("train", "--method", "malm", "--env", "Swimmer", "--num-demos", "99"),
        "--num-demos 99: ",
    ),
    "nothing shipped": (
        ("train", "--method", "malm", "--env", "DoggoButton1"),
        "no demonstrations are shipped for DoggoButton1",
    ),
    "output under a file": ((*TRAIN, "--out", "good.npz/run"), "--out good.npz/run: cannot be "),
    "output a file": ((*TRAIN, "--out", "good.npz"), "--out good.npz: cannot be written (File exists)"),
    "output not writable": ((*TRAIN, "--out", "/proc/run"), "--out /proc/run: cannot be written"),
    "output holds a run": ((*TRAIN, "--out", "old"), "--out old: already holds a run; continue it with --resume"),
    "output not empty": ((*TRAIN, "--out", "full"), "--out full: not empty"),
    "config of nothing": ((*TRAIN, "--config", "none.toml"), "--config none.toml: cannot be read (No such file"),
    "config and resume": ((*TRAIN, "--resume", "--config", "a.toml"), "--config a.toml: a run that is resumed has its"),
    "nothing to resume": ((*TRAIN, "--resume"), "--resume: run holds no run"),
    "resume what": (("train", "--resume"), "--resume: needs --out"),
    "damaged run": (("train", "--resume", "--out", "old"), "config.json: keys are missing"),
    "expert without file": (("expert", "--env", "Swimmer"), "required: --out"),
    "expert to other format": (
        (*EXPERT, "--out", "expert.h5"),
        "--out expert.h5: the file is named *.npz",
    ),
    "expert twice": ((*EXPERT, "--out", "e.npz", "--export", "./e.npz"), "--export e.npz: is the file of --out"),
    "expert over a file": ((*EXPERT, "--out", "good.npz"), "--out good.npz: exists"),
    "expert to nowhere": ((*EXPERT, "--out", "good.npz/x.npz"), "--out good.npz: cannot be written"),
    "expert over a run": ((*EXPERT, "--run-dir", "old"), "--run-dir old: already holds a run"),
    "two minds": ((*EXPERT, "--unconstrained", "--cost-limit", "3"), "--cost-limit: --unconstrained has no limit"),
    "evaluate what": (("evaluate",), "RUN_DIR: give the folder of a run, or --policy FILE.npz; one of the two"),
    "evaluate two": (("evaluate", "done", "--policy", "good.npz"), "RUN_DIR: give the folder of a run, or --policy"),
    "evaluate no policy": (("evaluate", "--policy", "none.npz"), "none.npz: no such file; check the path"),
    "evaluate an expert that is not shipped": (
        ("evaluate", "--policy", "DoggoButton1"),
        "--policy DoggoButton1: no such file, and no expert of that name is shipped (shipped: Ant, CarGoal1,",
    ),
    "evaluate an unknown expert": (("evaluate", "--policy", "Hoper"), "did you mean Hopper? correct the path or the"),
    "show an expert that is not shipped": (
        ("report", "--policies", "DoggoButton1", "--out", "new.html"),
        "`python -m experiments.expert --env DoggoButton1 --out DoggoButton1.npz --export DoggoButton1_policy.npz`",
    ),
    "a rule of the multiplier of one's own": (
        ("train", "--method", "ccil", "--env", "Swimmer", "--multiplier-update", "my_methods:rule"),
        "sgd, pid, optimal; a rule of your own is the constraint of a method row, --method MODULE:ROW",
    ),
    "evaluate demonstrations": (("evaluate", "--policy", "good.npz"), "good.npz: key 'kernel_0' is missing; write the"),
    "evaluate nothing": (("evaluate", "none"), "RUN_DIR none: no such folder"),
    "evaluate something else": (("evaluate", "full"), "full/config.json: cannot be read"),
    "evaluate in another world": (("evaluate", "old", "--simulator", "bullet"), "--simulator: invalid choice"),
    "evaluate no episode": (("evaluate", "old", "--episodes", "0"), "--episodes: 0: must be at least 1"),
    "evaluate into notes": (
        ("evaluate", "done", "--out", "full/notes.txt"),
        "--out full/notes.txt: exists, and is not an intact file of evaluations; move it away",
    ),
    "evaluate into a run": (("evaluate", "done", "--out", "done/config.json"), "--out done/config.json: exists, and"),
    "export over a file": (("evaluate", "done", "--export", "good.npz"), "--export good.npz: exists; choose another"),
    "record over a file": (("evaluate", "done", "--record", "good.npz"), "--record good.npz: exists; choose another"),
    "record over a folder": (
        ("evaluate", "done", "--record", "old.npz", "--overwrite"),
        "--record old.npz: is a folder",
    ),
    "record to other format": (
        ("evaluate", "done", "--record", "new.csv"),
        "--record new.csv: a demonstrations file is named *.npz",
    ),
    "record twice": (
        (*RECORD, "--export", "./new.npz", "--seed-index", "0"),
        "--record new.npz: two results would go into this file",
    ),
    "record no such seed": ((*RECORD, "--seed-index", "2"), "--seed-index 2: there is no such seed; give one of 0, 1"),
    "record without a seed": (
        RECORD,
        "--record: no seed keeps the cost limit 20 (seed 0: 21, seed 1: 30.5); choose one by --seed-index N",
    ),
    "record what": (
        ("evaluate", "done", "--seed-index", "1"),
        "--seed-index 1: says what to record, export or show; add",
    ),
    "record how many": (("evaluate", "done", "--num-trajectories", "3"), "--num-trajectories 3: says what to record"),
    "record the mode": ((*RECORD, "--deterministic"), "--deterministic: demonstrations are recorded as the"),
    "record elsewhere": ((*RECORD, "--simulator", "original"), "--simulator original: demonstrations are recorded in"),
    "record too early": (("evaluate", "half", "--record", "new.npz"), "the run in half is not finished; continue it"),
    "overwrite nothing": (
        ("evaluate", "done", "--overwrite"),
        "--overwrite: for files of --export, --record and --video",
    ),
    "report on what": (("report",), "RUN_DIR: give at least one folder of a run, or --policies FILE.npz"),
    "report on no policy": (
        ("report", "--policies", "good.npz"),
        "good.npz: key 'kernel_0' is missing; write the file",
    ),
    "report on nothing": (("report", "none"), "RUN_DIR none: no such folder"),
    "report on something else": (("report", "full"), "full/config.json: cannot be read"),
    "benchmark of what": (("benchmark", "--tasks", "Swimer"), "--tasks Swimer: unknown task; did you mean Swimmer?"),
    "benchmark not divisible": (("benchmark", "--num-envs", "17", "--batch-size", "2000"), "--num-envs 17"),
    "benchmark to nowhere": (("benchmark", "--out", "good.npz/b.json"), "--out good.npz: cannot be written"),
    "sweep of what": (("sweep", "none.toml", "--out", "run"), "SPEC none.toml: cannot be read (No such file"),
    "ablations of what": (("ablations", "--out", "run"), "--env: required"),
    "ablations ask what": (("ablations", "--env", "Swimmer", "--out", "run", "--questions", "gat"), "invalid choice"),
    "ablations into a run": (("ablations", "--env", "Swimmer", "--out", "full"), "--out full: not empty"),
    "expert of what": (("expert", "--out", "expert.npz"), "--env: required"),
}


def assert_one_line(done: subprocess.CompletedProcess[str], launcher: str, message: str) -> None:
    assert done.returncode == 2, done
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"python -m experiments.{launcher}: error: ")
    assert message in done.stderr
    assert done.stdout == "no JAX\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working directory with good demonstrations, runs (old, finished, unfinished) and a folder of something else."""
    save_demonstrations(tmp_path / "good.npz", demonstrations())
    (tmp_path / "old.npz").mkdir()
    rows = [
        {"seed": i, "episode_return": 1.0, "episode_cost": cost, "episode_length": 5.0}
        for i, cost in enumerate([21, 30.5])
    ]
    config = Config(method="expert", cost_limit=20.0)
    facts = {"task": "Swimmer", "num_seeds": 2, "seed": 0, "physics": "native", "preset": "expert", "eval_episodes": 2}
    facts |= {"demonstrations": None, "command": "", "env_options": {}, "config": dataclasses.asdict(config)}
    facts |= {f"expert_{name}": None for name in ("return", "cost", "length")}
    summary = {"per_seed": rows, "random_return": 0.0, "random_cost": 0.0}
    steps = config.num_iterations * config.steps_per_iteration
    for name, content in (
        ("old/config.json", "{}"),
        ("full/notes.txt", "mine"),
        ("done/config.json", json.dumps(facts)),
        ("done/summary.json", json.dumps({**summary, "env_steps": steps})),
        ("done/checkpoints/1/data", ""),
        ("half/config.json", json.dumps(facts)),
        ("half/summary.json", json.dumps({**summary, "env_steps": steps - 1})),  # of before it was continued
        ("half/checkpoints/1/data", ""),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    return tmp_path


@pytest.mark.parametrize("case", FILES)
def test_bad_demonstrations(folder: Path, case: str) -> None:
    build, message = FILES[case]
    build(folder / "bad.npz")
    done = launch(*TRAIN, "--demos", "bad.npz", cwd=folder)
    assert_one_line(done, "train", message)
    assert "bad.npz" in done.stderr
    assert not (folder / "run").exists()  # nothing is left behind by a run that never was


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_options(folder: Path, case: str) -> None:
    arguments, message = OPTIONS[case]
    assert_one_line(launch(*arguments, cwd=folder), arguments[0], message)
    assert not (folder / "runs").exists()  # where runs go that are not told where
    assert not (folder / "new.npz").exists()


@pytest.mark.parametrize("launcher", ["train", "expert", "evaluate", "report", "benchmark", "ablations"])
def test_help_needs_no_jax(folder: Path, launcher: str) -> None:
    done = launch(launcher, "--help", cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--seed" in done.stdout
    assert "--out" in done.stdout
    assert done.stdout.endswith("no JAX\n")
