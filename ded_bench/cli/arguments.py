"""What the `ded-bench` commands accept: options, defaults, help."""

from __future__ import annotations

import argparse
from collections.abc import Generator
from pathlib import Path
from typing import Any, NoReturn

from ded_bench.files.errors import InputError
from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.run.environment import version
from ded_bench.surrogates.find import MODELS

#: The shipped case that is meant where none is named.
DEFAULT_CASE = "9bus"
RESULTS_HELP = "results folder; default: results/<case>"
CASE_HELP = "name of a shipped case, or a folder"
METHOD_HELP = "see `ded-bench methods`; or module:function"
MODEL_HELP = f"{', '.join(MODELS)}, or a file"

#: The order of the list of commands: those of the road, then what judges results, then the closed loop.
ORDER = (
    *("cases", "instances", "methods", "train-ko", "solve", "train-dpc", "bench", "report"),
    *("score", "reproduce", "compare", "certify", "scenarios", "online", "overview"),
)
#: Under the list of commands, which must fit a terminal 80 columns wide.
ROAD = (
    "The road: instances, train-ko, solve, train-dpc, solve, bench, report; `make report` walks it. "
    "`ded-bench COMMAND --help` lists the options of one."
)


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with code 2."""
        self.exit(2, f"{self.prog}: {message} (`{self.prog} --help` lists what there is)\n")


class WithDefaults(argparse.RawDescriptionHelpFormatter):
    """Help of one command: every default is told once."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=79)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        if (
            default is None
            or default is False
            or default == argparse.SUPPRESS
            or "default:" in str(action.help)
        ):
            return action.help
        value = ",".join(default) if isinstance(default, tuple) else default
        return f"{action.help} (default: {value})"


class OneLinePerCommand(argparse.HelpFormatter):
    """Help with a line per command."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=16, width=79)
        self._action_max_length = 14  # argparse forgets that commands are indented once more

    def _iter_indented_subactions(self, action: argparse.Action) -> Generator[argparse.Action, None, None]:
        def place(command: argparse.Action) -> int:
            return ORDER.index(command.dest) if command.dest in ORDER else len(ORDER)

        if isinstance(action, argparse._SubParsersAction):
            self._indent()
            yield from sorted(action._get_subactions(), key=place)
            self._dedent()


class ShowVersion(argparse.Action):
    """Print the package's version, looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print one line and exit with code 0."""
        print(f"{parser.prog} {version()}")
        parser.exit()


def command(commands: Any, name: str, text: str) -> Parser:
    """Add a command; `text` is its line in the list of commands."""
    made: Parser = commands.add_parser(
        name, help=text, description=f"{text[:1].upper()}{text[1:]}.", formatter_class=WithDefaults
    )
    made.set_defaults(task=text)
    return made


def add_methods(p: Parser) -> None:
    """Declare which methods answer, in which regimes, and with what."""
    p.add_argument("--method", type=names, required=True, metavar="M[,M]", help=METHOD_HELP)
    p.add_argument("--regime", type=names, metavar="R[,R]", help="default: all of the case")
    p.add_argument("--set", default=DEFAULT, metavar="NAME=VALUE[,...]", help="options of the one method")
    p.add_argument("--model", default="", help=f"{MODEL_HELP}; default: the method's own")
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")


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


def names(text: str) -> tuple[str, ...]:
    """Read names separated by commas, each once."""
    found = tuple(part.strip() for part in text.split(",") if part.strip())
    if not found:
        raise argparse.ArgumentTypeError("names nothing")
    return tuple(dict.fromkeys(found))


def natural(text: str) -> int:
    """Read a whole number of at least 0."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


def positive(text: str) -> int:
    """Read a whole number of at least 1."""
    if (value := natural(text)) < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def not_negative(text: str) -> float:
    """Read a finite number of at least 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def positive_number(text: str) -> float:
    """Read a finite number above 0."""
    if (value := not_negative(text)) == 0:
        raise argparse.ArgumentTypeError("must be above 0")
    return value
