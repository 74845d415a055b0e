"""Labels of runs: names that differ, drawn as they are written."""

from collections.abc import Sequence
from pathlib import Path


def literal(text: str) -> str:
    """The text for matplotlib, which draws it as it is: dollar signs are escaped, unprintable characters are `?`."""
    return "".join(c if c.isprintable() else "?" for c in text).replace("$", r"\$")


def distinct_names(folders: Sequence[Path]) -> list[str]:
    """A name for each of several folders: the shortest end of its real path in which it differs from all others."""
    parts = [folder.resolve().parts for folder in folders]

    def shared(own: tuple[str, ...], length: int) -> bool:
        return sum(other[-length:] == own[-length:] for other in parts) > 1

    lengths = [next((k for k in range(1, len(own)) if not shared(own, k)), len(own)) for own in parts]
    return [str(Path(*own[-length:])) for own, length in zip(parts, lengths, strict=True)]
