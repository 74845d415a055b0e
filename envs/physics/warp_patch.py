"""MJX-Warp's friction frames of plane-capsule contacts, corrected as in `mjx_patch.py`, and what Warp prints."""
# mypy: ignore-errors
# (What Warp compiles is Python by its looks only.)

import importlib
from typing import Any

import warp as wp

_WARP = "mujoco.mjx.third_party.mujoco_warp._src"
_core: Any = importlib.import_module(f"{_WARP}.collision_primitive_core")
_plane_capsule = _core.plane_capsule


def align_plane_capsule_frames() -> None:
    """Puts `_aligned` where MJX-Warp's kernels find their plane-capsule routine. Idempotent.

    Warp compiles kernels at their first launch, so it must be called before any. Each capsule of this process is
    affected, also in other code.

    Raises:
        RuntimeError: MJX-Warp is not the one that this correction was written for.
    """
    primitive: Any = importlib.import_module(f"{_WARP}.collision_primitive")
    if getattr(primitive, "plane_capsule", None) not in (_plane_capsule, _aligned):
        raise RuntimeError(
            "MJX-Warp has another plane-capsule routine than mujoco-mjx 3.17: review envs/physics/warp_patch"
        )
    primitive.plane_capsule = _aligned


def say_less() -> None:
    """Where nobody has chosen Warp's log level: no more lines about its set-up and each of its dozens of modules."""
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
