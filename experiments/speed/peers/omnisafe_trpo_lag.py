"""Steps per second of TRPO-Lagrangian in OmniSafe on PointGoal1. Runs in that package's own environment; prints JSON.

Epochs have 2000 steps; all other settings are the defaults of the package.

    python omnisafe_trpo_lag.py SIMULATIONS THREADS EPOCHS
"""

import contextlib
import csv
import json
import pathlib
import sys
import tempfile
from importlib.metadata import version

import omnisafe

BATCH_SIZE = 2000


def main(num_envs: int, num_threads: int, num_epochs: int) -> None:
    """Trains some epochs. The first one is not counted, because it includes the setup."""
    with tempfile.TemporaryDirectory() as folder:
        config = {
            "train_cfgs": {
                "total_steps": BATCH_SIZE * num_epochs,
                "vector_env_nums": num_envs,
                "torch_threads": num_threads,
                "device": "cpu",
            },
            "algo_cfgs": {"steps_per_epoch": BATCH_SIZE},
            "logger_cfgs": {"use_wandb": False, "use_tensorboard": False, "log_dir": folder, "save_model_freq": 10**6},
        }
        with contextlib.redirect_stdout(sys.stderr):
            omnisafe.Agent("TRPOLag", "SafetyPointGoal1-v0", custom_cfgs=config).learn()
        (path,) = pathlib.Path(folder).rglob("progress.csv")
        with path.open(newline="") as file:
            seconds = [float(row["Time/Total"]) for row in csv.DictReader(file)]
    rate = BATCH_SIZE * (len(seconds) - 1) / (seconds[-1] - seconds[0])
    packages = ("omnisafe", "safety-gymnasium", "torch", "gymnasium", "mujoco", "numpy")
    print(json.dumps({"steps_per_second": rate, "versions": {name: version(name) for name in packages}}))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
