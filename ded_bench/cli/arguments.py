"""What the `ded-bench` commands accept and say: options, defaults, help, lines on stderr."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from ded_bench.files.errors import InputError
from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.problem.benchmark import SPLITS
from ded_bench.surrogates.find import MODELS

#: The shipped case that is meant where none is named.
DEFAULT_CASE = "9bus"
RESULTS_HELP = "results folder; default: results/<case>"
CASE_HELP = "name of a shipped case, or a folder"
METHOD_HELP = "see `ded-bench methods`; or module:function"
MODEL_HELP = f"{', '.join(MODELS)}, or a file"


def names(text: str) -> tuple[str, ...]:
    """Read names separated by commas, each once."""
    found = tuple(part.strip() for part in text.split(",") if part.strip())
    if not found:
        raise argparse.ArgumentTypeError("names nothing")
    return tuple(dict.fromkeys(found))


def _number(
    kind: Callable[[str], float], low: float, said: str, top: float = math.inf
) -> Callable[[str], Any]:
    """What reads a finite number from `low` to `top`."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = -1
        if not (low <= value <= top and value < math.inf):
            raise argparse.ArgumentTypeError(f"{text!r} is not {said}")
        return value

    return read


natural = _number(int, 0, "a whole number")
positive = _number(int, 1, "a whole number of at least 1")
not_negative = _number(float, 0, "a number from 0 to 1e6", 1e6)
share = _number(float, sys.float_info.min, "a number above 0, below 1", 1.0 - 1e-9)
positive_number = _number(float, sys.float_info.min, "a number above 0, at most 1e6", 1e6)

#: Options that commands share (see `declare`).
SHARED: dict[str, dict[str, Any]] = {
    "--case": {"default": DEFAULT_CASE, "help": CASE_HELP},
    "--regime": {"type": names, "metavar": "R[,R]", "help": "default: all of the case"},
    "--set": {"default": DEFAULT, "metavar": "NAME=VALUE[,...]", "help": "options of the one method"},
    "--model": {"default": "", "help": f"{MODEL_HELP}; default: the method's own"},
    "--policy": {"type": Path, "help": "policy file; default: the trained one"},
    "--seed": {"type": natural, "default": 0, "help": "of what is drawn"},
    "--workers": {"type": positive, "default": 1, "metavar": "N", "help": "processes here"},
    "--results": {"type": Path, "help": RESULTS_HELP},
    "--out": {"type": Path, "help": RESULTS_HELP},
}
#: Under the list of commands, which must fit a terminal 80 columns wide.
ROAD = (
    "The road: instances, train-ko, solve, train-dpc, solve, bench, report; `make report` walks it. "
    "`ded-bench COMMAND --help` lists the options of one."
)


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        self.exit(2, f"{self.prog}: {in_one_line(message)} (`{self.prog} --help` lists what there is)\n")


class WithDefaults(argparse.RawDescriptionHelpFormatter):
    """Help of one command: every default is told once."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=79)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        is_none = default is None or default is False or default == argparse.SUPPRESS
        if is_none or "default:" in str(action.help):
            return action.help
        value = ",".join(default) if isinstance(default, tuple) else default
        return f"{action.help} (default: {value})"


class OneLinePerCommand(argparse.HelpFormatter):
    """Help with a line per command."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=16, width=79)
        self._action_max_length = 14  # argparse forgets that commands are indented once more


def command(commands: Any, name: str, text: str) -> Parser:
    """Add a command; `text` is its line in the list of commands."""
    made: Parser = commands.add_parser(
        name, help=text, description=f"{text[:1].upper()}{text[1:]}.", formatter_class=WithDefaults
    )
    made.set_defaults(task=text)
    return made


def declare(p: argparse._ActionsContainer, *options: str) -> None:
    """Declare some of the options that commands share."""
    for name in options:
        p.add_argument(name, **SHARED[name])


def add_methods(p: Parser) -> None:
    """Declare which methods answer, in which regimes, and with what."""
    p.add_argument("--method", type=names, required=True, metavar="M[,M]", help=METHOD_HELP)
    declare(p, "--regime", "--set", "--model", "--policy")


def add_instances(p: Parser) -> None:
    """Declare which instances are answered or judged."""
    chosen = p.add_mutually_exclusive_group()
    chosen.add_argument("--split", choices=SPLITS, default="test", help="which instances")
    chosen.add_argument("--instance", type=Path, nargs="+", metavar="FILE", help="or ids, instead of a split")
    p.add_argument("--limit", type=positive, help="only the first so many of the split")
    p.add_argument("--case", help=f"{CASE_HELP}; default: the instances', or {DEFAULT_CASE}")


def chosen_methods(
    a: argparse.Namespace, search: tuple[Path, ...], time_limit_s: float | None = None
) -> list[tuple[str, Settings]]:
    """The methods that `add_methods` let the user choose, with their settings.

    Raises:
        InputError: an unknown method, options of several methods, or options that the method refuses.
    """
    if a.set != DEFAULT and len(a.method) > 1:
        raise InputError("--set", a.set, "needs exactly one --method")
    given = Settings(a.set, a.model, a.policy, time_limit_s, search)
    return [(method.name, method.canonical(given)) for method in map(get_method, a.method)]


def say(sentence: str) -> None:
    """Tell on stderr: what went wrong, or what is about to be done, before imports and work take seconds."""
    if sys.stderr:
        with contextlib.suppress(OSError, ValueError):  # nobody listens
            print(f"ded-bench: {in_one_line(sentence)}", file=sys.stderr, flush=True)


def in_one_line(text: str) -> str:
    """The text with spaces for what cannot be printed."""
    return "".join(sign if sign.isprintable() else " " for sign in text)


def counted(n: int, noun: str) -> str:
    """A number of things: `1 row`, `2 rows`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
