"""One compiled model per task: the robot, the floor and the objects that can be touched. Formulas do the rest.

Buttons and pillars stand still within an episode, but are elsewhere in the next. They are mocap bodies, so that one
model serves every layout: a mocap body acts on others through contact alone, as a fixed body does. Each gremlin is
welded to a mocap body, its target, which the environment moves in a circle.

Two kinds of contacts of safety-gymnasium are left out:

* Gremlins touch the robot alone. In the original they also touch each other, buttons and the floor, but only while the
  robot pushes them (their places are 0.8 m apart, and all circle with the same phase, 0.1 m above the floor) and in the
  first steps, in which they rise from the floor.
* The Point robot does not touch the floor. Its sphere lies on the floor at distance 0 and cannot move vertically, so
  the contact would never have an effect.
"""

import dataclasses
import functools

import mujoco
import numpy as np

from envs.safety_gym.robots import ROBOTS, Robot, Style
from envs.safety_gym.tasks import ObjectKind, SafetyGymTask

GEOM, SENSOR, OBJECT = mujoco.mjtGeom, mujoco.mjtSensor, mujoco.mjtObj
SUBSTEPS = 10  # engine steps per control step
PRISM_SIDES = 16

# Collision classes, as bits of contype. Two geoms can touch if one of them has the other's class in its conaffinity.
# A BALL is a sphere that stands still. A pillar, which stands still too, is of two classes: ROUND for contacts with
# round shapes and FLAT for contacts with flat ones, because on MJX it is two geoms.
FLOOR, ROBOT, MOVABLE, GREMLIN, BALL, ROUND, FLAT = (1 << i for i in range(7))

BASIC_SENSORS = (
    ("accelerometer", SENSOR.mjSENS_ACCELEROMETER),
    ("velocimeter", SENSOR.mjSENS_VELOCIMETER),
    ("gyro", SENSOR.mjSENS_GYRO),
    ("magnetometer", SENSOR.mjSENS_MAGNETOMETER),
)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A compiled task and where its parts are."""

    model: mujoco.MjModel
    robot: Robot
    free_qpos: dict[str, np.ndarray]  # kind -> [count] first of the seven qpos entries of each free body
    mocap: dict[str, np.ndarray]  # kind -> [count] rows of mocap_pos
    ball_qpos: int | None  # first qpos entry of the robot's observed ball joint
    hinge_qpos: np.ndarray  # [H] qpos entries of the observed hinges
    num_observed: int  # leading entries of sensordata that are observed as they are
    contacts: dict[str, slice]  # kind -> entries of sensordata: number of contacts with the robot


def build(task: SafetyGymTask, *, prisms: bool = False) -> Scene:
    """Compiles the model of a task.

    Args:
        task: what it holds.
        prisms: whether other shapes take over contacts of cylinders, as for MJX, which has no contact of a cylinder
            with a box. Contacts with boxes and with other prisms are then those of a prism of 16 sides. A robot's
            cylinders keep their contacts with the floor and with balls. For spheres and capsules the pillar is a
            capsule, which has the pillar's shape up to a height of 1 m, and no robot is that high. It is no capsule
            for boxes too, because MJX misses every second contact of a capsule with a box face that lies along it.
            `tests/test_mjx_shapes.py` checks these pairs.
    """
    robot = ROBOTS[task.robot]
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = robot.timestep
    _set_geom_defaults(spec)
    spec.worldbody.add_geom(name="floor", type=GEOM.mjGEOM_PLANE, size=[3.5, 3.5, 0.1], contype=FLOOR, conaffinity=0)
    _add_robot(spec, robot, prisms)
    for kind in task.objects:
        for i in range(kind.count if kind.shape != "none" else 0):
            _add_object(spec, kind, i, prisms)
    num_sensors = _add_sensors(spec, robot)
    touched = [kind for kind in task.objects if kind.name in task.costs and kind.shape != "none"]
    for kind in touched:
        for i in range(kind.count):
            spec.add_sensor(
                name=f"contact_{kind.name}_{i}",
                type=SENSOR.mjSENS_CONTACT,
                objtype=OBJECT.mjOBJ_GEOM,
                objname=f"{kind.name}_{i}",
                intprm=[1, 0, 1],  # the number of contacts found, unsorted, one row
            )
    model = spec.compile()
    return Scene(
        model=model,
        robot=robot,
        free_qpos={
            kind.name: np.array([_qpos_address(model, f"{kind.name}_{i}") for i in range(kind.count)])
            for kind in task.objects
            if kind.free
        },
        mocap={
            kind.name: np.array([model.body(_mocap_name(kind, i)).mocapid[0] for i in range(kind.count)])
            for kind in task.objects
            if _mocap_name(kind, 0)
        },
        ball_qpos=_qpos_address(model, robot.ball) if robot.ball else None,
        hinge_qpos=np.array([_qpos_address(model, name) for name in robot.hinges], int),
        num_observed=int(model.sensor_dim[:num_sensors].sum()),
        contacts={
            kind.name: slice(first := int(model.sensor(f"contact_{kind.name}_0").adr[0]), first + kind.count)
            for kind in touched
        },
    )


def _mocap_name(kind: ObjectKind, index: int) -> str:
    """The mocap body of an object: its target if it circles, itself if it stands still, none if it moves freely."""
    if kind.circling:
        return f"{kind.name}_{index}_target"
    return "" if kind.free or kind.shape == "none" else f"{kind.name}_{index}"


def _qpos_address(model: mujoco.MjModel, joint: str) -> int:
    return int(model.joint(joint).qposadr[0])


def _set_geom_defaults(spec: mujoco.MjSpec) -> None:
    geom = spec.default.geom
    geom.condim = 6
    geom.friction = [1, 0.005, 0.0001]


def _add_robot(spec: mujoco.MjSpec, robot: Robot, prisms: bool) -> None:
    root = spec.worldbody.add_body(name="robot", pos=[0, 0, robot.height])
    root.add_site(name="robot")
    touches = MOVABLE | GREMLIN | BALL | ROUND | FLAT
    if not robot.planar:
        touches |= FLOOR
    if robot.meets_itself:
        touches |= ROBOT
    spheres, boxes = (ROBOT, touches & ~FLAT), (ROBOT, touches & ~ROUND)
    classes = {
        GEOM.mjGEOM_SPHERE: spheres,
        GEOM.mjGEOM_CAPSULE: spheres,
        GEOM.mjGEOM_BOX: boxes,
        GEOM.mjGEOM_CYLINDER: (0, touches & (FLOOR | BALL)) if prisms else (ROBOT, touches),
        GEOM.mjGEOM_MESH: (ROBOT, touches & ~(FLOOR | BALL | ROUND)),
    }
    style = Style(classes=classes, make_prism=functools.partial(_add_prism, spec) if prisms else None)
    robot.build(root, style)
    robot.actuate(spec)
    for actuator in spec.actuators:
        actuator.ctrlrange = [-1, 1]
        actuator.ctrllimited = True


def _add_prism(spec: mujoco.MjSpec, radius: float, half_length: float) -> str:
    """Adds the mesh of an upright prism whose cross-section has the area of the cylinder's; returns its name."""
    name = f"prism_{radius}_{half_length}"
    if name not in {mesh.name for mesh in spec.meshes}:
        angles = 2 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
        reach = radius * np.sqrt(2 * np.pi / (PRISM_SIDES * np.sin(2 * np.pi / PRISM_SIDES)))
        ring = reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        vertices = [[*point, z] for z in (-half_length, half_length) for point in ring]
        spec.add_mesh(name=name, uservert=np.ravel(vertices).tolist())
    return name


def _add_object(spec: mujoco.MjSpec, kind: ObjectKind, index: int, prisms: bool) -> None:
    name = f"{kind.name}_{index}"
    body = spec.worldbody.add_body(name=name, pos=[0, 0, kind.height], mocap=not kind.free)
    if kind.free:
        body.add_freejoint(name=name)
    if kind.circling:
        spec.worldbody.add_body(name=f"{name}_target", pos=[0, 0, kind.height], mocap=True)
        spec.add_equality(
            name=name,
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=OBJECT.mjOBJ_BODY,
            name1=f"{name}_target",
            name2=name,
            solref=[0.02, 1.5],
            data=[0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0],  # anchor [3], relative position [3] and turn [4], torque scale
        )
    settings = {"contype": GREMLIN if kind.circling else MOVABLE, "density": kind.density}
    settings["conaffinity"] = 0 if kind.circling else FLOOR | BALL | FLAT
    if kind.shape == "box":
        body.add_geom(name=name, type=GEOM.mjGEOM_BOX, size=[kind.size] * 3, **settings)
    elif kind.shape == "sphere":
        body.add_geom(name=name, type=GEOM.mjGEOM_SPHERE, size=[kind.size, 0, 0], contype=BALL, conaffinity=0)
    elif kind.shape == "cylinder":
        shape, classes = (GEOM.mjGEOM_CAPSULE, ROUND) if prisms else (GEOM.mjGEOM_CYLINDER, ROUND | FLAT)
        body.add_geom(name=name, type=shape, size=[kind.size, kind.height, 0], contype=classes, conaffinity=0)
        if prisms:
            mesh = _add_prism(spec, kind.size, kind.height)
            body.add_geom(type=GEOM.mjGEOM_MESH, meshname=mesh, contype=FLAT, conaffinity=0)
    elif kind.shape == "push_box":
        s = kind.size
        body.add_geom(name=name, type=GEOM.mjGEOM_BOX, size=[s, s, s], **settings)
        for x in (-s, s):
            for y in (-s, s):
                body.add_geom(type=GEOM.mjGEOM_BOX, size=[s / 2, s / 2, s], pos=[x, y, 0], **settings)


def _add_sensors(spec: mujoco.MjSpec, robot: Robot) -> int:
    """Adds every robot's sensors, then this robot's own, in the order of the observation; returns how many."""
    for name, kind in BASIC_SENSORS:
        spec.add_sensor(name=name, type=kind, objtype=OBJECT.mjOBJ_SITE, objname="robot")
    for name, kind, objtype, target in robot.sensors:
        spec.add_sensor(name=name, type=kind, objtype=objtype, objname=target)
    return len(BASIC_SENSORS) + len(robot.sensors)
