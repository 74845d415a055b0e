"""What is wrong with a user's input: one family of errors, whose messages say what is wrong and what to do.

A launcher reports any of them as one line, with exit status 2 and without a traceback.
"""

import re

_OPTION = re.compile(r"--([a-z]\w*)")


class UserError(ValueError):
    """Wrong input. The message names the file, the field or the option, and the remedy."""

    def on_command_line(self) -> str:
        """The message for somebody who types options."""
        return str(self)


class ConfigError(UserError):
    """A configuration that cannot run.

    The message is written once, with each field as an option: `--max_kl 0: the policy could never move`. In Python it
    names the field, `max_kl 0: ...`, and on the command line the option, `--max-kl 0: ...`.
    """

    def __str__(self) -> str:
        return _OPTION.sub(r"\1", str(self.args[0]))

    def on_command_line(self) -> str:
        """The message with options instead of fields."""
        return _OPTION.sub(lambda found: "--" + found[1].replace("_", "-"), str(self.args[0]))


class DemonstrationsError(UserError):
    """A file of demonstrations that cannot be used."""


class CheckpointError(UserError):
    """Checkpoints that cannot be read, written or continued."""


class LockedError(UserError):
    """A folder that another process writes to. The message names both."""
