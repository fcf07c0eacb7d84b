"""The API reference as HTML, from docstrings and types: `make docs`, or python docs/reference.py FOLDER."""

import importlib
import sys
from pathlib import Path

import pdoc

MODULES = "ded_bench", "ded_bench.learning", "ded_bench.gym"


def build(folder: Path) -> None:
    """Write the pages of what is public; its names are imported first, which a module does when asked."""
    for module in map(importlib.import_module, MODULES):
        vars(module).update({name: getattr(module, name) for name in module.__all__})
    pdoc.render.configure(
        docformat="google", show_source=False, footer_text="powers in pu of 100 MVA, times in s, ω in rad/s"
    )
    pdoc.pdoc(*MODULES, output_directory=folder)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
