"""What meets what on MJX in place of cylinders (`envs.safety_gym.scene`) touches where C MuJoCo's cylinders touch."""

from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from envs.physics.mjx import import_mjx, read
from envs.safety_gym import scene
from envs.safety_gym.tasks import TABLE

pytestmark = pytest.mark.once

GEOM = mujoco.mjtGeom
NUM_POSES = 256
Geom = tuple[Any, list[float]]  # type and size
SPHERE, BALL = (GEOM.mjGEOM_SPHERE, [0.05, 0, 0]), (GEOM.mjGEOM_SPHERE, [0.1, 0, 0])  # Car's rear; Point, button
VASE, ARROW = (GEOM.mjGEOM_BOX, [0.1] * 3), (GEOM.mjGEOM_BOX, [0.05] * 3)
BUMPER, PUSH_BOX = (GEOM.mjGEOM_BOX, [0.1, 0.01, 0.05]), (GEOM.mjGEOM_BOX, [0.2] * 3)
WHEEL, TORSO = (GEOM.mjGEOM_CYLINDER, [0.05, 0.025, 0]), (GEOM.mjGEOM_CYLINDER, [0.0375, 0.05, 0])
PILLAR = (GEOM.mjGEOM_CYLINDER, [0.2, 0.5, 0])


def pair(first: Geom, second: Geom) -> mujoco.MjModel:
    """The first geom at the origin, the second on a free body. A mesh is the prism for a cylinder of that size."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for holder, (kind, size) in ((spec.worldbody, first), (body, second)):
        if kind == GEOM.mjGEOM_MESH:
            holder.add_geom(type=kind, meshname=scene._add_prism(spec, size[0], size[1]))
        else:
            holder.add_geom(type=kind, size=size)
    return spec.compile()


def prism(cylinder: Geom) -> Geom:
    return GEOM.mjGEOM_MESH, cylinder[1]


def capsule(cylinder: Geom) -> Geom:
    return GEOM.mjGEOM_CAPSULE, cylinder[1]


def nearest_in_c(model: mujoco.MjModel, poses: np.ndarray) -> np.ndarray:
    """[N] signed distance of the two geoms, at most 1 m."""
    data, points = mujoco.MjData(model), np.zeros(6)
    distances = []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        distances.append(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, points))
    return np.array(distances)


def deepest_on_mjx(model: mujoco.MjModel, poses: np.ndarray) -> np.ndarray:
    """[N] least distance of MJX's contact points."""
    mjx = import_mjx()
    put, template = mjx.put_model(model), mjx.make_data(model)

    @jax.jit
    @jax.vmap
    def deepest(qpos: jax.Array) -> jax.Array:
        data = mjx.collision(put, mjx.kinematics(put, template.replace(qpos=qpos)))
        return read(data, "contact").dist.min()

    return np.asarray(deepest(poses.astype(np.float32)))


def poses_near(distance: np.ndarray, upright: bool, height: float, random: np.random.Generator) -> np.ndarray:
    """Poses [N, 7]: centres at horizontal (upright) or any (not) directions and such distances from the origin."""
    direction = random.standard_normal((len(distance), 3))
    quat = random.standard_normal((len(distance), 4))
    if upright:
        direction[:, 2], quat[:, 1:3] = 0.0, 0.0
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    place = distance[:, None] * direction + [0, 0, height]
    return np.concatenate([place, quat], axis=1)


def rolling(distance: np.ndarray, height: float, random: np.random.Generator) -> np.ndarray:
    """Poses [N, 7] of a cylinder whose axis is level, at such horizontal distances from the origin."""
    quats = [np.zeros(4) for _ in distance]
    for quat, yaw, roll in zip(quats, *random.uniform(0, np.pi, (2, len(distance))), strict=True):
        level, turned = np.zeros(4), np.array([np.cos(yaw), 0, 0, np.sin(yaw)])
        mujoco.mju_mulQuat(level, turned, np.sqrt([0.5, 0, 0.5, 0]))
        mujoco.mju_mulQuat(quat, level, np.array([np.cos(roll), 0, 0, np.sin(roll)]))
    poses = poses_near(distance, upright=True, height=height, random=random)
    poses[:, 3:] = quats
    return poses


def compare(wanted: tuple[Geom, Geom], taken: tuple[Geom, Geom], poses: np.ndarray, slack: float) -> float:
    """Share of the clear cases, off by more than `slack` m, in which MJX with `taken` and C with `wanted` disagree."""
    there, here = nearest_in_c(pair(*wanted), poses), deepest_on_mjx(pair(*taken), poses)
    clear = np.abs(there) > slack
    assert 50 < (there < 0).sum() < 220
    return float(np.mean((here < 0)[clear] != (there < 0)[clear]))


# A prism of 16 sides with the circle's area: its edges stick out by 1.3 % of the radius, its sides lie 0.65 % in.
@pytest.mark.parametrize("cylinder", [WHEEL, TORSO], ids=["wheel", "torso"])
def test_prisms_meet_boxes_as_cylinders_do(cylinder: Geom) -> None:
    random = np.random.default_rng(0)
    poses = poses_near(random.uniform(0.1, 0.24, NUM_POSES), upright=False, height=0.0, random=random)
    assert compare((cylinder, VASE), (prism(cylinder), VASE), poses, slack=0.015 * cylinder[1][0]) == 0


@pytest.mark.parametrize("cylinder", [WHEEL, TORSO], ids=["wheel", "torso"])
def test_cylinders_meet_balls(cylinder: Geom) -> None:
    """MJX's own routine; a shallow contact may be missed."""
    random = np.random.default_rng(0)
    poses = rolling(random.uniform(0.08, 0.17, NUM_POSES), 0.05, random)
    assert compare((BALL, cylinder), (BALL, cylinder), poses, slack=1e-4) <= 0.01
    assert compare((BALL, cylinder), (BALL, cylinder), poses, slack=2e-3) == 0


@pytest.mark.parametrize("other", [ARROW, BUMPER, PUSH_BOX], ids=["arrow", "bumper", "push box"])
def test_the_pillars_prism_meets_boxes(other: Geom) -> None:
    random = np.random.default_rng(0)
    reach = PILLAR[1][0] + float(np.mean(other[1][:2]))
    distance = random.uniform(reach - 0.05, reach + 0.1, NUM_POSES)
    poses = poses_near(distance, upright=True, height=other[1][2] - PILLAR[1][1], random=random)
    assert compare((PILLAR, other), (prism(PILLAR), other), poses, slack=0.015 * PILLAR[1][0]) == 0


def test_the_pillars_prism_meets_wheels() -> None:
    random = np.random.default_rng(0)
    poses = rolling(random.uniform(0.2, 0.3, NUM_POSES), 0.05 - PILLAR[1][1], random)
    assert compare((PILLAR, WHEEL), (prism(PILLAR), prism(WHEEL)), poses, slack=0.02 * PILLAR[1][0]) == 0


@pytest.mark.parametrize("other", [BALL, SPHERE], ids=["Point", "Car's rear"])
def test_the_pillars_capsule_meets_spheres(other: Geom) -> None:
    random = np.random.default_rng(0)
    distance = PILLAR[1][0] + other[1][0] + random.uniform(-0.05, 0.05, NUM_POSES)
    poses = poses_near(distance, upright=True, height=other[1][0] - PILLAR[1][1], random=random)
    assert compare((PILLAR, other), (capsule(PILLAR), other), poses, slack=1e-5) == 0


# What MJX 3.17 lacks or does badly. A capsule and a box face along it: every second contact is missed.
AVOIDED = {("CYLINDER", "BOX"), ("CYLINDER", "MESH"), ("CYLINDER", "CAPSULE"), ("SPHERE", "MESH"), ("PILLAR", "BOX")}


@pytest.mark.parametrize("name", list(TABLE))
def test_the_same_bodies_can_touch_on_mjx_through_shapes_that_it_can_do(name: str) -> None:
    found = []
    for prisms in (False, True):
        model = scene.build(TABLE[name], prisms=prisms).model
        bodies, shapes = set(), set()
        for i in range(model.ngeom):
            for j in range(i):
                a, b = model.geom_bodyid[i], model.geom_bodyid[j]
                acts = (
                    model.geom_contype[i] & model.geom_conaffinity[j]
                    | model.geom_contype[j] & model.geom_conaffinity[i]
                )
                if a != b and acts:
                    bodies.add(tuple(sorted((model.body(a).name, model.body(b).name))))
                    shapes.add(tuple(shape(model, k) for k in (i, j)))
        found.append(bodies)
    assert found[0] == found[1]
    assert not [both for both in shapes if both in AVOIDED or both[::-1] in AVOIDED]


def shape(model: mujoco.MjModel, geom: int) -> str:
    kind = str(GEOM(model.geom_type[geom]).name.removeprefix("mjGEOM_"))
    return "PILLAR" if kind == "CAPSULE" and model.body(model.geom_bodyid[geom]).name.startswith("pillar") else kind
