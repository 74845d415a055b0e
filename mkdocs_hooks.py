"""For mkdocs: formulas and notebooks.

A fence named `math` holds a formula in LaTeX, as on GitHub, and becomes MathML, which browsers draw by themselves. A
notebook becomes a page, with the outputs that are stored in it. So the pages load nothing from elsewhere.
"""

from pathlib import PurePosixPath
from typing import Any

import latex2mathml.converter
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter


def on_config(config: Any) -> Any:
    """Adds the fence. Called by mkdocs before the pages are read."""
    fences = config.mdx_configs.setdefault("pymdownx.superfences", {}).setdefault("custom_fences", [])
    fences.append({"name": "math", "class": "math", "format": formula})
    return config


def formula(source: str, *_: Any, **__: Any) -> str:
    """The MathML of a formula that stands on lines of its own."""
    return f"<div class='math'>{latex2mathml.converter.convert(source, display='block')}</div>"


def on_files(files: Any, config: Any) -> Any:
    """Adds a page for each notebook, and the figures in it as files beside that page."""
    for notebook in [file for file in files if file.src_uri.endswith(".ipynb")]:
        uri = PurePosixPath(notebook.src_uri)
        text, resources = MarkdownExporter().from_filename(
            notebook.abs_src_path, resources={"output_files_dir": f"{uri.stem}_files"}
        )
        text = text.replace("![png](", "![What the lines above draw](")
        files.append(File.generated(config, str(uri.with_suffix(".md")), content=text))
        for name, content in resources["outputs"].items():
            files.append(File.generated(config, str(uri.parent / name), content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Lets links to a notebook, which GitHub shows, lead to its page."""
    return markdown.replace(".ipynb)", ".md)")
