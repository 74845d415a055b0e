"""Corrects MJX-Warp's friction frames of plane-capsule contacts as `mjx_patch.py` does MJX's; makes Warp print less."""
# mypy: ignore-errors
# (Warp compiles functions of its own language, which only looks like Python.)

import importlib
from typing import Any

import warp as wp

_WARP = "mujoco.mjx.third_party.mujoco_warp._src"
_core: Any = importlib.import_module(f"{_WARP}.collision_primitive_core")
_plane_capsule = _core.plane_capsule


def align_plane_capsule_frames() -> None:
    """Puts `_aligned` where MJX-Warp's kernels look for their plane-capsule routine. A second call changes nothing.

    Warp compiles a kernel when it is launched for the first time, so call this before any launch. It affects all
    capsules in this process, also those of other code.

    Raises:
        RuntimeError: MJX-Warp is not of the version that this correction was written for.
    """
    primitive: Any = importlib.import_module(f"{_WARP}.collision_primitive")
    if getattr(primitive, "plane_capsule", None) not in (_plane_capsule, _aligned):
        raise RuntimeError(
            "MJX-Warp has another plane-capsule routine than mujoco-mjx 3.17: review envs/physics/warp_patch"
        )
    primitive.plane_capsule = _aligned


def say_less() -> None:
    """Stops Warp from printing a line for each of its dozens of modules, unless somebody has set its log level."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


@wp.func
def _aligned(  # Warp infers what its functions return
    normal: wp.vec3, plane_pos: wp.vec3, capsule_pos: wp.vec3, axis: wp.vec3, radius: float, half_length: float
):
    dist, pos, frame = _plane_capsule(normal, plane_pos, capsule_pos, axis, radius, half_length)
    tangent = axis - normal * wp.dot(normal, axis)
    norm = wp.length(tangent)
    if norm > 1.0e-9:
        tangent = tangent / norm
        frame = wp.matrix_from_rows(normal, tangent, wp.cross(normal, tangent))
    return dist, pos, frame
