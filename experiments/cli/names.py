"""Names that come from elsewhere, of tasks, methods and hyperparameters, as names of files and folders."""

import re


def safe_name(text: str) -> str:
    """The text with `_` for every character that is not safe in a file's name.

    Safe are letters, digits and `_ . , = + @ -` and the blank. A colon, as in `package.module:make`, would end an entry
    of PYTHONPATH; a slash would choose another folder; and Orbax, which writes the checkpoints, takes a path with `[`
    for a pattern.
    """
    return re.sub(r"[^\w .,=+@-]", "_", text)
