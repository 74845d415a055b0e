"""Records single steps of the original `safety-gymnasium` 1.0.0 as reference data for the parity tests.

The original runs on Python 3.10 only, beside nothing else of this project:

    python3.10 -m venv .venv310
    .venv310/bin/pip install safety-gymnasium==1.0.0   # brings mujoco 2.3.3, gymnasium 0.28.1, numpy 1.23.5
    .venv310/bin/python tests/golden/record_safety_gym.py --out tests/golden/safety_gym

With another MuJoCo the original finds the contact points that this project's engine finds (the files are those of
`mujoco_3.17/`, `--steps 40 --layouts 0`):

    .venv310/bin/pip install --no-deps mujoco==3.17.0

`<Task>.npz`, one for each task: R steps chosen from E episodes of 1000 steps. Lengths are in metres, angles in radians,
times in seconds; everything is float64 unless another type is named. A state is MuJoCo's own: joints and actuators in
the order of `joints` and `actuators` in the metadata, quaternions as (w, x, y, z).

State before the step:
    episode, step        [R] int32     index into the arrays per episode; number of the step, from 0
    placed               [R] bool      the recorder moved the robot (or the push box) just before this step
    qpos, qvel           [R, nq], [R, nv]
    qacc_warmstart       [R, nv]       the solver's first guess; with it a replay in mujoco 2.3.3 is exact to the bit
    time                 [R]
    action               [R, nu]       as given to `step`: the original clips it to [-1, 1]
    goal_pos             [R, 3]        goal in force during the step (Button1: marker above the goal button)
    goal_button, timer   [R] int32     Button1 (elsewhere -1): button to press; steps that buttons still are harmless
    last_dist_goal       [R]           Goal1, Button1: horizontal distance of robot and goal that the reward starts from
    last_dist_box, last_box_goal [R]   Push1: distances in space robot - box and box - goal that the reward starts from
State after it, with what the step may have redrawn (goal, button, timer, last distances):
    next_qpos, next_qvel, next_time, next_goal_pos, next_goal_button, next_timer, next_last_*
    robot_pos [R, 3], robot_mat [R, 3, 3]   pose of the robot's root body; the columns of the matrix are its axes
What the step returned:
    obs [R, obs_dim], reward [R], cost [R] (0 or 1), terminated, truncated, goal_met [R] bool
    cost_hazards, cost_gremlins, cost_buttons [R]   entries of `info`; NaN where the key is absent
Contacts:
    touch_vase [R, 1], touch_gremlin [R, 4], touch_button [R, 4], touch_pillar [R, 1], touch_box [R]   bool, where the
                         task has such an object: some geom of the robot is in the contact list after the step
    any_object_contact   [R] bool      in one of the 10 substeps or after them, the robot touched an object or two
                         objects touched each other (the floor does not count, nor does the robot touching itself)
    gremlin_floor_contact [R] bool     Button1: likewise, a gremlin touched the floor
Per episode: the scene and what `reset` returned:
    robot_init           [E, 3]        x, y and yaw of the root body; its height is in the metadata
    layout_hazards, layout_buttons, layout_pillars, layout_gremlins (centres of their circles), layout_vases,
    layout_push_box      [E, n, 3]     positions at reset, of the kinds that the task has
    gremlin_quat, vase_quat, push_box_quat   [E, n, 4]
    reset_obs, reset_qpos, reset_qvel, reset_goal_pos, reset_goal_button, reset_timer, reset_last_*
metadata [] str: JSON with versions, command, seeds, names, addresses in qpos and qvel, behaviours, counts of events and
the speed of the original.

`layouts.npz`: arrays Goal1, Button1, Push1 [n, objects, 2], layouts fresh from the original's sampler for the Point
robot; the metadata names the objects. `--tasks` without names makes this file alone.
"""

import argparse
import json
import shlex
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import safety_gymnasium  # type: ignore[import-not-found]

Record = dict[str, Any]  # what is known of one step, by the names in the docstring above
Arrays = dict[str, np.ndarray]

TASKS = ("PointGoal1", "PointButton1", "PointPush1", "CarGoal1", "CarButton1", "CarPush1", "DoggoGoal1", "DoggoButton1")
SUBSTEPS = 10
LEAST = 5  # records of every kind of event
MOST_STEPS = {"DoggoButton1": 48}  # records for each episode: its states are so long that the file would be too large
OBJECTS = {"vase": "vase", "gremlin": "gremlin", "button": "button", "pillar": "pillar", "push_box": "box"}
LAYOUTS = {  # name of the array -> (prefix of the bodies, suffix, quaternions that matter)
    "hazards": ("hazard", "", None),
    "buttons": ("button", "", None),
    "pillars": ("pillar", "", None),
    "gremlins": ("gremlin", "obj", "gremlin_quat"),
    "vases": ("vase", "", "vase_quat"),
    "push_box": ("push_box", "", "push_box_quat"),
}
EVENTS = {
    "Goal1": ("goal", "hazard", "vase"),
    "Button1": ("goal", "hazard", "wrong_button", "muted_button", "gremlin"),
    "Push1": ("goal", "hazard", "box", "pillar"),
}
ERRANDS = {  # what a controller goes for, one after the other
    "Goal1": ("goal", "hazard", "goal", "vase"),
    "Button1": ("goal", "wrong_button", "goal", "gremlin", "goal", "hazard"),
    "Push1": ("goal", "box", "goal", "pillar", "goal", "hazard"),
}
BEHAVIOURS = {  # Doggo cannot be made to walk by a few lines of code
    "Point": ("seeking", "random", "placed"),
    "Car": ("seeking", "random", "placed"),
    "Doggo": ("placed", "random"),
}


@dataclass
class Scene:
    """One task of the original, and short ways to its insides; model and data are new ones after every reset."""

    name: str
    env: Any = field(init=False)
    seconds: list[float] = field(default_factory=list)  # that the original took for the steps of this episode

    def __post_init__(self) -> None:
        self.env = safety_gymnasium.make(f"Safety{self.name}-v0")

    @property
    def robot(self) -> str:
        return next(robot for robot in BEHAVIOURS if self.name.startswith(robot))

    @property
    def family(self) -> str:
        return self.name.removeprefix(self.robot)

    @property
    def task(self) -> Any:
        return self.env.unwrapped.task

    @property
    def model(self) -> Any:
        return self.task.model

    @property
    def data(self) -> Any:
        return self.task.data

    @property
    def distances(self) -> dict[str, Callable[[], float]]:
        """The task's last distances that its reward uses, with the functions that measure them."""
        if self.family == "Push1":
            return {"last_dist_box": self.task.dist_box, "last_box_goal": self.task.dist_box_goal}
        return {"last_dist_goal": self.task.dist_goal}

    def bodies(self, prefix: str) -> list[str]:
        """Names of the moving or static bodies of one kind of object, without the targets of the gremlins."""
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        return [name for name in names if name.startswith(prefix) and not name.endswith("mocap")]

    def xy(self, body: str) -> np.ndarray:
        return self.data.body(body).xpos[:2].copy()


# ----------------------------------------------------------------------------------------------------------- contacts


def geom_owners(model: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """For each geom the root body that it belongs to (0: the floor), and the root bodies of each kind of object."""
    names = [model.body(i).name for i in range(model.nbody)]
    kinds = {
        kind: np.array([i for i, n in enumerate(names) if n.startswith(prefix) and not n.endswith("mocap")], int)
        for prefix, kind in OBJECTS.items()
    }
    return model.body_rootid[model.geom_bodyid], {kind: ids for kind, ids in kinds.items() if ids.size}


def touching(model: Any, data: Any) -> np.ndarray:
    """[contacts, 2] the root bodies that are in the contact list."""
    owners = geom_owners(model)[0]
    return np.stack([owners[data.contact.geom1], owners[data.contact.geom2]], axis=1)


def touch_flags(scene: Scene) -> dict[str, np.ndarray]:
    """Which objects some geom of the robot touches now."""
    pairs, robot = touching(scene.model, scene.data), scene.model.body("agent").id
    partners = pairs[(pairs == robot).any(axis=1)].ravel()
    flags = {f"touch_{kind}": np.isin(ids, partners) for kind, ids in geom_owners(scene.model)[1].items()}
    return {name: flag[0] if name == "touch_box" else flag for name, flag in flags.items()}


def check_geom_names(scene: Scene) -> None:
    """The original knows the robot's geoms by name, this script by body: both must mean the same ones."""
    model, owners = scene.model, geom_owners(scene.model)[0]
    names = {model.geom(i).name for i in np.flatnonzero(owners == model.body("agent").id)}
    if names != set(scene.task.agent.body_info.geom_names) or "" in names:
        raise RuntimeError(f"{scene.name}: unexpected geoms of the robot: {sorted(names)}")


def replay(scene: Scene, record: Record) -> dict[str, bool]:
    """Repeats a recorded step with bare MuJoCo, to see the contacts of its substeps. The result must be the same."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.time = record["time"]
    for name in ("qpos", "qvel", "qacc_warmstart"):
        getattr(data, name)[:] = record[name]
    data.ctrl[:] = np.clip(record["action"], *model.actuator_ctrlrange.T)
    found, robot, gremlins = [], model.body("agent").id, geom_owners(model)[1].get("gremlin", np.zeros(0, int))
    for _ in range(SUBSTEPS):
        if gremlins.size:
            radius, height = scene.task.gremlins.travel, scene.task.gremlins.size
            data.mocap_pos[:] = radius * np.sin(data.time), radius * np.cos(data.time), height
        mujoco.mj_step(model, data)
        found.append(touching(model, data))
    mujoco.mj_forward(model, data)
    found.append(touching(model, data))
    for name, value in (("qpos", data.qpos), ("qvel", data.qvel), ("time", data.time)):
        if not np.array_equal(value, record[f"next_{name}"]):
            raise RuntimeError(f"{scene.name}: the replay of step {record['step']} differs in {name}")
    pairs = np.concatenate(found)
    floor = (pairs == 0).any(axis=1)
    flags = {"any_object_contact": bool((~floor & (pairs != robot).any(axis=1)).any())}
    if gremlins.size:
        flags["gremlin_floor_contact"] = bool((floor & np.isin(pairs, gremlins).any(axis=1)).any())
    return flags


# ------------------------------------------------------------------------------------------------------------ pilots


class Pilot:
    """Chooses the actions of one episode: here at random, held for a while so that the robot gets somewhere."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene, self.rng = scene, rng
        self.held: np.ndarray = np.zeros(scene.model.nu)
        self.hold = 0

    def prepare(self, step: int) -> bool:
        """Called before a step, when the state may still be changed; says whether it was."""
        return False

    def act(self) -> np.ndarray:
        """The action, not clipped. Small ones occur, since Point and Car saturate at 0.05 and 0.02."""
        if self.hold == 0:
            self.hold = int(self.rng.integers(1, 12))
            scale = 1.2 if self.rng.random() < 0.6 else 10 ** self.rng.uniform(-3, 0)
            self.held = scale * self.rng.uniform(-1, 1, self.held.shape)
        self.hold -= 1
        return self.held.copy()

    def notice(self, record: Record) -> None:
        """Called with what came of the action."""


class SeekingPilot(Pilot):
    """Drives Point and Car from one errand of the task to the next."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.errand, self.patience, self.wanted = -1, 0, 0
        self.trail: list[np.ndarray] = []
        self.backing = 0
        self.next_errand()

    @property
    def kind(self) -> str:
        errands = ERRANDS[self.scene.family]
        return errands[self.errand % len(errands)]

    def next_errand(self) -> None:
        self.errand += 1
        self.body = str(self.rng.choice(self.candidates()))
        self.patience = 300 if self.pushing else 120
        self.wanted = 1 if self.kind == "goal" else 6

    @property
    def pushing(self) -> bool:
        return self.kind == "goal" and self.scene.family == "Push1"

    def candidates(self) -> list[str]:
        """Bodies that serve the errand."""
        task, kind = self.scene.task, self.kind
        if kind == "wrong_button":
            return [body for body in self.scene.bodies("button") if body != f"button{task.buttons.goal_button}"]
        if kind == "goal" and self.scene.family == "Button1":
            return [f"button{task.buttons.goal_button}"]
        return self.scene.bodies({"box": "push_box"}.get(kind, kind))

    def notice(self, record: Record) -> None:
        self.patience -= 1
        self.wanted -= int(happened(self.kind, record))
        changed = self.kind == "goal" and record["goal_met"]
        if self.wanted <= 0 or self.patience <= 0 or changed:
            self.next_errand()
        self.trail = [*self.trail[-20:], self.scene.xy("agent")]
        if self.backing == 0 and len(self.trail) == 21 and np.ptp(self.trail, axis=0).max() < 0.01:
            self.backing, self.trail = 15, []

    def act(self) -> np.ndarray:
        if self.backing > 0:
            self.backing -= 1
            return self.drive(-1.0, self.rng.uniform(-1, 1))
        way = self.waypoint() - self.scene.xy("agent")
        # A change of velocity is steered, not a direction: nothing else keeps Point from circling its target.
        wish = way * min(2.0, 1 / (np.linalg.norm(way) + 1e-9)) - self.scene.task.agent.vel[:2]
        axis = {"Point": (1.0, 0.0), "Car": (0.0, -1.0)}[self.scene.robot]
        ahead = self.scene.task.agent.mat[:2, :2] @ np.array(axis)
        error = np.arctan2(ahead[0] * wish[1] - ahead[1] * wish[0], ahead @ wish)
        thrust = np.clip(3 * np.linalg.norm(wish) * np.cos(error), -1, 1)
        if self.scene.robot == "Point":
            thrust = max(thrust, 0.0)
        elif abs(error) > np.pi / 2:  # Car runs backwards just as well
            error -= np.sign(error) * np.pi
        return self.drive(float(thrust), float(np.clip(2 * error, -1, 1)))

    def drive(self, thrust: float, turn: float) -> np.ndarray:
        """Thrust and turn (positive: to the left) in [-1, 1] as an action."""
        if self.scene.robot == "Point":
            action = np.array([thrust, turn])
        else:
            action = 0.03 * np.array([thrust + turn, thrust - turn])
        return action * self.rng.uniform(0.8, 1.25, 2)

    def waypoint(self) -> np.ndarray:
        """Where to drive: at the errand, or round the push box to the side away from the goal."""
        if not self.pushing:
            return self.scene.xy(self.body)
        box, goal = self.scene.xy("push_box"), self.scene.xy("goal")
        to_goal = (goal - box) / (np.linalg.norm(goal - box) + 1e-9)
        offset = self.scene.xy("agent") - box
        now, behind = np.arctan2(offset[1], offset[0]), np.arctan2(-to_goal[1], -to_goal[0])
        around = (behind - now + np.pi) % (2 * np.pi) - np.pi
        if abs(around) < (0.3 if np.linalg.norm(offset) > 0.9 * self.box_reach() else 0.8):
            return box + 0.5 * to_goal
        angle = now + np.clip(around, -0.6, 0.6)
        return box + self.box_reach() * np.array([np.cos(angle), np.sin(angle)])

    def box_reach(self) -> float:
        """Distance from the centre of the push box at which the robot is clear of its corners."""
        return float(1.5 * np.sqrt(2) * self.scene.task.push_box.size + 0.2)


class PlacingPilot(SeekingPilot):
    """Puts the robot next to the errand from time to time, and lets it go on from there."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        super().__init__(scene, rng)
        self.next_move = 12  # Doggo falls from 0.22 m first

    def act(self) -> np.ndarray:
        return Pilot.act(self) if self.scene.robot == "Doggo" else super().act()

    def notice(self, record: Record) -> None:
        """Errands end with the next move only, else every success would leave one out."""

    def prepare(self, step: int) -> bool:
        if step < self.next_move:
            return False
        self.next_move = step + int(self.rng.integers(15, 35))
        self.next_errand()
        target, distance = self.scene.xy(self.body), self.start_distance()
        direction = self.approach(target, distance)
        if self.pushing:
            put_free_body(self.scene, "push_box", target + 0.42 * direction)
            distance = 0.42 + self.box_reach()
        # Not straight at it: an angle of -1e-17 makes the original's lidar fail with bin 16 of 16.
        yaw = float(np.arctan2(-direction[1], -direction[0]) + self.rng.uniform(-0.4, 0.4))
        put_robot(self.scene, target + distance * direction, yaw)
        mujoco.mj_forward(self.scene.model, self.scene.data)
        for name, measure in self.scene.distances.items():  # else the move itself would be rewarded
            setattr(self.scene.task, name, measure())
        return True

    def start_distance(self) -> float:
        """Distance from the errand's centre, about where it begins to count."""
        radius = {"goal": 0.3, "hazard": 0.2, "vase": 0.25, "gremlin": 0.25, "pillar": 0.33, "box": 0.45}
        nearest = 0.24 if "button" in self.body else radius[self.kind]
        slack = -0.06 if self.scene.robot == "Doggo" else 0.0  # it would not get there by itself
        return nearest + slack + float(self.rng.uniform(0.0, 0.12))

    def approach(self, target: np.ndarray, distance: float) -> np.ndarray:
        """Direction from the errand to a place that is, if possible, clear of the other objects."""
        angles = self.rng.permutation(16) * np.pi / 8 + self.rng.uniform(0, np.pi / 8)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        others = [body for prefix in OBJECTS for body in self.scene.bodies(prefix) if body != self.body]
        if self.pushing:
            others.remove("push_box")
        if not others:
            return directions[0]
        places = target + distance * directions
        gaps = np.linalg.norm(places[:, None] - np.stack([self.scene.xy(body) for body in others]), axis=-1).min(axis=1)
        return directions[int(np.argmax(np.minimum(gaps, 0.5)))]


PILOTS = {"random": Pilot, "seeking": SeekingPilot, "placed": PlacingPilot}


def put_free_body(scene: Scene, body: str, xy: np.ndarray) -> int:
    """Moves a body with a free joint sideways and stops it; returns its address in qpos."""
    joint = int(scene.model.body(body).jntadr[0])
    q, v = int(scene.model.jnt_qposadr[joint]), int(scene.model.jnt_dofadr[joint])
    scene.data.qpos[q : q + 2], scene.data.qvel[v : v + 6] = xy, 0
    return q


def put_robot(scene: Scene, xy: np.ndarray, yaw: float) -> None:
    """Moves the robot, turns it about the vertical so that its front points to `yaw`, and stops it."""
    model, data, task = scene.model, scene.data, scene.task
    if scene.robot == "Point":  # its joints start from the initial pose, and are the first three
        start = task.world_info.world_config_dict["agent_rot"]
        c, s = np.cos(start), np.sin(start)
        data.qpos[:2] = np.array([[c, s], [-s, c]]) @ (xy - model.body("agent").pos[:2])
        data.qpos[2], data.qvel[:3] = yaw - start, 0
        return
    q = put_free_body(scene, "agent", xy)
    matrix = task.agent.mat
    turn = yaw - np.arctan2(matrix[1, 0], matrix[0, 0]) + (np.pi / 2 if scene.robot == "Car" else 0.0)
    turned = np.zeros(4)
    mujoco.mju_mulQuat(turned, np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]), data.qpos[q + 3 : q + 7])
    data.qpos[q + 3 : q + 7] = turned


# --------------------------------------------------------------------------------------------------------- recording


def happened(kind: str, record: Record) -> bool:
    """Whether an event of this kind happened in the step."""
    if kind == "goal":
        return bool(record["goal_met"])
    if kind == "hazard":
        return bool(record["cost_hazards"] > 0)
    if kind == "wrong_button":
        return bool(record["cost_buttons"] > 0)
    if kind == "muted_button":  # touched, but the timer is running
        return bool(record["timer"] > 0 and record["touch_button"].any())
    return bool(np.any(record[f"touch_{kind}"]))


def read_state(scene: Scene) -> Record:
    data, buttons = scene.data, getattr(scene.task, "buttons", None)
    state = {
        "qpos": data.qpos.copy(),
        "qvel": data.qvel.copy(),
        "time": float(data.time),
        "goal_pos": data.body("goal").xpos.copy(),
        "goal_button": np.int32(-1 if buttons is None else buttons.goal_button),
        "timer": np.int32(-1 if buttons is None else buttons.timer),
    }
    return state | {name: float(getattr(scene.task, name)) for name in scene.distances}


def record_step(scene: Scene, pilot: Pilot, step: int) -> Record:
    """Lets the pilot act once; everything about the step but the contacts of its substeps."""
    record: Record = {"step": np.int32(step), "placed": pilot.prepare(step)}
    record |= read_state(scene) | {"qacc_warmstart": scene.data.qacc_warmstart.copy(), "action": pilot.act()}
    start = time.perf_counter()
    obs, reward, cost, terminated, truncated, info = scene.env.step(record["action"].copy())
    scene.seconds.append(time.perf_counter() - start)
    record |= {f"next_{name}": value for name, value in read_state(scene).items()}
    record |= {"robot_pos": scene.task.agent.pos, "robot_mat": scene.task.agent.mat}
    record |= {"obs": obs.copy(), "reward": float(reward), "cost": float(cost)}
    record |= {f"cost_{kind}": float(info.get(f"cost_{kind}", np.nan)) for kind in ("hazards", "gremlins", "buttons")}
    record |= {"goal_met": bool(info.get("goal_met", False)), "terminated": terminated, "truncated": truncated}
    record |= touch_flags(scene)
    pilot.notice(record)
    return record


def read_layout(scene: Scene) -> Record:
    """The scene right after a reset, from the compiled model: that is what the simulation uses."""
    config, model = scene.task.world_info.world_config_dict, scene.model
    layout: Record = {"robot_init": np.array([*config["agent_xy"], config["agent_rot"]])}
    for name, (prefix, suffix, quaternions) in LAYOUTS.items():
        bodies = [body for body in scene.bodies(prefix) if body.endswith(suffix)]
        if bodies:
            layout[f"layout_{name}"] = np.stack([model.body(body).pos for body in bodies])
        if bodies and quaternions:
            layout[quaternions] = np.stack([model.body(body).quat for body in bodies])
    return layout


def choose(records: list[Record], kinds: tuple[str, ...], steps: int, rng: np.random.Generator) -> list[int]:
    """Steps of an episode to keep: its ends, a share for every kind of event, what follows a goal, ordinary steps."""
    kept = {0, 1, 2, len(records) - 1}
    events = {kind: [i for i, record in enumerate(records) if happened(kind, record)] for kind in kinds}
    share = max(LEAST, int(0.6 * steps / len(kinds)))
    for kind in kinds:
        kept |= set(rng.permutation(events[kind])[:share].astype(int).tolist())
    kept |= {i + 1 for i in kept.intersection(events["goal"]) if i + 1 < len(records)}
    eventful = set().union(*events.values())
    ordinary = [i for i in range(len(records)) if i not in eventful | kept]
    kept |= set(rng.permutation(ordinary)[: max(0, steps - len(kept))].astype(int).tolist())
    return sorted(kept)


def record_episode(scene: Scene, behaviour: str, seed: int, steps: int) -> tuple[list[Record], Record, Record]:
    """The chosen steps of one episode, its scene, and a summary of all its steps."""
    obs, _ = scene.env.reset(seed=seed)
    check_geom_names(scene)
    start = {f"reset_{name}": value for name, value in read_state(scene).items() if name != "time"}
    layout = read_layout(scene) | start | {"reset_obs": obs.copy()}
    rng = np.random.default_rng(seed)
    pilot = PILOTS[behaviour](scene, rng)
    records: list[Record] = []
    scene.seconds.clear()
    while not records or not (records[-1]["terminated"] or records[-1]["truncated"]):
        records.append(record_step(scene, pilot, len(records)))
    kinds = EVENTS[scene.family]
    chosen = [records[i] for i in choose(records, kinds, steps, rng)]
    summary = {
        "behaviour": behaviour,
        "reset_seed": seed,
        "steps": len(records),
        "records": len(chosen),
        "return": sum(record["reward"] for record in records),
        "cost": sum(record["cost"] for record in records),
        "events_in_all_steps": {kind: sum(happened(kind, record) for record in records) for kind in kinds},
        "steps_per_second": round(len(records) / sum(scene.seconds), 1),
    }
    return [record | replay(scene, record) for record in chosen], layout, summary


# ------------------------------------------------------------------------------------------------------------- files


def stack(records: list[Record]) -> Arrays:
    return {name: np.stack([np.asarray(record[name]) for record in records]) for name in records[0]}


def names_and_addresses(scene: Scene) -> dict[str, Any]:
    """What a reader needs to find a joint in qpos and qvel, an actuator in the action, and a block in obs."""
    model, kinds = scene.model, ("free", "ball", "slide", "hinge")
    joints = [
        {
            "name": model.joint(i).name,
            "type": kinds[model.jnt_type[i]],
            "body": model.body(model.jnt_bodyid[i]).name,
            "qpos": [int(model.jnt_qposadr[i]), (7, 4, 1, 1)[model.jnt_type[i]]],
            "qvel": [int(model.jnt_dofadr[i]), (6, 3, 1, 1)[model.jnt_type[i]]],
        }
        for i in range(model.njnt)
    ]
    ends = np.cumsum([0] + [int(np.prod(space.shape)) for space in scene.env.unwrapped.obs_space_dict.values()])
    blocks = zip(scene.env.unwrapped.obs_space_dict, ends[:-1].tolist(), np.diff(ends).tolist(), strict=True)
    return {
        "joints": joints,
        "joints_note": "qpos and qvel of a joint: [first index, length]",
        "actuators": [model.actuator(i).name for i in range(model.nu)],
        "bodies": [model.body(i).name for i in range(model.nbody)],
        "obs_blocks": [[name, first, length] for name, first, length in blocks],
        "obs_blocks_note": "[name, first index, length]",
        "timestep": float(model.opt.timestep),
        "substeps": SUBSTEPS,
        "robot_height": float(scene.model.body("agent").pos[2]),
        "sizes": {body: size(scene, body) for body in ("goal", "hazard", "vase", "pillar", "button", "push_box")},
    }


def size(scene: Scene, body: str) -> float | None:
    """Radius, or half the edge, of one kind of object; None where the task has none."""
    found = scene.bodies(body)
    return float(scene.model.geom(found[0]).size[0]) if found else None


def provenance(options: argparse.Namespace) -> dict[str, Any]:
    packages = ("safety-gymnasium", "mujoco", "gymnasium", "numpy")
    return {
        "versions": {"python": sys.version.split()[0]} | {package: version(package) for package in packages},
        "command": shlex.join(["python", "tests/golden/record_safety_gym.py", *sys.argv[1:]]),
        "seed": options.seed,
    }


def save(path: Path, arrays: Arrays, metadata: dict[str, Any]) -> None:
    np.savez_compressed(path, metadata=np.array(json.dumps(metadata)), **arrays)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)


def record_task(name: str, options: argparse.Namespace) -> dict[str, int]:
    """Writes the file of one task; returns the number of records of each kind of event."""
    scene, steps = Scene(name), min(options.steps, MOST_STEPS.get(name, options.steps))
    cycle, base = BEHAVIOURS[scene.robot], (zlib.crc32(name.encode()) + 1000 * options.seed) % 2**31
    records: list[Record] = []
    layouts: list[Record] = []
    story: list[dict[str, Any]] = []
    for i in range(options.episodes):
        chosen, layout, summary = record_episode(scene, cycle[i % len(cycle)], base + i, steps)
        records += [{"episode": np.int32(i)} | record for record in chosen]
        layouts.append(layout)
        story.append({"episode": i} | summary)
    counts = {kind: sum(happened(kind, record) for record in records) for kind in EVENTS[scene.family]}
    metadata = provenance(options) | {
        "task": f"Safety{name}-v0",
        "episodes": story,
        "behaviours": "random: random actions, each held for 1 to 11 steps; seeking: a scripted controller drives to "
        "goals, hazards and objects; placed: every 15 to 34 steps the robot is put near one of them (Push1: also the "
        "push box near the goal), with the last distances measured anew; see the array `placed` for the very steps",
        "event_counts": counts,
        "steps_per_second": max((e["steps_per_second"] for e in story if e["behaviour"] == "random"), default=None),
        "steps_per_second_note": "one process, the best episode with random actions, without resets; the machine was "
        "shared with other work, so this is a lower bound",
    }
    save(options.out / f"{name}.npz", stack(records) | stack(layouts), metadata | names_and_addresses(scene))
    return counts


def sample_layouts(name: str, n: int, seed: int) -> tuple[list[str], np.ndarray]:
    """Layouts from the original's sampler alone: building the world for each would take seconds."""
    task = Scene(name).task
    task._build_placements_dict()
    conf, generator = task.placements_conf, task.random_generator
    generator.set_placements_info(conf.placements, conf.extents, conf.margin)
    generator.set_random_seed(seed)
    layouts = []
    for _ in range(n):
        layout = generator.build_layout()
        if "Button" not in name:  # as reset does: the goal is drawn again when all the rest is in place
            del layout["goal"]
            while not generator.sample_goal_position():
                pass
        layouts.append(dict(layout))
    names = list(conf.placements)
    return names, np.array([[layout[name] for name in names] for layout in layouts])


def record_layouts(options: argparse.Namespace) -> None:
    arrays, names = {}, {}
    for family in EVENTS:
        n = options.layouts // (4 if family == "Button1" else 1)  # one of Button1 takes 0.3 s, the others 1 ms
        names[family], arrays[family] = sample_layouts(f"Point{family}", n, options.seed)
    note = "Goal1, Push1: goal after its redraw; Button1: goal is the phantom that only takes room while sampling"
    save(options.out / "layouts.npz", arrays, provenance(options) | {"objects": names, "note": note})


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Records reference data from the original safety-gymnasium 1.0.0.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the files")
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=TASKS, metavar="TASK", help=" ".join(TASKS))
    parser.add_argument("--episodes", type=int, default=6, help="episodes for each task (default 6)")
    parser.add_argument("--steps", type=int, default=60, help="records for each episode, roughly (default 60)")
    parser.add_argument(
        "--layouts", type=int, default=2000, help="layouts, for Button1 a quarter; 0: no file (default 2000)"
    )
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def main() -> int:
    options = parse_options()
    options.out.mkdir(parents=True, exist_ok=True)
    counts = {name: record_task(name, options) for name in options.tasks}
    if options.layouts:
        record_layouts(options)
    for name, events in counts.items():
        print(f"{name:14}", "  ".join(f"{kind} {count}" for kind, count in events.items()))
    rare = [f"{name} {kind}" for name, events in counts.items() for kind, count in events.items() if count < LEAST]
    if rare:
        print(f"fewer than {LEAST} records:", ", ".join(rare))
    return 1 if rare else 0


if __name__ == "__main__":
    sys.exit(main())
