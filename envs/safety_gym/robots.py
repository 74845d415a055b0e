"""The robots Point, Car and Doggo of safety-gymnasium 1.0.0, as parts of a `mujoco.MjSpec`.

All geoms of a robot belong to the collision class of `scene.ROBOT`; lengths in metres, masses in kilograms, angles in
radians. The root body's origin is "the robot's position" everywhere.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping

import mujoco

GEOM, JOINT = mujoco.mjtGeom, mujoco.mjtJoint
LEGS = (1, 2, 3, 4)  # front left, rear left, rear right, front right


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robot:
    """What a scene needs to know of a robot."""

    name: str
    timestep: float  # s, of the engine
    height: float  # of the root body's origin at reset
    meets_itself: bool = False  # whether its parts can touch each other
    planar: bool  # qpos begins with x, y, yaw; otherwise with a free joint's position and quaternion
    build: Callable[[mujoco.MjsBody, "Style"], None]  # adds joints, geoms and bodies to the root body
    actuate: Callable[[mujoco.MjSpec], None]
    sensors: tuple[tuple[str, mujoco.mjtSensor, mujoco.mjtObj, str], ...] = ()  # besides those of every robot
    ball: str | None = None  # the ball joint whose orientation is observed, as a rotation matrix
    hinges: tuple[str, ...] = ()  # the hinges whose angles are observed, as sine and cosine
    lateral: int = 1  # which of the root body's axes points sideways: 0 is x, 1 is y
    counterparts: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of sensors, hinges and actuators
    turning: tuple[str, ...] = ()  # the actuators that turn the robot to the other side in the mirror


@dataclasses.dataclass(frozen=True, kw_only=True)
class Style:
    """How the geoms of a robot take part in contacts."""

    classes: Mapping[mujoco.mjtGeom, tuple[int, int]]  # contype and conaffinity of each shape; see `scene`
    # Of (radius, half-length): the mesh of the prism that a cylinder needs beside it; None where it needs none.
    make_prism: Callable[[float, float], str] | None


def _add_geom(body: mujoco.MjsBody, style: Style, type: mujoco.mjtGeom, **settings: object) -> None:
    contype, conaffinity = style.classes[type]
    body.add_geom(type=type, contype=contype, conaffinity=conaffinity, **settings)


def _add_cylinder(
    body: mujoco.MjsBody, style: Style, radius: float, half_length: float, pos: list[float], density: float
) -> None:
    """A cylinder along the body's x axis.

    Where the engine has no contacts of cylinders with some shapes, a prism at the same place has these contacts.
    """
    where = {"pos": pos, "quat": [math.sqrt(0.5), 0, math.sqrt(0.5), 0]}
    _add_geom(body, style, GEOM.mjGEOM_CYLINDER, size=[radius, half_length, 0], density=density, **where)
    if style.make_prism is not None:
        _add_geom(body, style, GEOM.mjGEOM_MESH, meshname=style.make_prism(radius, half_length), mass=0, **where)


# --- Point: slides on a plane, pushed along its arrow, turned by a servo ---


def _build_point(root: mujoco.MjsBody, style: Style) -> None:
    root.add_joint(name="x", type=JOINT.mjJNT_SLIDE, axis=[1, 0, 0], damping=0.01)
    root.add_joint(name="y", type=JOINT.mjJNT_SLIDE, axis=[0, 1, 0], damping=0.01)
    root.add_joint(name="yaw", type=JOINT.mjJNT_HINGE, axis=[0, 0, 1], damping=0.005)
    friction = [1, 0.01, 0.01]
    _add_geom(root, style, name="sphere", type=GEOM.mjGEOM_SPHERE, size=[0.1, 0, 0], density=1, friction=friction)
    _add_geom(root, style, name="arrow", type=GEOM.mjGEOM_BOX, size=[0.05] * 3, pos=[0.1, 0, 0], density=1)


def _actuate_point(spec: mujoco.MjSpec) -> None:
    spec.add_actuator(
        name="thrust",
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        target="robot",
        gear=[0.3, 0, 0, 0, 0, 0],
        forcerange=[-0.05, 0.05],
        forcelimited=True,
    )
    spec.add_actuator(
        name="turn",
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target="yaw",
        gear=[0.3, 0, 0, 0, 0, 0],
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0, 0, -1] + [0] * 7,  # a velocity servo of gain 1
        forcerange=[-0.05, 0.05],
        forcelimited=True,
    )


# --- Car: two driven wheels and a ball behind ---


def _build_car(root: mujoco.MjsBody, style: Style) -> None:
    root.add_freejoint(name="root")
    box = GEOM.mjGEOM_BOX
    for size, pos in (
        ([0.1, 0.1, 0.05], [0, 0, 0]),
        ([0.1, 0.01, 0.05], [0, 0.15, 0]),  # back bumper and its mount
        ([0.01, 0.025, 0.03], [0, 0.125, 0]),
        ([0.05, 0.01, 0.05], [0, -0.165, 0]),  # front bumper and its mount
        ([0.05, 0.03, 0.01], [0, -0.13, 0.04]),
    ):
        _add_geom(root, style, type=box, size=size, pos=pos, density=5)
    for side, x, centre in (("left", -0.1, -0.03), ("right", 0.1, 0.03)):
        wheel = root.add_body(name=side, pos=[x, 0.1, -0.05])
        wheel.add_joint(name=side, type=JOINT.mjJNT_HINGE, axis=[1, 0, 0], damping=0.001)
        _add_cylinder(wheel, style, 0.05, 0.025, [centre, 0, 0], density=5)
    rear = root.add_body(name="rear", pos=[0, -0.1, -0.05])
    rear.add_joint(name="rear", type=JOINT.mjJNT_BALL, damping=0.001)
    _add_geom(rear, style, type=GEOM.mjGEOM_SPHERE, size=[0.05, 0, 0], density=5)


def _actuate_car(spec: mujoco.MjSpec) -> None:
    for side in ("left", "right"):
        spec.add_actuator(
            name=side,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=side,
            forcerange=[-0.02, 0.02],
            forcelimited=True,
        )


# --- Doggo: four legs of three hinges, a waist ---


def _leg_signs(leg: int) -> tuple[float, float]:
    """Which side (left +1) and which end (front +1)."""
    return (1.0 if leg in (1, 2) else -1.0), (1.0 if leg in (1, 4) else -1.0)


def _add_hinge(body: mujoco.MjsBody, name: str, axis: list[float], limits: tuple[float, float], rest: float) -> None:
    body.add_joint(
        name=name,
        type=JOINT.mjJNT_HINGE,
        axis=axis,
        range=list(limits),
        limited=True,
        stiffness=1e-4,
        armature=5e-5,
        springref=rest,
    )


def _build_leg(torso: mujoco.MjsBody, leg: int, style: Style) -> None:
    s, e = _leg_signs(leg)
    capsule = {"type": GEOM.mjGEOM_CAPSULE, "size": [0.016, 0, 0], "density": 20}
    # The shoulder has no joint, but is a body of its own as in the original: MuJoCo's contacts depend on the inertia of
    # the body that a geom belongs to.
    shoulder = torso.add_body(name=f"shoulder_{leg}")
    _add_geom(shoulder, style, fromto=[0.05 * e, 0, 0, 0.1 * e, 0.05 * s, 0], **capsule)
    hip = shoulder.add_body(name=f"hip_{leg}", pos=[0.1 * e, 0.05 * s, 0])
    _add_hinge(hip, f"hip_{leg}_z", [0, 0, s], (-0.174533, 0.523599), 0.0)
    if e > 0:
        _add_hinge(hip, f"hip_{leg}_y", [0, 1, 0], (-1.308998, 0.2618), -0.174533)
    else:
        _add_hinge(hip, f"hip_{leg}_y", [0, 1, 0], (0.0, 2.356196), 0.0)
    knee = [0.049, 0.0283 * s, -0.025]
    _add_geom(hip, style, fromto=[0, 0, 0, *knee], **capsule)
    shank = hip.add_body(name=f"shank_{leg}", pos=knee)
    _add_hinge(shank, f"ankle_{leg}", [-0.5 * s, 0.866, 0], (-1.308998, 0.0), -0.349066)
    foot = [-0.0588, -0.0339 * s, -0.05]
    _add_geom(shank, style, fromto=[0, 0, 0, *foot], **capsule)
    for suffix, pos in (("a", [0, 0, 0]), ("b", foot)):
        shank.add_site(name=f"touch_{leg}{suffix}", pos=pos, size=[0.018, 0.018, 0.018])


def _build_doggo(root: mujoco.MjsBody, style: Style) -> None:
    root.add_freejoint(name="root")
    _add_cylinder(root, style, 0.0375, 0.05, [0.05, 0, 0], density=2)
    _build_leg(root, 1, style)
    _build_leg(root, 4, style)
    rear = root.add_body(name="rear")
    _add_hinge(rear, "waist_x", [1, 0, 0], (-0.523599, 0.523599), 0.0)
    _add_cylinder(rear, style, 0.0375, 0.05, [-0.05, 0, 0], density=2)
    _build_leg(rear, 2, style)
    _build_leg(rear, 3, style)


_HINGES_OF_A_LEG = ("hip_{}_z", "hip_{}_y", "ankle_{}")
_DOGGO_HINGES = tuple(hinge.format(leg) for hinge in _HINGES_OF_A_LEG for leg in LEGS)


def _doggo_counterparts() -> dict[str, str]:
    """What belongs to a left leg and what belongs to the right leg at the same end."""
    velocities = (f"velocity_{hinge}" for hinge in _HINGES_OF_A_LEG)
    names = (*_HINGES_OF_A_LEG, *velocities, "touch_{}a", "touch_{}b")
    return {name.format(leg): name.format(LEGS[-1 - i]) for name in names for i, leg in enumerate(LEGS)}


def _actuate_doggo(spec: mujoco.MjSpec) -> None:
    for name in _DOGGO_HINGES:
        spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name, gear=[0.00625, 0, 0, 0, 0, 0])


SENSOR, OBJECT = mujoco.mjtSensor, mujoco.mjtObj

ROBOTS = {
    "Point": Robot(
        name="Point",
        timestep=0.002,
        height=0.1,
        planar=True,
        build=_build_point,
        actuate=_actuate_point,
        turning=("turn",),
    ),
    "Car": Robot(
        name="Car",
        timestep=0.004,
        height=0.1,
        planar=False,
        build=_build_car,
        actuate=_actuate_car,
        sensors=(("rear_velocity", SENSOR.mjSENS_BALLANGVEL, OBJECT.mjOBJ_JOINT, "rear"),),
        ball="rear",
        lateral=0,
        counterparts={"left": "right", "right": "left"},
    ),
    "Doggo": Robot(
        name="Doggo",
        timestep=0.01,
        height=0.22,
        planar=False,
        meets_itself=True,
        build=_build_doggo,
        actuate=_actuate_doggo,
        sensors=(
            *(
                (f"touch_{leg}{end}", SENSOR.mjSENS_TOUCH, OBJECT.mjOBJ_SITE, f"touch_{leg}{end}")
                for end in "ab"
                for leg in LEGS
            ),
            *((f"velocity_{name}", SENSOR.mjSENS_JOINTVEL, OBJECT.mjOBJ_JOINT, name) for name in _DOGGO_HINGES),
        ),
        hinges=_DOGGO_HINGES,
        counterparts=_doggo_counterparts(),
    ),
}
