"""Names as data: runs get labels that tell them apart, and no name is taken for markup."""

from collections.abc import Sequence
from pathlib import Path


def literal(text: str) -> str:
    """A text that matplotlib draws as it is: no mathematics between dollars, no characters without a shape.

    A label that begins with an underscore is left out of legends unless it is handed to `legend` itself.
    """
    return "".join(c if c.isprintable() else "?" for c in text).replace("$", r"\$")


def distinct_names(folders: Sequence[Path]) -> list[str]:
    """For each of several different folders the shortest end of its real path that none of the others has."""
    parts = [folder.resolve().parts for folder in folders]

    def shared(own: tuple[str, ...], length: int) -> bool:
        return sum(other[-length:] == own[-length:] for other in parts) > 1

    lengths = [next((k for k in range(1, len(own)) if not shared(own, k)), len(own)) for own in parts]
    return [str(Path(*own[-length:])) for own, length in zip(parts, lengths, strict=True)]
