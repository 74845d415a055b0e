"""A task in a module of the user's own goes through all launchers, by its name `module:function`."""

import dataclasses
import json
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ccil_jax.demonstrations.trajectories import load_demonstrations
from ccil_jax.errors import UserError
from ccil_jax.methods import _methods
from ccil_jax.training import manifests
from experiments import ablations, benchmark, convert, evaluate, expert, report, sweep, train
from experiments.cli import command_line
from experiments.cli.names import safe_name
from experiments.page import video
from experiments.runs import figures, run_folder
from experiments.runs.environments import build_environment
from experiments.runs.metrics_file import read_metrics
from experiments.sweeps import backends, worker
from tests.probe_envs import quick_compilation

MODULE = '''
import jax
import jax.numpy as jnp
import numpy as np

import ccil_jax
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.agents import behavior_cloning
from envs.base import executed, first_state, next_state


class Cart:
    """A cart on a line. The reward is its speed; a step in which it is faster than 0.1 m/s costs 1."""

    name, obs_dim, action_dim = "Cart", 2, 1
    action_low, action_high = np.full(1, -1.0, np.float32), np.full(1, 1.0, np.float32)

    def __init__(self, max_episode_steps, push=0.2):
        self.max_episode_steps, self.push = max_episode_steps, push

    def reset(self, key):
        obs = 0.1 * jax.random.normal(key, (2,))
        return first_state(obs, obs, terms=())

    def step(self, state, action):
        speed = 0.9 * state.physics[1] + self.push * executed(self, action)[0]
        obs = jnp.stack([state.physics[0] + 0.1 * speed, speed])
        return next_state(
            state, physics=obs, obs=obs, reward=speed, cost=(speed > 0.1).astype(speed.dtype),
            terminated=jnp.zeros((), bool), terms={}, max_episode_steps=self.max_episode_steps,
        )


def make(max_episode_steps: int = 20, push: float = 0.2, shape: tuple = ((1, 2), (3,))):
    return Cart(max_episode_steps, push)


def short(push: float = 0.2):
    return Cart(10, push)


def like_a_run(max_episode_steps: int = 20, seed: int = 3, gamma: float = 0.9, method: str = "euler"):
    return Cart(max_episode_steps)


def broken(push):
    return Cart(10, push)


def linear(config, env):
    def init(key):
        return {"weights": jnp.zeros((env.obs_dim, env.action_dim)), "log_std": jnp.zeros(env.action_dim)}

    def apply(params, obs):
        return Gaussian(mean=obs @ params["weights"], log_std=params["log_std"])

    return ccil_jax.Policy(init, apply)


def agent(config, env, expert):
    plain = behavior_cloning.make(config, env, expert)

    def step(state):
        state, metrics = plain.step(state)
        return state, {"my/loss": metrics["loss"]}

    return ccil_jax.Agent(plain.init, step)


AGENT = ccil_jax.Method(agent=agent)
LINEAR = ccil_jax.Method(reward="task", constraint="unconstrained", imitates=False, policy=linear)
'''
TASK = "my_task:make"
TINY = ["--preset", "tiny", "--num-seeds", "2", "--eval-episodes", "3"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the module, which is the current one for all tests of this file, with an expert and a run there."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_task.py").write_text(MODULE, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch, quick_compilation():
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))  # importing the module adds the current folder
        made = ["--env", TASK, "--cost-limit", "20", "--out", "expert.npz", "--run-dir", "expert", *TINY]
        assert expert.main([*made, "--num-trajectories", "4"]) == 0
        assert train.main(["--env", TASK, "--method", "ccil", "--demos", "expert.npz", "--out", "run", *TINY]) == 0
        yield folder
    sys.modules.pop("my_task", None)
    sys.modules.pop("broken_tasks", None)
    for name in [name for name in _methods if ":" in name]:  # rows of modules that are no longer here
        del _methods[name]


BROKEN = """
import jax.numpy as jnp
import ccil_jax
import envs
from my_task import Cart


class Long(Cart):
    obs_dim = 5


class Column(Cart):
    def step(self, state, action):
        return super().step(state, action).replace(cost=jnp.zeros(1))


class Whole(Cart):
    def step(self, state, action):
        return super().step(state, action).replace(cost=jnp.zeros((), int))


class Silent(Cart):
    def step(self, state, action):
        pass


class Wrong(Cart):
    def step(self, state, action):
        return state.observation


class Unlicensed(Cart):
    def __init__(self):
        raise RuntimeError("no licence")


class Empty:
    pass


class LikeBrax(Empty):
    observation_size, action_size = 2, 1


def costly():
    return envs.with_cost(Cart(10), lambda before, action, after: action)


def rule(config):
    return ccil_jax.Constraint(combine=lambda multiplier, step_gap, gram: jnp.ones(3))


RULE = ccil_jax.Method(reward="discriminator", constraint=rule, limit="demonstrations")
"""


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("Long", r"obs after reset has shape \(2,\); make it \(5,\)"),
        ("Column", r"cost after step has shape \(1,\); make it \(\)"),
        ("Whole", r"cost is int32\[\], not float32\[\]"),
        ("Silent", "step returned NoneType; return an envs.State"),
        ("Wrong", r"step: broken_tasks.py, line \d+, raised AttributeError: .*; correct that function"),
        ("Unlicensed", r"broken_tasks.py, line \d+, raised RuntimeError: no licence"),
        ("Empty", "has no name, obs_dim, .*; return an envs.Environment$"),
        ("LikeBrax", r"has no name, obs_dim, .*; return an envs.Environment \(wrap it in envs.FromBrax\)$"),
        ("costly", r"Cart: cost must have shape \(\), but has shape \(1,\)"),
    ],
)
def test_a_task_that_breaks_its_promises_is_one_line(folder: Path, task: str, message: str) -> None:
    (folder / "broken_tasks.py").write_text(BROKEN, encoding="utf-8")
    with pytest.raises(UserError, match=rf"env broken_tasks:{task}: (.*\W)?{message}"):
        build_environment(f"broken_tasks:{task}", "auto", {})


def test_a_run_that_fails_before_its_first_iteration_does_not_block_its_folder(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The corrected command may write there; once an iteration is done, or a stranger's file lies there, no more."""
    (folder / "broken_tasks.py").write_text(BROKEN, encoding="utf-8")
    given = ["--env", TASK, "--method", "broken_tasks:RULE", "--demos", "expert.npz", "--out", "failed", *TINY]
    assert "combine: returned an array of shape (3,)" in refused(capsys, train, *given, lines=2)
    assert Path("failed/config.json").is_file()
    arguments = train.make_parser().parse_args(given)
    assert train.make_plan(arguments).folder == Path("failed")
    for name in ("notes.txt", "checkpoints/120/data", "metrics.csv"):
        file = Path("failed", name)
        file.parent.mkdir(exist_ok=True)
        file.write_text("something")
        with pytest.raises(UserError, match="--out failed: already holds a run; continue it with --resume"):
            train.make_plan(arguments)
        file.unlink()
        if file.parent.name == "120":
            file.parent.rmdir()
    assert train.make_plan(arguments).folder == Path("failed")


def test_another_folder_does_not_know_the_method_but_the_run_is_whole(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = run_folder.read_json(Path("run/config.json"))
    facts["config"]["method"] = "elsewhere:NEAR"
    (tmp_path / "config.json").write_text(json.dumps(facts), encoding="utf-8")
    said = refused(capsys, evaluate, str(tmp_path))
    assert "there is no module 'elsewhere'; start in the folder that holds it" in said
    assert "damaged" not in said


def refused(capsys: pytest.CaptureFixture[str], launcher: Any, *arguments: str, lines: int = 1) -> str:
    """The one line of a launcher that refuses its arguments; `lines` counts those before it too."""
    with pytest.raises(SystemExit) as end:
        launcher.main(list(arguments))
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == lines
    return said


def test_demonstrations_name_the_task_and_its_options(folder: Path) -> None:
    facts = load_demonstrations(folder / "expert.npz").metadata
    assert (facts["task"], facts["physics"], facts["cost_limit"]) == (TASK, "auto", 20.0)
    assert (facts["push"], facts["max_episode_steps"]) == (0.2, 20)
    assert "shape" not in facts  # JSON has no tuples: it is left to the task


def test_a_run_goes_on_for_longer(folder: Path) -> None:
    assert train.main(["--resume", "--out", "run", "--env-steps", "360"]) == 0
    assert run_folder.read_json(Path("run/summary.json"))["env_steps"] == 360
    assert read_metrics(Path("run"))["env_steps"][:, 0].tolist() == [120.0, 240.0, 360.0]
    facts = run_folder.read_run(Path("run")).facts
    assert (facts["task"], facts["env_options"]) == (TASK, {"push": 0.2, "max_episode_steps": 20})


def test_a_run_without_a_folder_gets_one_with_a_safe_name(folder: Path) -> None:
    assert (
        train.main(["--env", TASK, "--method", "bc", "--cloning-updates", "100", "--demos", "expert.npz", *TINY]) == 0
    )
    (made,) = Path("runs").iterdir()
    assert re.fullmatch(r"my_task_make_bc_\d{8}-\d{6}", made.name)
    assert safe_name("a/b[0]:c d,e=1.5e-3") == "a_b_0__c d,e=1.5e-3"
    assert command_line.default_folder("../x:y", "m:N").name.startswith(".._x_y_m_N_")


def test_evaluate_records_and_exports(folder: Path) -> None:
    again = ["--episodes", "3", "--seed-index", "1", "--num-trajectories", "2"]
    assert evaluate.main(["run", *again, "--record", "more.npz", "--export", "policy.npz", "policy.stablehlo"]) == 0
    more = load_demonstrations(Path("more.npz"))
    assert (more.num_episodes, more.obs.shape, more.metadata["task"]) == (2, (40, 2), TASK)
    entry = run_folder.read_json(Path("run/evaluation.json"))["ours"]
    assert [row["episode_length"] for row in entry["per_seed"]] == [20.0, 20.0]
    assert convert.main(["more.npz", "--env", TASK, "--out", "converted.npz"]) == 0


def test_a_method_with_a_policy_of_its_own(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It can do all that needs no NumPy."""
    given = ["--env", TASK, "--method", "my_task:LINEAR", "--env-steps", "120", *TINY]
    assert train.main([*given, "--out", "linear"]) == 0
    assert evaluate.main(["linear", "--episodes", "2", "--export", "linear.stablehlo"]) == 0
    assert Path("linear.stablehlo").is_file()
    message = "--export linear.npz: method my_task:LINEAR has a policy of its own, which only JAX can compute"
    capsys.readouterr()
    assert message in refused(capsys, evaluate, "linear", "--export", "linear.npz")
    assert report.main(["linear", "--out", "linear.html"]) == 0


def test_an_agent_that_reports_other_metrics(folder: Path) -> None:
    given = ["--env", TASK, "--method", "my_task:AGENT", "--demos", "expert.npz", "--env-steps", "240", *TINY]
    assert train.main([*given, "--out", "agent"]) == 0
    assert read_metrics(Path("agent"))["my/loss"].shape == (2, 2)
    assert Path("agent/figures/my_loss.png").is_file()
    assert report.main(["agent", "run", "--out", "agent.html"]) == 0


ROBOTS = """
from pathlib import Path

import jax.numpy as jnp
import envs
from envs.locomotion import Locomotion, LocomotionTask

POLE = LocomotionTask(
    xml=str(Path("pole.xml").resolve()), frame_skip=2, num_hidden=1, cost_quantity=lambda x: jnp.abs(x.velocity[0]),
    qpos_noise=0.1, view="side",
)


def pole(physics: str = "native", max_episode_steps: int = 10):
    env = Locomotion(POLE, name="Pole", physics=physics, max_episode_steps=max_episode_steps, cost_threshold=1.0)
    return envs.with_cost(env, lambda before, action, after: jnp.square(action).sum())
"""
POLE = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody>
    <body pos="0 0 .5">
      <joint type="slide" axis="1 0 0"/>
      <geom type="box" size=".2 .1 .1"/>
      <body><joint name="swing" axis="0 1 0"/><geom type="capsule" size=".05" fromto="0 0 0 0 0 .6"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="swing" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def test_a_robot_of_ones_own_is_seen_in_a_video_and_on_the_page(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From its own model, with another cost; a task without a model is said to have none, wherever it is asked for."""
    Path("my_robots.py").write_text(ROBOTS, encoding="utf-8")
    Path("pole.xml").write_text(POLE, encoding="utf-8")
    given = ["--env", "my_robots:pole", "--unconstrained", *TINY, "--num-seeds", "1", "--env-steps", "120"]
    assert expert.main([*given, "--out", "pole.npz", "--run-dir", "pole"]) == 0
    assert evaluate.main(["pole", "--episodes", "2", "--video", "pole.gif"]) == 0
    with Image.open("pole.gif") as film:
        assert film.n_frames == 11
    assert report.main(["pole", "run", "--out", "two.html"]) == 0
    page = Path("two.html").read_text(encoding="utf-8")
    assert page.count("<canvas") == 1
    assert "No episode of ccil is shown: its task cannot be drawn, because it has no MuJoCo model." in page
    monkeypatch.chdir(folder.parent)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(folder))])
    monkeypatch.delitem(sys.modules, "my_robots")
    assert report.main([str(folder / "pole"), "--out", str(folder / "elsewhere.html")]) == 0
    page = (folder / "elsewhere.html").read_text(encoding="utf-8")
    assert "No episode of trpo is shown: its task cannot be built here" in page
    assert "there is no module &#x27;my_robots&#x27;" in page
    monkeypatch.chdir(folder)
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(evaluate.evaluating, "load", lambda *_: pytest.fail("policies are loaded"))
    capsys.readouterr()
    for name in ("a.gif", "a.mp4"):
        said = refused(capsys, evaluate, "run", "--video", name)
        assert f"--video {name}: task {TASK} cannot be drawn, because it has no MuJoCo model; leave it out" in said


def test_options_of_a_task_may_be_named_like_those_of_a_run(folder: Path) -> None:
    """Neither demonstrations nor a run that goes on take the one for the other."""
    given = ["--env", "my_task:like_a_run", *TINY]
    where = ["--run-dir", "named", "--out"]
    assert expert.main([*given, "--cost-limit", "20", *where, "named.npz"]) == 0
    facts = load_demonstrations("named.npz").metadata
    assert (facts["seed"], facts["method"]) == (0, "expert")
    assert (facts["env_options"]["seed"], facts["env_options"]["method"]) == (3, "euler")
    assert train.main([*given, "--method", "gail", "--demos", "named.npz", "--out", "named_gail"]) == 0
    assert expert.main(["--resume", "--env-steps", "360", *where, "more_named.npz"]) == 0
    assert run_folder.read_run(Path("named")).config.gamma == 0.995


def test_a_run_keeps_the_options_of_its_task(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the task has other defaults by now."""
    given = [
        "--env",
        TASK,
        "--method",
        "bc",
        "--cloning-updates",
        "100",
        "--demos",
        "expert.npz",
        "--out",
        "kept",
        *TINY,
    ]
    assert train.main(given) == 0
    monkeypatch.setattr(sys.modules["my_task"].make, "__defaults__", (20, 0.3, ()))
    with pytest.raises(SystemExit):  # the demonstrations are of the task as it was
        train.main([*given[:-7], "--out", "other", *TINY])
    assert train.main(["--resume", "--out", "kept"]) == 0
    assert run_folder.read_run(Path("kept")).facts["env_options"]["push"] == 0.2


def make_earlier(folder: Path) -> None:
    """Turns a run folder into one of before the policy could begin with a clone and bc counted gradient steps."""

    def change(config: dict[str, Any]) -> None:
        for name in ("action_likelihood", "cloning_updates", "warmup_iterations", "cloning_weight", "outer_loss"):
            del config[name]
        config["bc_epochs"] = 200

    content = run_folder.read_json(folder / "config.json")
    change(content["config"])
    run_folder.write_json(folder / "config.json", content)
    for path in folder.glob(f"checkpoints/*/{manifests.NAME}"):
        manifest = run_folder.read_json(path)
        del manifest["sha256"]
        change(manifest["identity"]["configs"][0])
        path.write_text(json.dumps({**manifest, "sha256": manifests._sha256(manifest)}))


def test_a_run_of_an_earlier_version_goes_on_bit_for_bit(folder: Path) -> None:
    for name in ("earlier", "undisturbed"):
        shutil.copytree("run", name)
    make_earlier(Path("earlier"))
    for name in ("earlier", "undisturbed"):
        assert train.main(["--resume", "--out", name, "--env-steps", "480"]) == 0
    earlier, undisturbed = (Path(name, "metrics.csv").read_bytes() for name in ("earlier", "undisturbed"))
    assert len(earlier.splitlines()) == 1 + 4 * 2
    assert earlier == undisturbed


def test_a_cloning_of_an_earlier_version_is_evaluated_and_reported_but_not_continued(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [
        "--env",
        TASK,
        "--method",
        "bc",
        "--cloning-updates",
        "200",
        "--demos",
        "expert.npz",
        "--out",
        "old",
        *TINY,
    ]
    assert train.main(given) == 0
    assert evaluate.main(["old", "--episodes", "3", "--out", "before.json"]) == 0
    make_earlier(Path("old"))
    assert evaluate.main(["old", "--episodes", "3", "--out", "after.json"]) == 0
    before, after = (run_folder.read_json(Path(name))["ours"] for name in ("before.json", "after.json"))
    assert after["per_seed"] == before["per_seed"]
    assert report.main(["old", "run", "--no-animation", "--out", "old.html"]) == 0
    page = Path("old.html").read_text()
    assert "<tr><td>bc_epochs</td><td>200</td><td>-</td></tr>" in page
    assert "<tr><td>cloning_updates</td><td>-</td><td>0</td></tr>" in page
    assert figures.read_curve(Path("old")).iteration == "passes over the demonstrations"
    assert figures.read_curve(Path("run")).iteration == "iterations of 100 gradient steps"
    capsys.readouterr()
    assert "old: written with bc_epochs 200 by an earlier version: bc now counts" in refused(
        capsys, train, "--resume", "--out", "old"
    )


def test_a_run_whose_method_is_not_found_is_not_called_damaged(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = run_folder.read_json(Path("run/config.json"))
    Path("away").mkdir()
    run_folder.write_json(Path("away/config.json"), {**facts, "config": {**facts["config"], "method": "no_such:ROW"}})
    said = refused(capsys, evaluate, "away")
    assert "there is no module 'no_such'; start in the folder that holds it" in said
    assert "damaged" not in said


def test_sizes_that_do_not_fit_leave_no_run_behind(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ccil_jax.demonstrations.trajectories import save_demonstrations

    found = load_demonstrations(folder / "expert.npz")
    wide = np.hstack([found.obs, found.obs])
    save_demonstrations("wide.npz", dataclasses.replace(found, obs=wide, final_obs=None))
    given = ["--env", TASK, "--method", "gail", "--demos", "wide.npz", "--out", "wide", *TINY]
    with pytest.raises(SystemExit):
        train.main(given)
    assert "obs has 4 columns but Cart has 2" in capsys.readouterr().err
    assert not Path("wide/config.json").exists()


def test_a_report_needs_no_animation(folder: Path) -> None:
    assert report.main(["run", "expert", "--out", "page.html", "--figures", "figures"]) == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert f"<h2>{TASK}</h2>" in page
    assert "<canvas" not in page
    assert [path.name for path in Path("figures").iterdir()] == ["my_task_make.png"]


def test_a_sweep_trains_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def launch(folders: Sequence[Path], num_workers: int, logs: Path, settings: Mapping[str, Any]) -> backends.Outcomes:
        for job in folders:
            path = job.resolve()
            monkeypatch.chdir("/")  # as a worker on another machine
            status = worker.main([str(path)])
            assert Path.cwd() == folder
            yield job, None if status == 0 else "failed"

    monkeypatch.setattr(backends, "BACKENDS", {"processes": backends.Backend(launch=launch)})
    fixed = {"preset": "tiny", "num_seeds": 1, "eval_episodes": 2, "cost_limit": 5.0, "env_steps": 120}
    spec = {"env": "my_task:short", "method": "expert", "fixed": fixed, "grid": {"gamma": [0.9, 0.99]}}
    Path("spec.json").write_text(json.dumps(spec), encoding="utf-8")
    assert sweep.main(["spec.json", "--out", "sweep"]) == 0
    for name in ("gamma=0.9", "gamma=0.99"):
        (row,) = run_folder.read_json(Path("sweep/runs", name, "summary.json"))["per_seed"]
        assert row["episode_length"] == 10.0
    (program,) = Path("sweep/programs").iterdir()
    assert program.name.startswith("my_task_short_expert_")
    for summary in Path("sweep/runs").glob("*/summary.json"):
        summary.unlink()
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    job = program.resolve()
    monkeypatch.chdir(elsewhere)  # as a worker of a cluster may be
    monkeypatch.delitem(sys.modules, "my_task")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(folder))])
    assert worker.main([str(job)]) == 0
    assert (folder / "sweep/runs/gamma=0.9/summary.json").is_file()


EXPERT = ("--out", "x.npz", "--run-dir", "x")
RUN = ("--method", "trpo", "--out", "x")


@pytest.mark.parametrize(
    ("launcher", "arguments", "message"),
    [
        (expert, ("--env", TASK, *EXPERT), f"--cost-limit: required, as {TASK} has no default"),
        (evaluate, ("run", "--simulator", "original"), f"--simulator original: task {TASK} has no original"),
        (benchmark, ("--tasks", TASK), f"--tasks {TASK}: takes no physics"),
        (train, ("--env", TASK, *RUN, "--physics", "mjx"), f"--physics mjx: {TASK} has no such option"),
        (train, ("--env", TASK, *RUN, "--cost-threshold", "1"), f"--cost-threshold: {TASK} has no such option"),
        (
            train,
            ("--env", "my_task:short", *RUN, "--max-episode-steps", "5"),
            "--max-episode-steps: my_task:short",
        ),
        (train, ("--env", TASK, "--method", "ccil"), f"no demonstrations are shipped for {TASK}"),
        (train, ("--env", "my_task:mke", *RUN), "--env my_task:mke: "),
        (train, ("--env", "no_such_module:make", *RUN), "--env no_such_module:make: "),
        (train, ("--env", "my_task:broken", *RUN), "--env my_task:broken: parameter 'push'"),
        (ablations, ("--env", "my_task:mke", "--out", "x"), "--env my_task:mke: "),
        (
            train,
            ("--env", "my_task:short", "--method", "bc", "--demos", "expert.npz", "--out", "x"),
            f"expert.npz: recorded on task '{TASK}', not 'my_task:short'",
        ),
    ],
)
def test_what_does_not_go_with_it_is_refused(
    folder: Path, launcher: Any, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, launcher, *arguments)
    assert not (folder / "x").exists()


def test_demonstrations_longer_than_an_episode_are_refused_once_that_is_known(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A task that takes no time limit has one all the same."""
    from ccil_jax.demonstrations.trajectories import save_demonstrations

    demonstrations = load_demonstrations(folder / "expert.npz")
    demonstrations.metadata.pop("task")
    save_demonstrations(folder / "long.npz", demonstrations)
    given = ["--env", "my_task:short", "--method", "ccil", "--demos", "long.npz", "--out", "long", *TINY]
    with pytest.raises(SystemExit):
        train.main(given)
    assert "trajectory 0 has 20 steps, an episode of this run has at most 10" in capsys.readouterr().err


def test_a_run_whose_task_is_gone_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "my_task")
    (folder / "my_task.py").rename(folder / "other.py")
    try:
        assert f"RUN_DIR run: of task {TASK}, which is not known here" in refused(capsys, evaluate, "run")
        assert f"--env {TASK}: " in refused(capsys, train, "--resume", "--out", "run")
        assert report.main(["run", "--out", "gone.html"]) == 0  # its files say enough
    finally:
        (folder / "other.py").rename(folder / "my_task.py")
