"""Options: the parameters of a method as one frozen dataclass, read from text and written as text.

A method's module declares `Options`; each field is an `option` with its default and one line of help, or a
plain field with a default. Rows carry the canonical text: the options that differ from their defaults, in the
order of the fields, or `default`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from ded_bench.files.errors import InputError

#: The text of options that are all as declared.
DEFAULT = "default"
_TRUE, _FALSE, _NONE = "on", "off", "none"
_KINDS = {bool: f"{_TRUE} or {_FALSE}", int: "a whole number", float: "a number", str: "text without slashes"}

T = TypeVar("T")


@dataclass(frozen=True)
class NoOptions:
    """The options of a method that has none."""


def option(
    default: Any,
    text: str,
    *,
    choices: Sequence[str] = (),
    lowest: float = -math.inf,
    below: float = math.inf,
) -> Any:
    """Declare a field of an `Options` dataclass, of type bool, int, float, str, or one of these or None.

    Args:
        default: its value unless `--set` says otherwise.
        text: one line of help, with the unit.
        choices: the texts that a str may be.
        lowest, below: a number is at least the one and less than the other.
    """
    text += f"; one of {', '.join(choices)}" if choices else ""
    limits = {"choices": tuple(choices), "lowest": lowest, "below": below}
    return dataclasses.field(default=default, metadata={"text": text, **limits})


def read_options(kind: type[T], text: str) -> T:
    """Read `name=value` pairs separated by commas, or `default`.

    Raises:
        InputError: an unknown name (lists the known ones), or a value that is none of its kind.
    """
    hints = typing.get_type_hints(kind)
    known = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for part in [] if text in ("", DEFAULT) else text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if name not in known:
            listed = f"known: {', '.join(known)}" if known else "this method has none"
            raise InputError("--set", name or repr(part), f"no such option ({listed})")
        if not equals:
            raise InputError("--set", name, "needs a value: NAME=VALUE")
        if name in values:
            raise InputError("--set", name, "is set twice")
        values[name] = _value(known[name], hints[name], value)
    return kind(**values)


def options_text(options: Any) -> str:
    """The canonical text of a method's options, an instance of its `Options`."""
    parts = []
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if value != field.default:
            parts.append(f"{field.name}={_text(value)}")
    return ",".join(parts) or DEFAULT


def described(kind: type[Any]) -> list[tuple[str, str, str]]:
    """Name, default and help of every option, as texts."""
    return [(f.name, _text(f.default), f.metadata.get("text", "")) for f in dataclasses.fields(kind)]


def _value(field: dataclasses.Field[Any], hint: Any, text: str) -> Any:
    kinds = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if types.NoneType in kinds and text == _NONE:
        return None
    kind = next(k for k in kinds if k is not types.NoneType)
    choices = field.metadata.get("choices", ())
    lowest, below = field.metadata.get("lowest", -math.inf), field.metadata.get("below", math.inf)
    try:
        value = {_TRUE: True, _FALSE: False}[text] if kind is bool else kind(text)
        is_number = kind in (int, float)
        in_a_path = text.isprintable() and not set(text) & set("/\\")
        fits = lowest <= value < below and math.isfinite(value) if is_number else in_a_path
        if not fits or (choices and value not in choices):
            raise ValueError(text)
    except (KeyError, ValueError):
        wanted = f"one of {', '.join(choices)}" if choices else _KINDS.get(kind, kind.__name__)
        wanted += f" of at least {lowest:g}" if math.isfinite(lowest) else ""
        wanted += f" and less than {below:g}" if math.isfinite(below) else ""
        raise InputError("--set", field.name, f"{text[:40]!r} is not {wanted}") from None
    return value + 0 if kind in (int, float) else value  # no -0


def _text(value: Any) -> str:
    if value is None:
        return _NONE
    if isinstance(value, bool):
        return _TRUE if value else _FALSE
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)
