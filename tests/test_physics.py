"""The physics backends: bits, purity, vmapping, divergence, and MJX against C MuJoCo."""

import errno
import importlib.util
import os
import subprocess
import sys
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import mujoco
import numba
import numpy as np
import pytest
from numba.core import caching

from envs.jax_tools import full_precision
from envs.locomotion import load_model
from envs.physics import foreign, make_physics, resolve
from envs.physics.bits import float64_bits
from envs.physics.mjx import import_mjx
from envs.physics.mjx_patch import searches_that_end
from envs.physics.native import NativePhysics

pytestmark = pytest.mark.once

SUBNORMAL = [1e-38, 1e-45, -1e-45, 1.1754942e-38, 2e-39]  # in float32
SPECIAL = [0.0, -0.0, 1.0, -1.5, 3.1415927, *SUBNORMAL, 3.4e38, -3.4e38, np.inf, -np.inf]

PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0"/>
      <geom size="0.1" pos="0 0 -1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


def test_float64_bits_of_float32_values_are_exact() -> None:
    rng = np.random.default_rng(0)
    patterns = rng.integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    subnormals = rng.integers(1, 2**23, 2_000, dtype=np.uint32).view(np.float32)
    values = np.concatenate([np.array(SPECIAL, np.float32), patterns[~np.isnan(patterns)], subnormals, -subnormals])
    bits = np.asarray(jax.jit(float64_bits)(values))
    assert bits.dtype == np.uint32
    np.testing.assert_array_equal(bits.view(np.uint64), values.astype(np.float64).view(np.uint64))


def test_float64_bits_keep_nan() -> None:
    bits = np.asarray(float64_bits(jnp.array([jnp.nan, 1.0])))
    np.testing.assert_array_equal(bits.view(np.float64), [np.nan, 1.0])


def test_float64_bits_with_x64() -> None:
    with jax.enable_x64(True):
        values = np.array([*SPECIAL, np.pi, 1e-300, 5e-324])
        bits = np.asarray(float64_bits(jnp.asarray(values)))
    np.testing.assert_array_equal(bits.view(np.uint64), values.view(np.uint64))


@pytest.fixture(scope="module")
def cheetah() -> NativePhysics:
    physics = make_physics("native", load_model("half_cheetah.xml"), num_substeps=5, track=["qpos"])
    assert isinstance(physics, NativePhysics)
    return physics


def starts(num: int, size: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    qpos = rng.uniform(-0.1, 0.1, (num, size)).astype(np.float32)
    qvel = rng.uniform(-1, 1, (num, size)).astype(np.float32)
    return qpos, qvel, rng.uniform(-1, 1, (num, 6)).astype(np.float32)


def test_step_has_no_hidden_state(cheetah: NativePhysics) -> None:
    """The engine serves other simulations in between: their warm starts must not leak in."""
    qpos, qvel, ctrl = starts(8, 9)
    step = jax.jit(jax.vmap(cheetah.step))
    data = step(jax.vmap(cheetah.init)(qpos, qvel), ctrl)
    first = step(data, ctrl)
    step(jax.tree.map(lambda x: x[::-1], data), -ctrl)
    chex.assert_trees_all_equal(first, step(data, ctrl))


def test_vmap_over_seeds_and_simulations_equals_single(cheetah: NativePhysics) -> None:
    qpos, qvel, ctrl = starts(6, 9)

    def steps(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> object:
        data = cheetah.init(qpos, qvel)
        return jax.lax.scan(lambda data, _: (cheetah.step(data, ctrl),) * 2, data, None, length=7)[1]

    nested = jax.jit(jax.vmap(jax.vmap(steps)))(*(x.reshape(2, 3, -1) for x in (qpos, qvel, ctrl)))
    single = [jax.jit(steps)(qpos[i], qvel[i], ctrl[i]) for i in range(6)]
    stacked = jax.tree.map(lambda *x: np.stack(x).reshape(2, 3, *x[0].shape), *single)
    chex.assert_trees_all_equal(nested, stacked)


def test_results_do_not_depend_on_the_number_of_threads(cheetah: NativePhysics) -> None:
    serial = make_physics("native", load_model("half_cheetah.xml"), num_substeps=5, track=["qpos"], num_threads=1)
    qpos, qvel, ctrl = starts(16, 9)
    results = [jax.vmap(p.step)(jax.vmap(p.init)(qpos, qvel), ctrl) for p in (cheetah, serial)]
    chex.assert_trees_all_equal(*results)


def test_step_with_a_constant_control_under_vmap(cheetah: NativePhysics) -> None:
    """`broadcast_all`: arguments without the mapped axis are tiled."""
    qpos, qvel, ctrl = starts(4, 9)
    data = jax.vmap(cheetah.init)(qpos, qvel)
    shared = jax.vmap(cheetah.step, in_axes=(0, None))(data, ctrl[0])
    tiled = jax.vmap(cheetah.step)(data, np.tile(ctrl[0], (4, 1)))
    chex.assert_trees_all_equal(shared, tiled)


def test_change_keeps_its_precision_far_from_the_origin(cheetah: NativePhysics) -> None:
    """At x = 1,000 m float32 positions are 6e-5 m apart; the displacement must not be."""
    qpos, qvel, ctrl = starts(1, 9)
    far = qpos.copy()
    far[:, 0] = 1000.0
    qpos[:, 0] = 0.0
    near_step, far_step = (
        jax.vmap(cheetah.step)(jax.vmap(cheetah.init)(q, qvel), ctrl).change["qpos"] for q in (qpos, far)
    )
    np.testing.assert_allclose(far_step, near_step, rtol=1e-5, atol=1e-9)


def test_init_calls_no_engine_unless_derived_arrays_are_asked_for(cheetah: NativePhysics) -> None:
    arguments = jnp.zeros(9), jnp.zeros(9)
    assert "ffi_call" not in str(jax.make_jaxpr(cheetah.init)(*arguments))
    derived = make_physics("native", load_model("half_cheetah.xml"), num_substeps=5, fields=["xpos"])
    assert "ffi_call" in str(jax.make_jaxpr(derived.init)(*arguments))


def test_both_kinds_of_call_agree(cheetah: NativePhysics, monkeypatch: pytest.MonkeyPatch) -> None:
    """On an accelerator the arguments come by value, through `jax.pure_callback`."""
    qpos, qvel, ctrl = starts(6, 9)

    def step(qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array) -> object:
        return cheetah.step(cheetah.init(qpos, qvel), ctrl)

    arguments = [x.reshape(2, 3, -1) for x in (qpos, qvel, ctrl)]
    by_xla = jax.jit(jax.vmap(jax.vmap(step)))(*arguments)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "pure_callback" in str(jax.make_jaxpr(jax.vmap(step))(qpos, qvel, ctrl))
    by_value = jax.jit(jax.vmap(jax.vmap(lambda *x: step(*x))))(*arguments)
    chex.assert_trees_all_equal(by_xla, by_value)


def test_more_sizes_of_batches_than_an_engine_keeps(cheetah: NativePhysics) -> None:
    """Those that are idle make room, and the results do not depend on it."""
    qpos, qvel, ctrl = starts(foreign.POOL_SIZE + 3, 9)
    bits = np.asarray(jax.vmap(cheetah.init)(qpos, qvel).backend)
    engine, ctrl = cheetah._engine, ctrl.astype(np.float32)
    together = engine._on_host(False, bits, ctrl)
    for _ in range(2):
        for size in range(1, len(bits)):
            alone = engine._on_host(False, bits[:size], ctrl[:size])
            np.testing.assert_array_equal(alone[0], together[0][:size])
            np.testing.assert_array_equal(alone[1], together[1][:size])


def test_programs_on_several_threads_share_an_engine(cheetah: NativePhysics) -> None:
    """Each call has a batch of its own, whatever the others do meanwhile."""
    qpos, qvel, ctrl = starts(8, 9)
    data = jax.vmap(cheetah.init)(qpos, qvel)

    @jax.jit
    def walk(data: object, scale: float) -> object:
        return jax.lax.scan(lambda d, _: (jax.vmap(cheetah.step)(d, ctrl * scale), None), data, None, 200)[0]

    scales = [0.1 * i for i in range(8)]
    expected = [walk(data, scale) for scale in scales]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda scale: jax.block_until_ready(walk(data, scale)), scales))
    chex.assert_trees_all_equal(found, expected)


CACHED = """
import sys, jax, envs
hits = []
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event))
env = envs.make(sys.argv[2])
keys = jax.random.split(jax.random.key(0), 3)
start = jax.jit(jax.vmap(env.reset))(keys)
hits.clear()
state = jax.jit(jax.vmap(lambda s: env.step(s, jax.numpy.ones(env.action_dim) / 3)))(start)
print(hits.count("/jax/compilation_cache/cache_hits"), jax.device_get(state.obs).tobytes().hex())
"""


@pytest.mark.parametrize("task", ["Swimmer", "PointGoal1"])
def test_a_program_with_physics_is_kept_for_the_next_process(task: str, tmp_path: Path) -> None:
    """No address of this process is in it: another finds it in the cache, and gets the same numbers."""
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "true"}
    command = [sys.executable, "-c", CACHED, str(tmp_path), task]
    runs = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert runs[0][0] == "0"
    assert int(runs[1][0]) >= 1
    assert runs[0][1] == runs[1][1]


def test_native_with_x64(cheetah: NativePhysics) -> None:
    """The state's bits are the same; the values that the program sees are wider."""
    qpos, qvel, ctrl = (x[0] for x in starts(1, 9))
    single = cheetah.step(cheetah.init(qpos, qvel), ctrl)
    with jax.enable_x64(True):
        double = cheetah.step(cheetah.init(qpos, qvel), ctrl)
    assert double.qpos.dtype == double.change["qpos"].dtype == np.float64
    np.testing.assert_array_equal(single.backend, double.backend)
    np.testing.assert_array_equal(single.qpos, double.qpos.astype(np.float32))


@pytest.mark.parametrize("field", ["xpos", "cfrc_ext"])  # with and without the post-constraint pass
def test_derived_fields_are_those_of_c_mujoco(field: str) -> None:
    model = load_model("half_cheetah.xml")
    physics = make_physics("native", model, num_substeps=5, fields=[field, "cvel"], track=["xipos"])
    qpos, qvel, ctrl = starts(3, 9)
    data = jax.vmap(physics.init)(qpos, qvel)
    after = jax.vmap(physics.step)(data, ctrl)
    reference = mujoco.MjData(model)
    for i in range(3):
        mujoco.mj_resetData(model, reference)
        reference.qpos, reference.qvel, reference.ctrl = qpos[i], qvel[i], ctrl[i]
        mujoco.mj_forward(model, reference)
        np.testing.assert_array_equal(data.fields[field][i], getattr(reference, field).astype(np.float32))
        before = reference.xipos.copy()
        mujoco.mj_step(model, reference, 5)
        mujoco.mj_rnePostConstraint(model, reference)
        for name in (field, "cvel"):
            np.testing.assert_array_equal(after.fields[name][i], getattr(reference, name).astype(np.float32))
        np.testing.assert_array_equal(after.change["xipos"][i], (reference.xipos - before).astype(np.float32))


@pytest.mark.parametrize("fields", [[], ["cfrc_ext"]])  # with and without the post-constraint pass
def test_divergence_gives_nan_and_spares_the_neighbours(
    fields: list[str], tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(str(tmp_path))  # MuJoCo writes its warning to a log file in the working directory
    physics = make_physics("native", load_model("half_cheetah.xml"), num_substeps=5, fields=fields)
    qpos, qvel, ctrl = starts(3, 9)
    good = jax.vmap(physics.step)(jax.vmap(physics.init)(qpos, qvel), ctrl)
    wrong = qvel.copy()
    wrong[1, 2] = 1e20
    after = jax.vmap(physics.step)(jax.vmap(physics.init)(qpos, wrong), ctrl)
    again = jax.vmap(physics.step)(after, ctrl)
    others = np.array([0, 2])
    assert np.isnan(after.qpos[1]).all()
    assert np.isnan(after.qvel[1]).all()
    np.testing.assert_array_equal(after.qpos[others], good.qpos[others])
    assert np.isnan(again.qpos[1]).all()
    assert np.isfinite(again.qpos[others]).all()


def test_mjx_equals_c_on_a_pendulum_and_scans() -> None:
    """A small model, so that each run of the tests compiles MJX once: interface, tracking, and stable scan types."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    results = []
    for name in ("native", "mjx"):
        physics = make_physics(name, model, num_substeps=3, fields=["xpos"], track=["qpos", "xipos"])

        def run(qpos: jax.Array, ctrl: jax.Array, physics: Any = physics) -> object:
            data = physics.init(qpos, jnp.zeros(1))
            return jax.lax.scan(lambda data, u: (physics.step(data, u),) * 2, data, ctrl)[1]

        data = jax.jit(jax.vmap(run))(np.array([[0.3], [-2.0]], np.float32), np.linspace(-1, 1, 40).reshape(2, 20, 1))
        results.append(
            {"qpos": data.qpos, "qvel": data.qvel, **data.fields, **{"d" + k: v for k, v in data.change.items()}}
        )
    chex.assert_trees_all_close(*results, rtol=1e-4, atol=1e-5)


def test_mjx_step_is_differentiable() -> None:
    physics = make_physics("mjx", mujoco.MjModel.from_xml_string(PENDULUM), num_substeps=1)

    def height(ctrl: jax.Array) -> jax.Array:
        return physics.step(physics.init(jnp.array([0.3]), jnp.zeros(1)), ctrl).qvel.sum()

    gradient = jax.jacfwd(height)(jnp.zeros(1))
    assert np.isfinite(gradient).all()
    assert gradient[0] != 0.0


BOUNCE = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body pos="0 0 0.3">
      <freejoint/>
      <geom type="capsule" size="0.1 0.2" zaxis="0.5 0 1"/>
      <body pos="0.3 0 0">
        <joint name="hinge" axis="0 1 0" range="-30 30" limited="true"/>
        <geom type="capsule" size="0.05 0.2" zaxis="1 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def test_line_searches_that_end_compute_the_same_bits() -> None:
    """Against MJX's own, which take all the turns allowed: eight capsules fall, slide and bend to a hinge's limit."""
    mjx, model = import_mjx(), mujoco.MjModel.from_xml_string(BOUNCE)
    device_model, data = mjx.put_model(model), mjx.make_data(model)

    def run(qpos: jax.Array) -> jax.Array:
        def step(data: Any, _: None) -> tuple[Any, jax.Array]:
            new = mjx.step(device_model, data)
            return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), new, data), new.qvel

        return jax.lax.scan(step, jax.tree.map(jnp.asarray, data.replace(qpos=qpos, ctrl=jnp.ones(1))), None, 60)[1]

    starts = np.zeros((8, 8), np.float32)
    starts[:, 2], starts[:, 3], starts[:, 7] = np.linspace(0.1, 0.5, 8), 1.0, np.linspace(-0.4, 0.4, 8)
    with searches_that_end():
        ending = str(jax.make_jaxpr(lambda qpos: run(qpos))(starts[0]))
        speeds = np.asarray(jax.jit(jax.vmap(lambda qpos: run(qpos)))(starts))
    full = str(jax.make_jaxpr(run)(starts[0]))  # other code's MJX is as it was
    wanted = np.asarray(jax.jit(jax.vmap(run))(starts))
    assert np.abs(np.diff(wanted, axis=1)).max() > 0.1, "nothing happens"
    np.testing.assert_array_equal(speeds.view(np.uint32), wanted.view(np.uint32))

    physics = make_physics("mjx", model, num_substeps=2)
    ours = str(jax.make_jaxpr(lambda qpos: physics.step(physics.init(qpos, jnp.zeros(7)), jnp.ones(1)))(starts[0]))
    assert f"length={model.opt.ls_iterations}" in full
    assert f"length={model.opt.ls_iterations}" not in ending
    assert f"length={model.opt.ls_iterations}" not in ours


def test_products_are_of_full_precision_whatever_the_default() -> None:
    """A TPU's and an NVIDIA GPU's is not float32's."""
    x = jnp.ones((2, 2))
    assert "HIGHEST" not in str(jax.make_jaxpr(jnp.matmul)(x, x))
    assert "HIGHEST" in str(jax.make_jaxpr(full_precision(jnp.matmul))(x, x))
    model = mujoco.MjModel.from_xml_string(BOUNCE)
    physics = make_physics("mjx", model, num_substeps=1)
    step = str(jax.make_jaxpr(lambda qpos: physics.step(physics.init(qpos, jnp.zeros(7)), jnp.ones(1)))(model.qpos0))
    assert step.count("dot_general") == step.count("precision=(Precision.HIGHEST") > 10


def test_mjx_table_has_the_routine_that_the_correction_replaces() -> None:
    """The correction touches a private table: this fails when an update of MJX moves or replaces the entry."""
    program = (
        "from envs.physics.mjx import import_mjx\n"
        "import_mjx()\n"
        "from mujoco.mjx._src import collision_driver, collision_primitive, types\n"
        "pair = (types.GeomType.PLANE, types.GeomType.CAPSULE)\n"
        "assert collision_driver._COLLISION_FUNC[pair] is collision_primitive.plane_capsule\n"
        "from envs.physics.mjx_patch import align_plane_capsule_frames\n"
        "align_plane_capsule_frames(); align_plane_capsule_frames()\n"
        "assert collision_driver._COLLISION_FUNC[pair].aligned and collision_driver._COLLISION_FUNC[pair].ncon == 2\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "Failed to import" not in done.stdout


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.3, 0.1, 0.95), (0.9, -0.2, 0.1), (1e-4, 0.0, 1.0)])
def test_corrected_plane_capsule_frame_is_cs(axis: tuple[float, float, float]) -> None:
    from envs.physics.mjx import import_mjx
    from envs.physics.mjx_patch import _plane_capsule

    import_mjx()
    from mujoco.mjx._src.collision_types import GeomInfo

    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body pos='0 0 .25'><freejoint/>"
        f"<geom type='capsule' size='.1 .2' zaxis='{axis[0]} {axis[1]} {axis[2]}'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[2] = -0.3  # both ends touch, whatever the axis
    mujoco.mj_forward(model, data)
    infos = [GeomInfo(data.geom_xpos[i], data.geom_xmat[i].reshape(3, 3), model.geom_size[i]) for i in (0, 1)]
    distance, position, frame = _plane_capsule(*infos)
    order = np.argsort(np.asarray(distance))
    wanted = np.argsort(data.contact.dist)
    np.testing.assert_allclose(distance[order], data.contact.dist[wanted], atol=1e-6)
    np.testing.assert_allclose(position[order], data.contact.pos[wanted], atol=1e-6)
    frames = data.contact.frame[wanted].reshape(-1, 3, 3)
    if axis != (0.0, 0.0, 1.0):  # a vertical capsule has no direction to align with: any tangent is as good
        np.testing.assert_allclose(frame[order], frames, atol=1e-4)


def test_unknown_physics_is_refused() -> None:
    with pytest.raises(ValueError, match="native, mjx, warp"):
        make_physics("bullet", mujoco.MjModel.from_xml_string(PENDULUM), num_substeps=1)


@pytest.mark.parametrize(
    ("backend", "kind", "installed", "chosen"),
    [
        ("cpu", "cpu", True, "native"),
        ("gpu", "NVIDIA H200", True, "warp"),
        ("gpu", "NVIDIA H200", False, "mjx"),
        ("gpu", "AMD Instinct MI300X", True, "mjx"),
        ("tpu", "TPU v5", True, "mjx"),
    ],
)
def test_auto_is_the_fastest_that_the_machine_can_do(
    backend: str, kind: str, installed: bool, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "devices", lambda: [types.SimpleNamespace(device_kind=kind)])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if installed else None)
    assert resolve("auto") == chosen
    assert resolve("mjx") == "mjx"


def test_warp_has_room_for_all_that_the_tasks_need() -> None:
    """Rows of constraints for each simulation, contacts for all: beyond them it would drop some."""
    physics = make_physics("warp", load_model("half_cheetah.xml"), num_substeps=1)
    assert physics._template._impl.efc__J.shape[0] >= 70
    assert physics._template._impl.naconmax == 2**15


def test_warp_without_its_package_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"mujoco-mjx\[warp\]"):
        make_physics("warp", mujoco.MjModel.from_xml_string(PENDULUM), num_substeps=1)


def test_importing_envs_imports_neither_jax_nor_an_engine() -> None:
    program = "import sys, envs; bad = {'jax', 'mujoco', 'gymnasium', 'brax'} & set(sys.modules); assert not bad, bad"
    subprocess.run([sys.executable, "-c", program], check=True)


# Numba's files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["no folder", "no room"])
def test_code_is_compiled_where_it_cannot_be_kept(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if fault == "no folder":
        monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
        monkeypatch.setattr(numba.config, "CACHE_LOCATOR_CLASSES", "")
    else:
        monkeypatch.setattr(caching.IndexDataCacheFile, "load", fail)
        monkeypatch.setattr(caching.IndexDataCacheFile, "save", fail)

    @foreign._compiled
    def double(x: Any) -> Any:
        return 2 * x

    @foreign._called_by_c(numba.types.int64(numba.types.int64))
    def double_and_one(x: Any) -> Any:
        return double(x) + 1

    assert double(4) == 8
    assert double_and_one.ctypes(4) == 9
