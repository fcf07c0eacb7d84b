"""The API reference tells of every public name its types, and of what has numbers shapes and units."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pdoc
import pytest

from ded_bench.problem.case import REPOSITORY

ARRAY, NUMBER = re.compile(r"\b(ndarray|Tensor|SX)\b"), re.compile(r"\bfloat\b")
#: As in (n_t, n_gen), (n,), (..., n_load), "any shape".
SHAPE = re.compile(r"\((\w+|\.\.\.)( \+ \w+)?,[^()]*\)|any shape")
UNIT = re.compile(r"(?<!['’])\b(pu|s|Hz|rad|[Cc]osts?|units|parts)\b")
#: In names.
NAMED_UNIT = re.compile(r"_(s|hz|pu|rad|pu_per_s)$")
ARGUMENT = re.compile(r"^    ([\w, ]+): (.*(?:\n     .*)*)", re.MULTILINE)


def lacking(name: str, kind: str, text: str) -> Iterator[str]:
    """What a reader would ask about a value of a type."""
    if ARRAY.search(kind) and not SHAPE.search(text):
        yield f"{name}: which shape?"
    if (ARRAY.search(kind) or NUMBER.search(kind)) and not (UNIT.search(text) or NAMED_UNIT.search(name)):
        yield f"{name}: which unit?"


def section(docstring: str, title: str) -> str:
    """Of a docstring in Google's style; without its lists for an empty title."""
    parts = re.split(r"^(Args|Attributes|Returns|Raises):\n", docstring, flags=re.MULTILINE)
    return dict(zip(["", *parts[1::2]], parts[::2], strict=True)).get(title, "")


def arguments(functions: dict[str, str], docstring: str) -> dict[str, str]:
    """What is said of each argument, there or where the docstring refers to."""
    found = {}
    for names, text in ARGUMENT.findall(section(docstring, "Args")):
        other = re.match(r"(?:as for|see) `(\w+)`", text)
        known = arguments(functions, functions[other[1]]) if other else {}
        found |= {name: f"{text} {known.get(name, '')}" for name in names.split(", ")}
    return found


def of(doc: pdoc.doc.Doc, functions: dict[str, str]) -> Iterator[str]:
    """What somebody would ask who reads of a public name."""
    return of_class(doc, functions) if isinstance(doc, pdoc.doc.Class) else of_function(doc, functions, "")


def of_function(doc: pdoc.doc.Function, functions: dict[str, str], about: str) -> Iterator[str]:
    """What somebody would ask who reads of a function; `about` is what its class says."""
    said, name, given = doc.docstring or about, doc.fullname, doc.signature.parameters
    if not said:
        yield f"{name}: what does it do?"
    known, head = arguments(functions, said), section(doc.docstring, "")
    for own, parameter in ((f"{name}, {p.name}", p) for p in given.values() if p.name != "self"):
        if parameter.annotation is inspect.Parameter.empty:
            yield f"{own}: which type?"
        if len(given) > 3 and not re.search(rf"\b{parameter.name}\b", said):
            yield f"{own}: what is it?"
        kind = inspect.formatannotation(parameter.annotation)
        yield from lacking(own, kind, known.get(parameter.name, head))
    if doc.name != "__init__":
        answer = section(doc.docstring, "Returns") or head
        answer += about if "as the class says" in answer else ""
        yield from lacking(f"{name} ->", inspect.formatannotation(doc.signature.return_annotation), answer)


def of_class(doc: pdoc.doc.Class, functions: dict[str, str]) -> Iterator[str]:
    """What somebody would ask who reads of a class, its fields and functions."""
    about = doc.docstring
    if not about:
        yield f"{doc.fullname}: what is it?"
    for part in doc.members.values():
        by_fields = part.name == "__init__" and hasattr(doc.obj, "__dataclass_fields__")
        hidden = part.name.startswith("_") and part.name != "__init__"
        if by_fields or hidden or not part.taken_from[0].startswith("ded_bench"):
            continue
        if isinstance(part, pdoc.doc.Function):
            yield from of_function(part, functions, about)
        else:
            own = f"{part.docstring} {about}" if f"`{part.name}`" in about else part.docstring
            yield from lacking(part.fullname, part.annotation_str, own)


@pytest.mark.filterwarnings("ignore:.*pd.DataFrame")  # what only type checkers import
def test_nothing_is_left_to_ask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """On the pages of `make docs`, of any public name."""
    for where in (inspect, pdoc.doc):
        monkeypatch.setattr(where, "formatannotation", where.formatannotation)  # which the script changes
    monkeypatch.setattr(pdoc.doc_ast, "get_source", pdoc.doc_ast.get_source)
    monkeypatch.syspath_prepend(str(REPOSITORY / "docs"))
    reference = importlib.import_module("reference")
    reference.build(tmp_path)
    public = []
    for module in reference.modules():
        page = (tmp_path / f"{module.fullname.replace('.', '/')}.html").read_text(encoding="utf-8")
        for name in module.obj.__all__:
            assert f'id="{name}"' in page, name
            public.append(module.members[name])
    functions = {doc.name: doc.docstring for doc in public}
    assert [question for doc in public for question in of(doc, functions)] == []
