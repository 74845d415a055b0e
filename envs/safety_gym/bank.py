"""Makes the bank of Button1 layouts: `python -m envs.safety_gym.bank` rewrites `button_layouts.npy` beside it."""

import argparse
from pathlib import Path

import jax
import numpy as np

from envs.safety_gym.layout import attempt, keepouts
from envs.safety_gym.tasks import TABLE

BATCH = 4096


def make_bank(size: int, seed: int) -> np.ndarray:
    """[size, 14, 2] float32: the layouts of the first `size` attempts that find a place for everything."""
    radii = keepouts(TABLE["PointButton1"])
    run = jax.jit(jax.vmap(lambda key: attempt(key, radii)))
    key, found, count = jax.random.key(seed), [], 0
    while count < size:
        key, batch_key = jax.random.split(key)
        layouts, complete = run(jax.random.split(batch_key, BATCH))
        found.append(np.asarray(layouts)[np.asarray(complete)])
        count += len(found[-1])
    return np.concatenate(found)[:size].astype(np.float32)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=20_000, help="layouts (default: 20000)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    path = Path(__file__).with_name("button_layouts.npy")
    np.save(path, make_bank(arguments.size, arguments.seed))
    print(f"{arguments.size} layouts written to {path}")


if __name__ == "__main__":
    main()
