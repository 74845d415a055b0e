"""The versions of Python, of this package, and of the packages that results depend on."""

import importlib.metadata
import platform

from ccil_jax import __version__

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "gymnasium", "numpy")


def versions() -> dict[str, str]:
    """The versions of Python, of this package, and of those other packages that are installed, by name."""
    found = {"python": platform.python_version(), "ccil_jax": __version__}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
