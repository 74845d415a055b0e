"""The commands of the pages are carried out, page by page in the order of reading, small where they would be long.

Together they take many minutes, so these tests are slow ones; `test_commands.py` reads every command in each run of the
tests.
"""

import gc
import importlib
import json
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import gymnasium
import minari
import pytest

from experiments import train
from tests.probe_envs import quick_compilation
from tests.test_commands import PLACEHOLDERS, TINY, Command, blocks, commands, own_tasks  # noqa: F401  (a fixture)
from tests.test_documentation import PAGES, ROOT

# What makes a command long, and is left out before the small settings are added.
LONG = {
    "train": "preset env-steps num-envs batch-size discriminator-minibatch-size critic-minibatch-size cloning-updates "
    "num-seeds eval-episodes",
    "expert": "preset num-envs batch-size num-seeds eval-episodes num-trajectories cost-limit env-steps",
    "evaluate": "episodes num-trajectories",
    "ablations": "preset env-steps num-seeds eval-episodes questions batch-size",
    "benchmark": "preset tasks num-seeds num-envs jobs quick overwrite",
    "growth": "axes largest",
}
SHORT = {
    "train": TINY,
    "evaluate": ["--episodes", "2"],
    "ablations": [*TINY, "--questions", "outer_loss"],
    "benchmark": "--preset tiny --tasks Swimmer --num-seeds 1 --num-envs 4 --quick --overwrite".split(),
    "growth": ["--axes", "seeds", "--largest", "2"],
}
TINY_STEPS, LIMIT = 240, "100000"  # an expert that is hardly trained keeps a limit that none can exceed
NOT_CARRIED_OUT = {  # how a command begins that is not carried out here, and why
    "make ": "sets up environments; CI calls `make test`",
    "docker ": "needs a daemon; `test_container.py` carries out the steps of the image",
    "pip install": "installs packages",
    "python3.10 -m venv": "environments of other projects",
    ".venv-peers": "environments of other projects",
    "python -m experiments.benchmark --peers": "needs these environments",
    "python tests/golden/run_policy.py": "needs safety-gymnasium in an environment of its own",
    "python -m experiments.expert --resume --run-dir runs/Humanoid --env-steps 6000000": "the run has been stopped",
    "python -m experiments.replay_fault": "needs a run that a fault ended; `test_faults.py` has one",
    "minari download": "needs a network",
    "tensorboard ": "a server that does not end",
    "mkdir ": "writes into the home folder",
    "export ": "of the shell",
    "experiments.convert cart.csv": "needs a format of one's own; `test_extending.py` has it",
}
RUNS = {  # finished runs that a page presupposes
    "docs/commands.md": "runs/demo runs/other runs/first",
    "docs/results.md": "RUN runs/TASK_malm runs/TASK_cvag runs/TASK_ccil runs/TASK_gail",
}
CLUSTER = re.compile(r"--launcher (ray|slurm)")  # `test_sweep.py` has a launcher of its own in their place
# In the middle of a sentence, without what the launcher needs.
SENTENCES = re.compile(r"^((train|ccil) |experiments\.train$)")


def without(words: Sequence[str], options: str) -> list[str]:
    """The words but for these options and their values."""
    kept, dropping = [], False
    for word in words:
        dropping = word.removeprefix("--") in options.split() if word.startswith("--") else dropping
        if not dropping:
            kept.append(word)
    return kept


def value_of(words: Sequence[str], option: str, default: float) -> float:
    return float(words[words.index(option) + 1]) if option in words else default


def shortened(launcher: str, given: Sequence[str]) -> list[str]:
    """With small settings. The lengths of an expert's trainings keep their order, so that one can be trained on."""
    if given == ["--help"]:
        return list(given)
    words = without(given, LONG.get(launcher, ""))
    if launcher == "expert":
        steps = TINY_STEPS * int(value_of(given, "--env-steps", 3e6) / 1e5) // 10
        limit = [] if "--unconstrained" in words else ["--cost-limit", LIMIT]
        size = ["--env-steps", str(steps)] if "--env-steps" in given or "--resume" not in words else []
        new = [] if "--resume" in words else [*TINY, "--num-trajectories", "2"]
        return [*words, *limit, *size, *new, "--overwrite"]
    if launcher == "train" and "--resume" in words:
        return words
    if launcher == "evaluate":
        written = {"--record", "--export", "--video"} & {*words}
        recorded = ["--num-trajectories", "2"] if "--record" in words else []
        return [*words, *SHORT[launcher], *recorded, *(["--overwrite"] if written else [])]
    more = ["--overwrite"] if launcher in ("convert", "report") and "--overwrite" not in words else []
    return [*words, *SHORT.get(launcher, []), *more]


def carried_out(page: str) -> list[Command]:
    """The commands of a page that can be."""
    found = []
    for command in commands({name: word for name, word in PLACEHOLDERS.items() if not name.startswith("minari:")}):
        line = shlex.join(command.words)
        alone = any(line.startswith(beginning) for beginning in NOT_CARRIED_OUT)
        if command.page == page and not alone and not CLUSTER.search(line) and not SENTENCES.match(line):
            found.append(command)
    return found


def carry_out(words: Sequence[str]) -> None:
    """In this process where it is a launcher of ours, which saves the start of another."""
    if list(words[:2]) == ["python", "-m"]:
        words = words[2:]
    first, *given = words
    if first.startswith("experiments."):
        name = first.removeprefix("experiments.")
        given = [str(path) for word in given for path in (sorted(Path().glob(word)) if "*" in word else [word])]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("default")  # as for a reader: Brax warns of itself
                status = importlib.import_module(first).main(shortened(name, given))
        except SystemExit as end:  # `--help`, and bad input, which has said what is wrong
            status = end.code
        assert status in (0, None), shlex.join(shortened(name, given))
    else:
        assert first == "python", "what kind of command is this?"
        subprocess.run([sys.executable, *given], check=True)


@pytest.fixture(scope="module")
def first_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, as the pages presuppose one."""
    folder = tmp_path_factory.mktemp("first") / "run"
    with quick_compilation():
        two = ["--num-seeds", "2", "--out", str(folder)]
        assert train.main(["--method", "malm", "--env", "HalfCheetah", *TINY, *two]) == 0
    return folder


def make_dataset() -> None:
    """What the page on demonstrations downloads from Minari, without costs; two short episodes."""
    env = minari.DataCollector(gymnasium.make("Hopper-v5"))
    env.action_space.seed(0)
    for seed in range(2):
        env.reset(seed=seed)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no author, no description, and a folder that nobody removes
        env.create_dataset("mujoco/hopper/expert-v0")
        env.close()
        del env
        gc.collect()


def write_modules(folder: Path) -> None:
    """What the page on extensions tells to put into `my_tasks.py` and `my_methods.py`, beside what is there."""
    texts = [*blocks("docs/extending.md", "python")]
    (brax,) = (text.partition("brax_env =")[0] for text in texts if "def pendulum_of_brax" in text)
    with (folder / "my_tasks.py").open("a", encoding="utf-8") as file:
        file.write(brax)
    (rule,) = (text.partition("agent =")[0] for text in texts if "def leaky" in text)
    (row,) = (text for text in texts if text.startswith("LEAKY ="))
    text = f"import jax.numpy as jnp\nimport ccil_jax\n{rule}{row}"
    (folder / "my_methods.py").write_text(text, encoding="utf-8")


@pytest.fixture
def reader(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    first_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    own_tasks: Path,  # noqa: F811
) -> None:
    """A folder with what a reader has at the start of the page that the test's parameter names."""
    page = request.node.callspec.params["page"]
    del own_tasks  # the same folder, with `my_tasks.py`, where we are now
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "true")  # of processes that a launcher starts
    for name in RUNS.get(page, "").split():
        shutil.copytree(first_run, tmp_path / name)
    shutil.copy(ROOT / "experiments/demonstrations/Swimmer.npz", tmp_path / "FILE")
    if page == "docs/ablations_paper.md":
        shutil.copytree(ROOT / "experiments/demonstrations", tmp_path / "runs")
    if page == "docs/demonstrations.md":
        make_dataset()
        (recording,) = blocks(page, "python")
        subprocess.run([sys.executable, "-c", recording], check=True)
    if page == "docs/extending.md":
        write_modules(tmp_path)
    (spec,) = blocks("docs/sweeps.md", "toml")
    short = spec.replace("num_seeds = 3\nenv_steps = 300000", 'num_seeds = 1\npreset = "tiny"\neval_episodes = 2')
    assert short != spec
    (tmp_path / "spec.toml").write_text(short, encoding="utf-8")


@pytest.mark.slow
@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("page", [page for page in PAGES if carried_out(page)])
def test_the_commands_of_a_page_do_what_they_should(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    failed = {}
    for command in carried_out(page):
        try:
            carry_out(command.words)
        except (AssertionError, subprocess.CalledProcessError) as error:
            failed[shlex.join(command.words)] = f"{error} {capsys.readouterr().err[-2000:]}"
    assert not failed, json.dumps(failed, indent=1)


def test_what_is_not_carried_out_is_a_command_of_a_page() -> None:
    lines = [shlex.join(command.words) for command in commands()]
    for beginning in NOT_CARRIED_OUT:
        assert any(line.startswith(beginning) for line in lines), beginning
    assert sum(len(carried_out(page)) for page in PAGES) > 80
