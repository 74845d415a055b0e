"""`docs/extending.md` from outside the package: its Python blocks in order, in a folder of their own."""

import ast
import dataclasses
import re
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import ccil_jax
import envs
from ccil_jax.acting.distributions import Gaussian
from ccil_jax.acting.networks import POLICIES
from ccil_jax.agents.build import AGENTS
from ccil_jax.config import CHOICES, validate
from ccil_jax.demonstrations import formats
from ccil_jax.errors import ConfigError
from ccil_jax.learning.constraints import CONSTRAINTS
from ccil_jax.learning.reward_models import REWARD_MODELS
from ccil_jax.methods import _BUILT_IN, Method, _checked, _methods
from envs import registry
from envs.locomotion import LocomotionTask
from envs.testing import check_environment
from experiments import train
from tests.probe_envs import Walk, quick_compilation, walk_config, walk_demonstrations

PAGE = Path(__file__).parent.parent / "docs" / "extending.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What the page's program has defined. Its registrations are undone afterwards."""
    namespace: dict[str, Any] = {"__name__": "extending"}
    kept = {name: dict(table) for name, table in (("tasks", registry._tasks), ("methods", _methods))}
    kept_formats = list(formats.FORMATS)
    with pytest.MonkeyPatch.context() as patched, quick_compilation():
        patched.chdir(tmp_path_factory.mktemp("page"))
        for block in BLOCKS:
            with warnings.catch_warnings():
                if "import brax" in block:  # which warns of itself and of what it imports
                    warnings.simplefilter("ignore")
                exec(compile(block, str(PAGE), "exec"), namespace)  # noqa: S102  (the page is ours)
        yield namespace
    registry._tasks.clear()
    registry._tasks.update(kept["tasks"])
    _methods.clear()
    _methods.update(kept["methods"])
    formats.FORMATS[:] = kept_formats


def test_the_tasks_keep_their_promises(names: dict[str, Any]) -> None:
    check_environment(names["careful"])
    check_environment(names["balancing"])
    check_environment(names["sliding"])
    assert envs.TASKS["Cart"].cost_limit == 5.0


def test_the_puck_pays_where_it_is_faster_than_a_metre_a_second(names: dict[str, Any]) -> None:
    """In the page's own words, from the places where the engine has it."""
    env = names["sliding"]
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    costs = []
    for _ in range(30):
        before, state = state.physics.qpos, step(state, jnp.array([1.0, 0.5]))
        velocity = (state.physics.qpos - before) / env.dt
        np.testing.assert_allclose(state.reward, velocity[0], rtol=1e-5)
        assert state.cost == float(np.linalg.norm(velocity) > 1.0)
        costs.append(float(state.cost))
    assert set(costs) == {0.0, 1.0}
    assert state.obs.shape == (env.obs_dim,) == (2,)


def test_the_slow_cheetah_pays_where_its_torso_is_fast(names: dict[str, Any]) -> None:
    """By MuJoCo's own name of the joint along x; reward and observations are those of HalfCheetah."""
    own, usual = names["slow_cheetah"](max_episode_steps=50), envs.make("HalfCheetah")
    along_x = usual.model.joint("rootx").dofadr[0]
    step, start = jax.jit(own.step), usual.reset_to(usual.model.qpos0, np.zeros(9))
    costs = []
    for speed in (0.5, 0.9, 2.0, 3.0):
        state = step(usual.reset_to(usual.model.qpos0, speed * np.eye(9)[along_x]), jnp.zeros(6))
        assert state.cost == float(state.physics.qvel[along_x] > 1.0)
        costs.append(float(state.cost))
    assert set(costs) == {0.0, 1.0}
    after = jax.jit(usual.step)(start, jnp.ones(6))
    np.testing.assert_array_equal(step(start, jnp.ones(6)).obs, after.obs)
    assert own.max_episode_steps == 50


def test_the_page_lists_every_field_of_a_robot() -> None:
    """With its default, and so does the documentation of the class."""
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\| ", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    fields = {f.name: f.default for f in dataclasses.fields(LocomotionTask)}
    assert {name: text.strip(' "') for name, text in rows} == {
        name: "" if default is dataclasses.MISSING else str(default).replace("'", '"')
        for name, default in fields.items()
    }
    documented = re.findall(r"^        (\w+): ", str(LocomotionTask.__doc__), re.MULTILINE)
    assert documented == list(fields)


def test_what_the_page_imports_is_part_of_the_api() -> None:
    text = PAGE.read_text(encoding="utf-8")
    api = set(re.findall(r"^::: (\S+)$", (PAGE.parent / "api.md").read_text(encoding="utf-8"), re.MULTILINE))
    used = {
        f"{node.module}.{alias.name}"
        for block in re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    used |= set(re.findall(r"(?<![.\w])(?:envs|ccil_jax)(?:\.[a-z]\w*)*\.[A-Za-z]\w*", text))
    modules = {"envs.base", "envs.locomotion", "envs.testing", "envs.physics", "ccil_jax.acting.distributions"}
    ours = {name for name in used if name.startswith(("envs.", "ccil_jax."))} - modules
    assert len(ours) > 30
    assert ours - api == set()


@pytest.mark.filterwarnings("ignore:Accessing `ncon`:DeprecationWarning")  # Brax's own use of MJX
def test_an_environment_of_brax_has_the_cost_of_the_page(names: dict[str, Any]) -> None:
    env = names["brax_env"]
    assert env.max_episode_steps == 100
    state = jax.eval_shape(env.step, jax.eval_shape(env.reset, jax.random.key(0)), jnp.zeros(1))
    assert (state.cost.shape, state.obs.shape) == ((), (4,))
    shown = [types.SimpleNamespace(obs=jnp.array([place, 0.0, 0.0, 0.0])) for place in (0.05, -0.2)]
    assert [float(names["off_centre"](None, jnp.zeros(1), after)) for after in shown] == [0.0, 1.0]


def test_the_page_trains_its_own_method(names: dict[str, Any]) -> None:
    """Its rule, lambda = max(0, s) with s <- 0.9 s + rate (J_k - J_E), reward, and network."""
    result = names["result"]
    assert result.config.cost_limit == names["demonstrations"].mean_episode_cost
    total = np.full(2, result.config.initial_multiplier)
    for cost, multiplier in zip(result.metrics["episode_cost"], result.metrics["multiplier"], strict=True):
        gap = np.where(np.isnan(cost), 0.0, cost - result.config.cost_limit)  # J_k starts at the limit
        total = 0.9 * total + result.config.multiplier_learning_rate * gap
        np.testing.assert_allclose(multiplier, np.maximum(total, 0.0), rtol=1e-4, atol=1e-6)
    assert (result.metrics["imitation_reward"] > 0).all()
    assert (result.metrics["imitation_reward"] <= 1).all()
    assert result.actor.policy_params["weights"].shape == (2, 2, 1)
    assert names["found"].episode_return.shape == (2, 4)


def test_a_rule_from_outside_is_that_of_the_package_where_both_say_the_same() -> None:
    """Projected dual ascent, lambda <- min(max(lambda + rate (J_k - J_E), 0), max), written down once more."""
    config = walk_config(method="ccil", multiplier_update="sgd", multiplier_max=0.3)

    def update(multiplier: Any, cost_gap: Any, outer: Any) -> tuple[Any, dict[str, Any]]:
        return jnp.clip(multiplier + config.multiplier_learning_rate * cost_gap, 0.0, config.multiplier_max), {}

    own = ccil_jax.Constraint(
        init=lambda: jnp.asarray(config.initial_multiplier),
        multiplier=lambda multiplier: multiplier,
        combine=lambda multiplier, step_gap, gram: jnp.stack([jnp.ones(()), -multiplier]),
        update=update,
    )

    def trained(constraint: ccil_jax.Constraint | None) -> Any:
        agent = ccil_jax.make_agent(config, Walk(), walk_demonstrations(), constraint=constraint)
        step, state = jax.jit(agent.step), jax.jit(agent.init)(jax.random.key(3))
        for _ in range(4):
            state, metrics = step(state)
        return state.actor, metrics

    with quick_compilation():
        ours, theirs = trained(None), trained(own)
    assert 0 < theirs[1]["multiplier"] < 0.3
    chex.assert_trees_all_equal(ours, theirs)


def test_an_agent_can_be_differentiated() -> None:
    """The derivative of the policy after one iteration with respect to the trust region's radius."""
    config = walk_config(method="ccil", generator_steps=1)

    def moved(max_kl: jax.Array) -> jax.Array:
        agent = ccil_jax.make_agent(config.replace(max_kl=max_kl), Walk(), walk_demonstrations())
        state, _ = agent.step(agent.init(jax.random.key(0)))
        return state.actor.policy_params["log_std"][0]

    with quick_compilation(), jax.enable_x64(True):
        radius, small = jnp.asarray(0.02), 1e-5
        _, slope = jax.jit(lambda x: jax.jvp(moved, (x,), (jnp.ones_like(x),)))(radius)
        difference = (jax.jit(moved)(radius + small) - jax.jit(moved)(radius - small)) / (2 * small)
    assert abs(float(slope)) > 1e-3
    np.testing.assert_allclose(slope, difference, rtol=1e-4)


def test_optimizer_and_critic_of_a_users_own_are_used() -> None:
    """Plain gradient steps of size 0 leave the critics as they began."""
    config = walk_config(method="gail")
    critic = ccil_jax.Network(init=lambda key: jnp.ones(2), apply=lambda params, obs: obs[..., 0] * params[0])
    agent = ccil_jax.make_agent(
        config, Walk(), walk_demonstrations(), critic=critic, optimizer=lambda learning_rate: optax.sgd(0.0)
    )
    with quick_compilation():
        state, _ = jax.jit(agent.step)(jax.jit(agent.init)(jax.random.key(0)))
    np.testing.assert_array_equal(state.critics.params, np.ones((2, 2)))


@pytest.mark.parametrize(
    ("method", "parts", "message"),
    [
        ("bc", {"constraint": ccil_jax.Constraint()}, "constraint: makes no difference to method bc; leave it out"),
        ("iq_learn", {"reward_model": ccil_jax.RewardModel(lambda state, t: t.reward)}, "reward_model: makes no"),
        ("gail", {"constraint": ccil_jax.Constraint()}, "constraint: method gail has no cost limit to keep; use ccil"),
    ],
)
def test_parts_without_effect_are_refused(method: str, parts: dict[str, Any], message: str) -> None:
    config = walk_config(method=method, **({"cloning_updates": 100} if method == "bc" else {}))
    with pytest.raises(ConfigError, match=message):
        ccil_jax.make_agent(config, Walk(), walk_demonstrations(), **parts)


def test_a_row_whose_part_is_unknown_is_refused_before_anything_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(_methods, "odd", Method(reward="discriminator", constraint="pit", limit="demonstrations"))
    with pytest.raises(ConfigError, match="constraint 'pit': unknown; did you mean pid"):
        ccil_jax.make_agent(walk_config(method="ccil").replace(method="odd"), Walk(), walk_demonstrations())


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("ccil", Walk(), None), "config: is of type str; give a ccil_jax.Config"),
        ((walk_config(method="ccil"), "Swimmer", None), "env: is 'Swimmer'; give an environment, such as"),
        ((walk_config(method="ccil"), Walk, None), "env: is <class .*Walk'>; give an environment, such as"),
        ((walk_config(method="ccil"), Walk(), "file.npz"), "demonstrations: is of type str; give what"),
    ],
)
def test_names_are_not_what_they_name(given: Any, message: str) -> None:
    for function in (ccil_jax.make_agent, ccil_jax.train):
        with pytest.raises(ConfigError, match=message):
            function(*given)


def test_a_metric_named_like_a_column_is_refused() -> None:
    """A run's table would have the column twice."""
    constraint = ccil_jax.Constraint(update=lambda state, cost_gap, outer: (state, {"seed": cost_gap}))
    own = Method(reward="discriminator", constraint=lambda config: constraint, limit="demonstrations")
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(_methods, "own", own)
        with pytest.raises(ConfigError, match="metric 'seed': is a column of every run's own"):
            ccil_jax.train(walk_config(method="ccil").replace(method="own"), Walk(), walk_demonstrations())


def test_a_reward_of_another_shape_is_refused() -> None:
    """NumPy's rules would repeat one number along the batch."""
    model = ccil_jax.RewardModel(lambda state, transition: jnp.mean(transition.obs))
    agent = ccil_jax.make_agent(walk_config(method="gail"), Walk(), walk_demonstrations(), reward_model=model)
    with pytest.raises(ConfigError, match=r"reward: returned an array of shape \(\); return one reward for each step"):
        agent.step(agent.init(jax.random.key(0)))


ZERO = jnp.zeros(())


def gaussian(**leaves: Any) -> ccil_jax.Policy:
    def apply(params: Any, obs: jax.Array) -> Gaussian:
        return Gaussian(**{"mean": obs[..., :1], "log_std": ZERO} | leaves)

    return ccil_jax.Policy(lambda key: ZERO, apply)


def trace(method: str, **parts: Any) -> None:
    """One iteration of an agent with these parts, without computing anything."""
    agent = ccil_jax.make_agent(walk_config(method=method), Walk(), walk_demonstrations(), **parts)
    jax.eval_shape(lambda key: agent.step(agent.init(key)), jax.random.key(0))


def constraint(**functions: Any) -> ccil_jax.Constraint:
    return ccil_jax.Constraint(init=lambda: ZERO)._replace(**functions)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"constraint": lambda config: None}, "constraint: is of type function; give a ccil_jax.Constraint"),
        ({"constraint": constraint(multiplier=lambda state: jnp.zeros(2))}, r"multiplier: returned .*\(2,\); return l"),
        ({"constraint": constraint(gate=lambda *_: ZERO)}, r"gate: returned an array of shape \(\)"),
        ({"constraint": constraint(combine=lambda *_: jnp.zeros(3))}, r"combine: returned an array of shape \(3,\)"),
        ({"constraint": constraint(combine=lambda *_: (1.0, 0.0))}, "combine: returned tuple"),
        ({"constraint": constraint(combine=lambda state: ZERO)}, "combine: calling it raised TypeError: .*but 3 were"),
        ({"constraint": constraint(combine=lambda *_: [][0])}, r"test_extending.py, line \d+, raised IndexError: list"),
        ({"constraint": constraint(update=lambda state, *_: state)}, "update: returned an array; return the new state"),
        ({"constraint": constraint(update=lambda *_: (jnp.zeros(2), {}))}, r"it is float32\[2\], not float32\[\]"),
        ({"constraint": constraint(update=lambda *_: ((), {}))}, "its parts have other names"),
        ({"constraint": constraint(update=lambda s, *_: (s, {"m": jnp.ones(2)}))}, "metric 'm': returned an array of"),
        ({"constraint": constraint(update=lambda s, *_: (s, {"kl": s}))}, "constraint.update: metric 'kl' is there"),
        ({"policy": gaussian(mean=jnp.zeros(2))}, r"mean: returned an array of shape \(2,\)"),
        ({"policy": gaussian(log_std=jnp.zeros((4, 1)))}, "log-deviations that are the same in every state"),
        ({"policy": (lambda key: ZERO, 0)}, "policy: is of type tuple; give a ccil_jax.Policy"),
        ({"critic": ccil_jax.Network(lambda key: ZERO, lambda params, obs: obs)}, "critic.apply: returned an array of"),
        ({"optimizer": optax.adam(1.0)}, "optimizer: calling it raised TypeError: .* not callable"),
        ({"optimizer": lambda learning_rate: None}, "optimizer: returned NoneType; return an optax.Gradient"),
    ],
)
def test_what_a_part_returns_is_checked(part: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trace("ccil", **part)


def test_an_actor_is_played_with_its_own_policy() -> None:
    """The parameters of another network would end in an error from deep within the method's own."""
    config, policy = walk_config(method="gail"), gaussian(log_std=jnp.zeros(1))
    agent = ccil_jax.make_agent(config, Walk(), walk_demonstrations(), policy=policy)
    actor = jax.vmap(agent.init)(jax.random.split(jax.random.key(0), 2)).actor
    assert ccil_jax.evaluate(config, actor, Walk(), num_episodes=1, policy=policy).episode_return.shape == (2, 1)
    with pytest.raises(ConfigError, match=r"actor: .* are not those of the policy of gail .*; give the `policy` that"):
        ccil_jax.evaluate(config, actor, Walk(), num_episodes=1)
    with pytest.raises(ConfigError, match=r"it is float32\[2\], not float32\[\]"):
        ccil_jax.record(config, jax.tree.map(lambda leaf: leaf[:2], actor), Walk(), num_episodes=1, policy=policy)


def test_iq_learn_takes_a_squashed_policy_only() -> None:
    """A `Gaussian` has no bounded actions, whose densities its updates need."""
    policy = ccil_jax.Policy(lambda key: ZERO, lambda params, obs: Gaussian(mean=obs, log_std=ZERO))
    with pytest.raises(ConfigError, match="returned Gaussian; return a TanhGaussian"):
        trace("iq_learn", policy=policy)


@pytest.mark.parametrize(
    ("name", "method", "message"),
    [
        ("ccil", Method(reward="task", constraint="pid", limit="prescribed"), "method ccil: is registered already"),
        ("a b", Method(reward="task", constraint="pid", limit="prescribed"), "method 'a b': not an identifier"),
        ("x", Method(reward="task"), "method x: an on-policy method needs a reward and a constraint"),
        ("x", Method(reward="task", constraint="pid", limit="mine"), "limit 'mine': give 'demonstrations', 'pre"),  # type: ignore[arg-type]
        ("x", Method(reward="task", constraint="pid", limit="demonstrations", imitates=False), "no demonstrations to"),
        ("x", "ccil", "method x: is of type str"),
        ("x", Method(agent="on_polcy"), "agent 'on_polcy': unknown; did you mean on_policy"),
        ("x", Method(reward="tsk", constraint="unconstrained"), "reward 'tsk': unknown; did you mean task"),
        ("x", Method(agent="behavior_cloning", preset="bcc"), "preset 'bcc': unknown; choose one of"),
        ("x", Method(agent="iq_learn"), "agent iq_learn has no gaussian policy; give 'squashed'"),
        ("x", Method(agent="behavior_cloning", reward="task"), "reward makes no difference to agent behavior_cloning"),
        ("x", Method(agent="behavior_cloning", imitates=False), "learns from demonstrations; let imitates be True"),
        ("x", Method(reward="task", constraint="pid"), "its constraint needs a limit"),
        ("x", Method(reward="task", constraint="pid", limit="prescribed"), "let has_multiplier be True"),
    ],
)
def test_rows_that_mean_nothing_are_refused(name: str, method: Method, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ccil_jax.register_method(name, method)


def test_the_rows_of_the_package_name_all_that_the_tables_have() -> None:
    """The names that a row of the user's own may have are read from them; see `methods._checked`."""
    tables = {"agent": AGENTS, "reward": REWARD_MODELS, "constraint": CONSTRAINTS, "policy": POLICIES}
    for row in _BUILT_IN:
        _checked("built_in", row)
    for column, table in tables.items():
        # A configuration chooses between the rewards of a row with a discriminator.
        chosen = set(CHOICES["imitation_reward"]) if column == "reward" else set()
        assert {getattr(row, column) for row in _BUILT_IN} - {None} | chosen == set(table)


def test_the_rule_of_the_page_is_an_option_of_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: dict[str, Any]
) -> None:
    """The rule and its row in a file, as the page says; other rules of the multiplier are no option of this method."""
    found = {key: block for block in BLOCKS for key in ("def leaky", "LEAKY = ") if key in block}
    rule, row = found["def leaky"].partition("\n\nagent =")[0], found["LEAKY = "]
    (tmp_path / "my_methods.py").write_text(f"import jax.numpy as jnp\nimport ccil_jax\n{rule}\n{row}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    given = ["--method", "my_methods:LEAKY", "--env", "Swimmer", "--initial-multiplier", "0.1", "--out", "run"]
    try:
        config = train.make_plan(train.make_parser().parse_args(given)).config
        maker: Any = config.row.constraint
        built = maker(config)
        assert built.multiplier(built.init()) == np.float32(0.1)
        with pytest.raises(ConfigError, match="multiplier_update adam: makes no difference to this run of method my_m"):
            train.make_plan(train.make_parser().parse_args([*given, "--multiplier-update", "adam"]))
        assert ccil_jax.Config.from_preset("default", method="ccil").initial_multiplier == 0  # as the page says
    finally:
        _methods.pop("my_methods:LEAKY", None)
        sys.modules.pop("my_methods", None)


def test_a_method_is_found_by_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_methods.py").write_text(
        "from ccil_jax import Method\n"
        "SAFE = Method(reward='discriminator', constraint='pid', limit='demonstrations', has_multiplier=True)\n"
        "TEXT = 'pid'\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    kept = dict(_methods)
    try:
        assert ccil_jax.Config(method="my_methods:SAFE").row.constraint == "pid"
        assert ccil_jax.Config(method="my_methods:SAFE").reads("pid_smoothing")
        for name, message in (
            ("my_methods:SAVE", "has no attribute 'SAVE'; did you mean SAFE"),
            ("my_method:SAFE", "there is no module 'my_method'"),
            ("my_methods:TEXT", "is of type str; name a ccil_jax.Method"),
            ("malmm", "'malmm': unknown; did you mean malm"),
        ):
            with pytest.raises(ConfigError, match=message) as refused:
                validate(ccil_jax.Config(method=name))
            assert refused.value.on_command_line().startswith("--method ")
    finally:
        _methods.clear()
        _methods.update(kept)
        sys.modules.pop("my_methods", None)
