"""MJX, MuJoCo in JAX: runs on accelerators, and is differentiable. `impl="warp"` is its variant for NVIDIA's GPUs."""

import contextlib
import copy
import importlib
import importlib.util
import io
import sys
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from flax import struct
from jax.typing import ArrayLike

from envs.jax_tools import full_precision, usual_rules
from envs.physics.base import Data, Mocap
from envs.physics.mjx_patch import align_plane_capsule_frames, searches_that_end

# The room that MJX-Warp sets aside. Contacts that do not fit in are dropped, with a message. The contacts are those of
# all simulations together: there are 16 for each of 65,536 simulations, and fewer on a CPU, where Warp is for tests
# only, because every step copies them. The rows of constraints are those of each simulation.
_WARP_CONTACTS_ON_CPU, _WARP_CONTACTS = 2**15, 2**20
_WARP_ROWS = 512


@struct.dataclass(kw_only=True)
class _Carry:
    """What MJX needs to continue. The next step computes everything else in MJX's `Data` from these."""

    qpos: jax.Array  # [nq]
    qvel: jax.Array  # [nv]
    qacc_warmstart: jax.Array  # [nv]
    tracked: dict[str, jax.Array]  # derived quantities after the last control step


class MjxPhysics:
    """See `Physics`. For models whose actuators have no activations and no history.

    The solver is that which the model names, except for PGS (Humanoid), which MJX lacks. There Newton takes its place,
    and the velocity after a step differs by 4e-10 (median). The native engine keeps PGS, as gymnasium does.

    Building one corrects MJX's contacts of planes and capsules for the whole process; see `mjx_patch.py`.

    Args:
        model: any model that MJX loads.
        num_substeps: engine steps per control step.
        fields: derived `MjData` arrays for `Data.fields`. If there are any, or derived arrays in `track`, `init` runs
            the forward pass.
        track: `MjData` arrays for `Data.change`; in float32 unless x64 is enabled.
        refresh: whether a control step ends with a forward pass.
        impl: "jax" or "warp". With Warp, repeating a step may give other bits.

    Raises:
        ImportError: impl "warp" without the package warp.
        ValueError: a field that the implementation does not compute.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_substeps: int,
        *,
        fields: Sequence[str] = (),
        track: Sequence[str] = (),
        refresh: bool = False,
        impl: str = "jax",
    ):
        self.name = "mjx" if impl == "jax" else impl
        if impl == "warp" and importlib.util.find_spec("warp") is None:
            raise ImportError("physics 'warp' needs the package warp: pip install 'mujoco-mjx[warp]'")
        self._mjx = mjx = import_mjx()
        align_plane_capsule_frames()
        if impl == "warp":
            from envs.physics import warp_patch

            warp_patch.align_plane_capsule_frames()
            warp_patch.say_less()
        if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
            model = copy.copy(model)
            model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        self._model, limits = mjx.put_model(model, impl=impl), {}
        forces = "cfrc_ext" in fields
        if impl == "warp":
            limits = _warp_limits(mjx.make_data(model, impl="jax"))
            # Warp computes contact forces either in every forward pass or in none.
            self._model = self._model.tree_replace({"opt._impl.run_rne_postconstraint": forces})
        self._forces_after_step = forces and impl == "jax"
        # All types become strong: MJX's `time` is weakly typed, and so JAX would trace every scan over it twice.
        self._template = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), mjx.make_data(model, impl=impl, **limits))
        self._num_substeps = num_substeps
        self._refresh = refresh
        self._fields, self._track = tuple(fields), tuple(track)
        self._derived = tuple(dict.fromkeys(n for n in (*fields, *track) if n not in ("qpos", "qvel")))

    @usual_rules
    @full_precision
    @searches_that_end()
    def init(self, qpos: ArrayLike, qvel: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.init`."""
        template = self._template if mocap is None else _place(self._template, mocap.pos, mocap.quat)
        data = template.replace(
            qpos=jnp.asarray(qpos, template.qpos.dtype), qvel=jnp.asarray(qvel, template.qvel.dtype)
        )
        if self._derived:
            # Warp's forward pass normalises the quaternions in `qpos`, but that of C MuJoCo does not change them.
            data = self._mjx.forward(self._model, data).replace(qpos=data.qpos)
        return self._pack(data, {n: jnp.zeros_like(read(data, n)) for n in self._track})

    @usual_rules
    @full_precision
    @searches_that_end()
    def step(self, data: Data, ctrl: ArrayLike, mocap: Mocap | None = None) -> Data:
        """See `Physics.step`."""
        carry = data.backend
        before = carry.tracked | {"qpos": carry.qpos, "qvel": carry.qvel}
        state = self._template.replace(
            qpos=carry.qpos,
            qvel=carry.qvel,
            qacc_warmstart=carry.qacc_warmstart,
            ctrl=jnp.asarray(ctrl, self._template.ctrl.dtype),
        )

        path = None
        if mocap is not None:
            path = mocap.pos if mocap.pos.ndim == 3 else None
            state = _place(state, mocap.pos if path is None else path[0], mocap.quat)

        def substep(state: Any, pos: jax.Array | None) -> tuple[Any, None]:
            new = self._mjx.step(self._model, state if pos is None else _place(state, pos))
            # A scan's carry must keep its types, but with x64 MJX 3.17 changes the integer types of tendon arrays.
            return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), new, state), None

        state, _ = jax.lax.scan(substep, state, path, length=self._num_substeps)
        if self._refresh:
            state = self._mjx.forward(self._model, state)
        if self._forces_after_step:
            state = self._mjx.rne_postconstraint(self._model, state)
        return self._pack(state, {n: read(state, n) - before[n] for n in self._track})

    def _pack(self, data: Any, change: dict[str, jax.Array]) -> Data:
        tracked = {n: read(data, n) for n in self._track if n not in ("qpos", "qvel")}
        return Data(
            qpos=data.qpos,
            qvel=data.qvel,
            fields={n: read(data, n) for n in self._fields},
            change=change,
            backend=_Carry(qpos=data.qpos, qvel=data.qvel, qacc_warmstart=data.qacc_warmstart, tracked=tracked),
        )


def _warp_limits(data: Any) -> dict[str, int]:
    """Arguments of `mjx.make_data` for Warp. `data` is that of MJX-JAX, which has room for all possible constraints."""
    contacts = _WARP_CONTACTS_ON_CPU if jax.default_backend() == "cpu" else _WARP_CONTACTS
    return {"naconmax": contacts, "njmax": min(data._impl.efc_J.shape[0], _WARP_ROWS)}


def _place(data: Any, pos: jax.Array, quat: jax.Array | None = None) -> Any:
    """`data` with its mocap bodies at `pos`, turned to `quat` if given."""
    turned = {} if quat is None else {"mocap_quat": jnp.asarray(quat, data.mocap_quat.dtype)}
    return data.replace(mocap_pos=jnp.asarray(pos, data.mocap_pos.dtype), **turned)


def read(data: Any, name: str) -> jax.Array:
    """An array of `mjx.Data`, from its public part or from the part of the implementation (as cinert and cfrc_ext)."""
    public = any(field.name == name for field in type(data).fields())
    array: jax.Array = getattr(data if public else data._impl, name)
    return array


def import_mjx() -> Any:
    """Imports `mujoco.mjx`, but drops the line that it prints where the optional package warp is missing."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        module = importlib.import_module("mujoco.mjx")
    for line in printed.getvalue().splitlines(keepends=True):
        if not line.startswith("Failed to import"):
            sys.stdout.write(line)
    return module
