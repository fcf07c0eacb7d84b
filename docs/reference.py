"""The API reference as HTML, from docstrings and types: `make docs`, or python docs/reference.py FOLDER."""

import contextlib
import importlib
import inspect
import re
import sys
import typing
from pathlib import Path

import pdoc

MODULES = "ded_bench", "ded_bench.learning", "ded_bench.gym"
FOOTER = "powers in pu of 100 MVA, times in s, ω in rad/s, costs per pu and point of time"
ARRAY = re.compile(r"numpy\.ndarray\[tuple\[typing\.Any, \.\.\.\], numpy\.dtype\[numpy\.(\w+)\]\]")
source, type_text = pdoc.doc_ast.get_source, pdoc.doc.formatannotation


def with_comments(of):
    """Source in which the comment of a class's field is its docstring, which is what pdoc shows."""
    field = re.compile(r"^( +)(\w+: [^#\n]*[^#\n,])  # (.*)$", re.MULTILINE)
    return field.sub(r'\1\2\n\1"""\3"""', source(of)) if inspect.isclass(of) else source(of)


def plain(kind):
    """A type as text, without what pydantic checks and what NumPy repeats."""
    with contextlib.suppress(NameError):  # of what is imported for type checkers only
        kind = typing.get_type_hints(type("", (), {"__annotations__": {"of": kind}}))["of"]
    return ARRAY.sub(r"numpy.ndarray[\1]", type_text(kind))


def modules():
    """What is public, as pdoc sees it; names are imported first, which a module does when asked."""
    known = [importlib.import_module(name) for name in MODULES]
    for module in known:
        vars(module).update({name: getattr(module, name) for name in module.__all__})
    pdoc.doc_ast.get_source = with_comments
    pdoc.doc.formatannotation = inspect.formatannotation = plain
    return [pdoc.doc.Module(module) for module in known]


def build(folder: Path) -> None:
    """Write the pages."""
    modules()
    pdoc.render.configure(docformat="google", show_source=False, footer_text=FOOTER)
    pdoc.pdoc(*MODULES, output_directory=folder)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
