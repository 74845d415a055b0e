"""Many C MuJoCo simulations stepped on threads, with one face for the two ways there are."""

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

# Arrays that MuJoCo fills only on demand, by `mj_rnePostConstraint`, which `Batch` does not call.
POST_CONSTRAINT = frozenset({"cacc", "cfrc_int", "cfrc_ext"})

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class Engine(Protocol):
    """The part of `mujoco.batch.Batch` that `NativePhysics` uses."""

    state: np.ndarray  # [num_sims, size of mjSTATE_INTEGRATION] float64; writes are the state at the next call
    status: np.ndarray  # [num_sims] int, nonzero where the last call raised
    warning: np.ndarray  # [num_sims, number of kinds, 2] int: last info, count

    def bind(self, name: str) -> np.ndarray:
        """`[num_sims, ...]`, refreshed by each call."""

    def step(self, *, nstep: int, stage: int = 0) -> None:
        """`nstep` engine steps under constant controls, then the forward pass up to a `mjtStage`."""

    def forward(self) -> None:
        """The forward pass: derived arrays at the present state."""


def make_engine(model: mujoco.MjModel, num_sims: int, num_threads: int, derived: Sequence[str]) -> Engine:
    """An engine whose `bind` knows the `derived` arrays. Steps raise `SimulationError` where MuJoCo raises."""
    if POST_CONSTRAINT.intersection(derived):
        return PostConstraintEngine(model, num_sims, num_threads, derived)
    engine: Engine = Batch(model, num_sims, num_threads)
    for name in derived:
        engine.bind(name)  # before the first call: a derived array is filled only by later calls
    return engine


class PostConstraintEngine:
    """Like `Batch`, with `mj_rnePostConstraint` after each step, as gymnasium does, so that contact forces are there.

    Plain Python threads over the public bindings, which release the interpreter's lock while MuJoCo computes: 80 % of
    `Batch`'s rate for Ant and Humanoid on 4 cores. The lock bounds it at some 50 thousand simulations per second.
    """

    def __init__(self, model: mujoco.MjModel, num_sims: int, num_threads: int, derived: Sequence[str]):
        self._model = model
        self._data = [mujoco.MjData(model) for _ in range(num_threads)]
        self._pool = ThreadPoolExecutor(num_threads)
        self._outputs = {n: np.zeros((num_sims, *np.shape(getattr(self._data[0], n)))) for n in derived}
        self.state = np.zeros((num_sims, mujoco.mj_stateSize(model, _STATE)))
        self.status = np.zeros(num_sims, np.int32)
        self.warning = np.zeros((num_sims, len(self._data[0].warning), 2), np.int32)

    def bind(self, name: str) -> np.ndarray:
        """`[num_sims, ...]`, refreshed by each call."""
        return self._outputs[name]

    def step(self, *, nstep: int, stage: int = 0) -> None:
        """`nstep` engine steps under constant controls, the forward pass if asked for, the post-constraint pass."""

        def advance(data: mujoco.MjData) -> None:
            mujoco.mj_step(self._model, data, nstep)
            if stage:
                mujoco.mj_forward(self._model, data)
            mujoco.mj_rnePostConstraint(self._model, data)

        self._run(advance)

    def forward(self) -> None:
        """The forward pass alone: as after a reset in gymnasium, no contact force is known yet."""

        def forward(data: mujoco.MjData) -> None:
            mujoco.mj_forward(self._model, data)
            for name in POST_CONSTRAINT:
                getattr(data, name)[:] = 0.0

        self._run(forward)

    def _run(self, call: Callable[[mujoco.MjData], None]) -> None:
        self.status[:] = 0
        tickets = itertools.count()  # its next() is atomic: threads draw simulations until none is left
        jobs = [self._pool.submit(self._serve, data, call, tickets) for data in self._data[1:]]
        self._serve(self._data[0], call, tickets)
        for job in jobs:
            job.result()
        if self.status.any():
            raise SimulationError(np.flatnonzero(self.status), "MuJoCo raised", len(self.status))

    def _serve(self, data: mujoco.MjData, call: Callable[[mujoco.MjData], None], tickets: Any) -> None:
        copies = [(getattr(data, name), rows) for name, rows in self._outputs.items()]
        counts = data.warning.number
        while (sim := next(tickets)) < len(self.state):
            row = self.state[sim]
            mujoco.mj_setState(self._model, data, row, _STATE)
            try:
                call(data)
            except mujoco.FatalError:
                self.status[sim] = 1
                continue
            if counts.any():
                self.warning[sim, :, 1] += counts
                counts[:] = 0
            mujoco.mj_getState(self._model, data, row, _STATE)
            for source, rows in copies:
                rows[sim] = source
