"""Options: read from text, written as text; every mistake is told with the names there are."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from ded_bench.cli.commands import main
from ded_bench.files.errors import InputError
from ded_bench.methods.options import described, option, options_text, read_options
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings


@dataclass(frozen=True)
class Options:
    steps: int = option(3, "of something", lowest=1)
    margin: float = option(0.5, "part of the bound", lowest=0.0, below=1.0)
    length_s: float | None = option(None, "s")
    solver: str = option("a", "which", choices=("a", "b"))
    fast: bool = option(False, "or slow")
    plain: float = 2.0


@dataclass(frozen=True)
class Named:
    path: str = ""


def test_what_differs_from_the_defaults_is_the_canonical_text() -> None:
    """In the order of the fields, however it was written; read again it is the same."""
    for text, canonical in [
        ("default", "default"),
        ("", "default"),
        ("steps=3,fast=off,length_s=none", "default"),
        ("fast=on, steps=7", "steps=7,fast=on"),
        ("length_s=0.10,plain=3.0,solver=b", "length_s=0.1,solver=b,plain=3"),
        ("margin=-0", "margin=0"),
    ]:
        options = read_options(Options, text)
        assert options_text(options) == canonical
        assert read_options(Options, canonical) == options


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("stops=3", "stops: no such option (known: steps, margin, length_s, solver, fast, plain)"),
        ("steps", "steps: needs a value"),
        ("steps=2,steps=3", "is set twice"),
        ("steps=2.5", "'2.5' is not a whole number of at least 1"),
        ("steps=0", "is not a whole number of at least 1"),
        ("margin=1", "is not a number of at least 0 and less than 1"),
        ("plain=nan", "is not a number"),
        ("solver=c", "is not one of a, b"),
        ("fast=yes", "is not on or off"),
        ("=", "no such option"),
    ],
)
def test_mistakes_are_told(text: str, told: str) -> None:
    with pytest.raises(InputError) as caught:
        read_options(Options, text)
    assert told in str(caught.value)


def test_a_description_has_every_option() -> None:
    assert described(Options)[0] == ("steps", "3", "of something")
    assert described(Options)[3] == ("solver", "a", "which; one of a, b")
    assert described(Options)[-1] == ("plain", "2", "")


def test_settings_of_a_method_are_canonical(monkeypatch: pytest.MonkeyPatch) -> None:
    assert get_method("ed").canonical(Settings("lead=on, every=60.0")).options == "every=60,lead=on"
    monkeypatch.setattr("ded_bench.methods.ed.Options", Named)
    with pytest.raises(InputError, match="path: 'a/b' is not text without slashes"):
        get_method("ed").canonical(Settings("path=a/b"))


def test_the_command_describes_one_method(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "ed"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].split() == ["ed", "ED"]
    assert told[1].split()[0] == "every=none"
    assert main(["methods", "magic"]) == 2


def test_options_are_of_one_method(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "--method", "ed,ded-slp", "--set", "every=10"]) == 2
    assert "--set: every=10: needs exactly one --method" in capsys.readouterr().err
