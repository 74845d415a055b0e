"""Compares trees of arrays."""

import jax
import jax.numpy as jnp

from ccil_jax.types import PyTree


def difference(wanted: PyTree, found: PyTree) -> str:
    """How `found` differs from `wanted` in its structure, or in the shape or dtype of a leaf; "" where it does not."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(wanted)
    others, other_structure = jax.tree.flatten(found)
    if str(structure) != str(other_structure):
        return "its parts have other names, or there are more or fewer of them"
    for (path, leaf), other in zip(leaves, others, strict=True):
        before, after = (f"{jnp.result_type(array)}{list(jnp.shape(array))}" for array in (leaf, other))
        if before != after:
            return f"{jax.tree_util.keystr(path, simple=True, separator='.') or 'it'} is {after}, not {before}"
    return ""
