"""Finds a Python object by its name in a text, and the name that a person probably meant.

Imports neither JAX nor any other package, so that command lines can check what they are given at once.
"""

import difflib
import importlib
import operator
import os
import re
import sys
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

_NAME = r"[^\W\d]\w*"
_FORM = re.compile(rf"({_NAME}(?:\.{_NAME})*):({_NAME}(?:\.{_NAME})*)")


def own_object(text: str) -> Any:
    """The object of this package, or of one that it needs, that "module:attribute" names. Imports the module."""
    module, _, attribute = text.partition(":")
    return getattr(importlib.import_module(module), attribute)


def parts(text: str) -> tuple[str, str]:
    """Module and attribute of "module:attribute". Raises `ValueError` where the text has another form."""
    form = _FORM.fullmatch(text)
    if form is None:
        raise ValueError(f"{text}: not of the form module:attribute; write for example my_package.tasks:make")
    return form[1], form[2]


def named_object(text: str) -> Any:
    """The object that a user's text names. Its module is imported.

    The module is looked for in the current folder first, as `python -m` does: where `sys.path` does not have that
    folder, it is put in front. It stays there, because the module may import its neighbours at a later time.

    Args:
        text: "module:attribute", for example "my_package.tasks:make". Both parts may have dots.

    Returns:
        The object, whatever it is.

    Raises:
        ValueError: the text has another form, there is no such module, its import raises an error, or it has no such
            attribute. The message is one line that says what to do.
    """
    module_name, attribute = parts(text)
    if not {"", os.getcwd()} & set(sys.path):
        sys.path.insert(0, os.getcwd())
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise ValueError(_failed(text, module_name, error)) from error
        raise ValueError(
            f"{text}: there is no module {error.name!r}; start in the folder that holds it, install it, "
            "or correct the name"
        ) from None
    except (Exception, SystemExit) as error:
        raise ValueError(_failed(text, module_name, error)) from error
    try:
        return operator.attrgetter(attribute)(module)
    except AttributeError:
        near = hint(attribute, (name for name in vars(module) if not name.startswith("_")))
        raise ValueError(
            f"{text}: module {module_name!r} has no attribute {attribute!r}; {near}define it there or correct the name"
        ) from None


def _failed(text: str, module: str, error: BaseException) -> str:
    reason = " ".join(str(error).split())
    return f"{text}: importing module {module!r} raised {type(error).__name__}: {reason}; correct that module"


def hint(name: str, names: Iterable[str] = (), *, spellings: Mapping[str, str] = MappingProxyType({})) -> str:
    """The question "did you mean ...? ", or nothing where no known name is near.

    Args:
        name: what a person wrote.
        names: the known names; of a mapping its keys.
        spellings: further spellings in lower case, each with the name that it stands for. Of equally near ones the
            first wins.
    """
    known = {**{spelling.casefold(): spelling for spelling in names}, **spellings}
    near = difflib.get_close_matches(name.casefold(), known, n=1, cutoff=0.6)
    return f"did you mean {known[near[0]]}? " if near else ""
