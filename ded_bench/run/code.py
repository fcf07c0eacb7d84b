"""Which code made a result: a hash over the sources that it depends on."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path

import ded_bench
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.registry import Method

_PACKAGE = Path(ded_bench.__file__).parent
_WITH_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@functools.cache
def code_of(module: str) -> str:
    """Twelve hex digits over a module of this package and all of its modules that it imports, however far.

    Comments, docstrings and layout do not count, nor do imports that only type checkers see.
    """
    found: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name], imported = _module(name)
            waiting += imported
    text = "\n".join(f"{name} {found[name]}" for name in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def code_of_method(method: Method, settings: str, artifacts: tuple[Artifact, ...] = ()) -> str:
    """The code of one of our methods under some settings, or what one of others says of its own.

    Args:
        method: the method.
        settings: their name, or their slug in the results.
        artifacts: what the answers depend on.
    """
    foreign = [artifact.fingerprint for artifact in artifacts if artifact.kind == "code"]
    module = method.module_of(settings)
    return code_of(module) if _path(module) else "-".join(foreign)


def named(artifacts: Iterable[Artifact], kind: str) -> str:
    """The models, or the policies, that shaped an answer, as rows say it: `name@fingerprint`, joined by +."""
    return "+".join(f"{a.name}@{a.fingerprint}" for a in artifacts if a.kind == kind)


def content_of(source: str) -> str:
    """What a source says, without comments, docstrings and layout; the same in every version of Python."""
    return _text(ast.parse(source))


def imports_of(source: str, package: str) -> Iterator[str]:
    """Dotted names that a source imports when it runs; `from a import b` gives `a` and `a.b`.

    Args:
        package: where the source lies, for relative imports.
    """
    for node in _run(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


@functools.cache
def _module(name: str) -> tuple[str, tuple[str, ...]]:
    """Hash of one module, and the modules of the package that it imports."""
    path = _path(name)
    if path is None:
        raise ModuleNotFoundError(name)
    source = path.read_text(encoding="utf-8")
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    imported = tuple(sorted({other for other in imports_of(source, package) if _path(other)}))
    return hashlib.sha256(content_of(source).encode()).hexdigest(), imported


@functools.cache
def _path(name: str) -> Path | None:
    """File of a module below this package; None for what is none."""
    root, _, rest = name.partition(".")
    if root != "ded_bench" or not rest:
        return None
    place = _PACKAGE.joinpath(*rest.split("."))
    choices = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in choices if path.is_file()), None)


def _run(node: ast.AST) -> Iterator[ast.AST]:
    """A node and all below it, but not what stands under `if TYPE_CHECKING`."""
    yield node
    below = list(ast.iter_child_nodes(node))
    if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
        below = list(node.orelse)
    for child in below:
        yield from _run(child)


def _text(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if not isinstance(value, ast.AST):
        return repr(value)
    fields = dict(ast.iter_fields(value))
    if isinstance(value, _WITH_DOCSTRING) and ast.get_docstring(value, clean=False) is not None:
        fields["body"] = value.body[1:]
    said = [f"{name}={_text(field)}" for name, field in fields.items() if field not in (None, [])]
    return f"{type(value).__name__}({', '.join(said)})"
