"""For mkdocs: a fence named `math` holds a formula in LaTeX, as on GitHub, and becomes MathML.

Browsers draw MathML by themselves, so the pages load no script from elsewhere.
"""

from typing import Any

import latex2mathml.converter


def on_config(config: Any) -> Any:
    """Adds the fence. Called by mkdocs before the pages are read."""
    fences = config.mdx_configs.setdefault("pymdownx.superfences", {}).setdefault("custom_fences", [])
    fences.append({"name": "math", "class": "math", "format": formula})
    return config


def formula(source: str, *_: Any, **__: Any) -> str:
    """The MathML of a formula that stands on lines of its own."""
    return f"<div class='math'>{latex2mathml.converter.convert(source, display='block')}</div>"
