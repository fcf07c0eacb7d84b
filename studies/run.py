"""What `make` runs: one step of a grid's road, as the grid's file in `runs/` lists it.

    python studies/run.py report --case 39bus --limit 4
    python studies/run.py online --case 9bus --list

A file has a list for each step: commands, and names of other steps, which come first and only once. A command
is a table of its options by name, `true` for those without a value; those that all commands share are added
here. A file takes the steps that it does not list from its `base`, `default.toml` unless it says so; grids
without a file have that one, islands `island.toml`. Entries with `when = "train"` run only if `--train` is
given, those with `when = "policies"` also where the results folder or the case's reference run has trained
policies. The first command that fails ends it, as in make.
"""

import argparse
import json
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RUNS = Path(__file__).parent / "runs"
#: Which shared options a command takes; `out` is the results folder by its other name.
SHARED = {
    "train-ko": ("case", "results"),
    "train-dpc": ("case", "regime", "results", "workers"),
    "solve": ("case", "split", "regime", "limit", "workers", "out"),
    "online": ("case", "regime", "scenarios", "workers", "out"),
    "certify": ("case", "regime", "results", "workers"),
    "bench": ("case", "results"),
    "report": ("case", "results"),
}
#: Of these the smaller one counts: an entry's own, or the one asked for.
AT_MOST = ("limit", "scenarios")
#: Options that bound a training; words of `--train` replace them.
BUDGETS = ("seconds", "epochs")
Entry = dict[str, Any]


def runs_of(case: str) -> str:
    """The name of a grid's file in `runs/`."""
    if (RUNS / f"{Path(case).name}.toml").exists():
        return Path(case).name
    places = Path(case), RUNS.parents[1] / "problems" / case
    data = next((json.loads(p.read_text()) for p in (q / "case.json" for q in places) if p.is_file()), {})
    return "island" if data.get("plant", {}).get("slack") == "island" else "default"


def read_steps(name: str) -> dict[str, list[str | Entry]]:
    """The steps of a file in `runs/`, with those of its base where it lists none."""
    steps = tomllib.loads((RUNS / f"{name}.toml").read_text(encoding="utf-8"))
    base = steps.pop("base", "default")
    return steps if name == "default" else read_steps(base) | steps


def entries(steps: dict[str, list[str | Entry]], step: str, holds: dict[str, bool]) -> Iterator[Entry]:
    """The commands of a step and of those before it, each step once."""
    done: set[str] = set()

    def expand(name: str) -> Iterator[Entry]:
        if name in done:
            return
        done.add(name)
        if name not in steps:
            raise SystemExit(f"run.py: {name}: no such step (known: {', '.join(steps)})")
        for entry in steps[name]:
            part = {"step": entry} if isinstance(entry, str) else dict(entry)
            condition = part.pop("when", "")
            if condition and not holds[condition]:
                continue
            if "step" in part:
                yield from expand(part["step"])
            else:
                yield part

    return expand(step)


def command_line(entry: Entry, asked: argparse.Namespace) -> list[str]:
    """The words of a command: its own options, those that are shared, what the user adds to its kind."""
    options = dict(entry)
    command = options.pop("command")
    extra = {"train-ko": asked.koopman, "train-dpc": asked.train, "bench": asked.bench}.get(command, "")
    if command == "train-dpc" and extra:
        options = {name: value for name, value in options.items() if name not in BUDGETS}
    if command == "bench" and asked.timed:
        options["instances"] = asked.timed
    for name in SHARED[command]:
        value = asked.results if name == "out" else getattr(asked, name)
        if name in AT_MOST:
            options[name] = min((int(n) for n in (value, options.get(name)) if n), default="")
        else:
            options.setdefault(name, value)
    given = {name: () if value is True else (str(value),) for name, value in options.items() if value != ""}
    words = [word for name, values in given.items() for word in (f"--{name}", *values)]
    return [str(Path(sys.executable).parent / "ded-bench"), command, *words, *shlex.split(extra)]


def main(arguments: list[str] | None = None) -> int:
    """Run the commands of a step; returns the exit code of the last one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("step")
    parser.add_argument("--case", default="9bus", help="a shipped case or a folder")
    parser.add_argument("--runs", help="file in runs/ (default: the case's)")
    parser.add_argument("--list", action="store_true", help="print the commands, run none")
    for name in ("results", "split", "regime", "limit", "scenarios", "workers"):
        parser.add_argument(f"--{name}", default="", help=f"of all commands that take --{name}")
    parser.add_argument("--timed", default="", help="how many instances are timed")
    for name, command in (("koopman", "train-ko"), ("train", "train-dpc"), ("bench", "bench")):
        parser.add_argument(f"--{name}", default="", metavar="WORDS", help=f"further options of {command}")
    asked = parser.parse_args(arguments)
    name = Path(asked.case).name
    asked.results = asked.results or f"results/{name}"
    trained = [Path(asked.results, "policies"), Path(f"results/{name}-reference/policies")]
    holds = {"train": bool(asked.train)}
    holds["policies"] = holds["train"] or any(folder.is_dir() for folder in trained)
    road = list(entries(read_steps(asked.runs or runs_of(asked.case)), asked.step, holds))
    for number, entry in enumerate(road, start=1):
        words = command_line(entry, asked)
        print("" if asked.list else f"[{number} of {len(road)}] ", shlex.join(words), sep="", flush=True)
        code = 0 if asked.list else subprocess.run(words, check=False).returncode
        if code:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
