"""What launchers need to start processes of their own."""

import os
from pathlib import Path


def python_path() -> str:
    """The PYTHONPATH with which a new process imports the same packages of ours as this process."""
    return os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
