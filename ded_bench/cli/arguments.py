"""What the `ded-bench` commands accept: options, defaults, help."""

from __future__ import annotations

import argparse
import fnmatch
import sys
import textwrap
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ded_bench.files.errors import InputError
from ded_bench.methods.registry import get_method, registered
from ded_bench.methods.solution import Settings
from ded_bench.run.environment import version
from ded_bench.surrogates.find import MODELS

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

#: The shipped case that is meant where none is named.
DEFAULT_CASE = "9bus"
RESULTS_HELP = "results folder; default: results/<case>"
CASE_HELP = "name of a shipped case, or a folder"
MODEL_HELP = f"{', '.join(MODELS)}, or a file"

#: The order of the list of commands: those of the road, then what judges results, then the closed loop.
ORDER = (
    *("cases", "instances", "train-ko", "solve", "train-dpc", "bench", "report"),
    *("score", "compare", "certify", "rollouts", "scenarios", "online", "overview"),
)
#: Under the list of commands, which must fit a terminal 80 columns wide.
ROAD = (
    "The road: instances, train-ko, solve, train-dpc, solve, bench, report; `make report` walks it. "
    "`ded-bench COMMAND --help` lists the options of one."
)


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors, and help that may end with what takes a moment to find out."""

    ending: Callable[[], str] | None = None

    def print_help(self, file: SupportsWrite[str] | None = None) -> None:
        """Options at once, then the ending."""
        super().print_help(file)
        if self.ending is not None:
            sys.stdout.flush()
            print(f"\n{self.ending()}", file=file)

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


def methods_text() -> str:
    """Every method that has a name, of this package or another one, with its settings."""
    lines = ["methods and their settings:"]
    for method in registered().values():
        try:
            known = ", ".join(method.settings)
        except InputError as error:
            known = f"cannot be used: {error}"
        text = f"  {method.name:<16} {known}"
        lines += textwrap.wrap(text, 79, subsequent_indent=" " * 19, break_on_hyphens=False)
    return "\n".join(lines)


def add_methods(p: Parser) -> None:
    """Declare which methods answer, in which regimes, and with what."""
    p.ending = methods_text
    p.add_argument(
        "--method", type=names, required=True, metavar="M[,M]", help="as listed below, or module:function"
    )
    p.add_argument("--regime", type=names, metavar="R[,R]", help="default: all of the case")
    p.add_argument("--settings", default="default", metavar="S[,S]", help="of the methods; may hold *")
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--policy", type=Path, help="policy file; default: the trained one")


def chosen_methods(
    a: argparse.Namespace, search: tuple[Path, ...], time_limit_s: float | None = None
) -> list[tuple[str, Settings]]:
    """The methods that `add_methods` let the user choose, each with one of its settings.

    Raises:
        InputError: an unknown method, or none has settings of this name.
    """
    chosen = [
        (method.name, Settings(slug, a.model, a.policy, time_limit_s, search))
        for method in map(get_method, a.method)
        for slug in matching(a.settings, method.settings)
    ]
    if not chosen:
        raise InputError("--settings", a.settings, f"matches none of {', '.join(a.method)}")
    return chosen


def names(text: str) -> tuple[str, ...]:
    """Read names separated by commas, each once."""
    found = tuple(part.strip() for part in text.split(",") if part.strip())
    if not found:
        raise argparse.ArgumentTypeError("names nothing")
    return tuple(dict.fromkeys(found))


def matching(pattern: str, known: Iterable[str]) -> list[str]:
    """The settings that `--settings` names: slugs separated by commas, `*` as in file names.

    A slug without `*` is returned whether it is known or not; its method tells what is wrong.
    """
    slugs = list(known)
    found: list[str] = []
    for part in names(pattern):
        found += [part] if "*" not in part else [s for s in slugs if fnmatch.fnmatchcase(s, part)]
    return list(dict.fromkeys(found))


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
