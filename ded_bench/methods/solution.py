"""What a method answers: a frozen Solution; the settings under which it was found, and its artifacts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ded_bench.files.errors import InputError
from ded_bench.methods.options import DEFAULT
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Outcome, Status

#: What the program of one worker may take, bytes.
MAX_BYTES = 4 * 2**30


@dataclass(frozen=True)
class Solution:
    """One method's answer for one instance. Times are wall-clock seconds.

    `build_s` makes or updates the model, `setup_s` prepares the solver (.nl file, symbolic
    derivatives), `solve_s` is the solver alone, or a policy's inference.
    """

    status: Status
    schedule: Schedule | None = None
    iterations: int | None = None
    build_s: float | None = None
    setup_s: float | None = None
    solve_s: float | None = None
    solver_objective: float | None = None  # the cost that it claims
    solver_version: str = ""
    error: str = ""


@dataclass(frozen=True)
class Settings:
    """How a method is run: its options, and what its answers may depend on besides.

    Raises:
        InputError: the time limit is no positive number.
    """

    options: str = DEFAULT  # as `--set` takes them, see `methods.options`
    model: str = ""  # a surrogate's name or file; empty: the method's own choice
    policy: Path | None = None  # a policy's file; None: the trained one
    time_limit_s: float | None = None
    search: tuple[Path, ...] = ()  # folders where trained models and policies may lie

    def __post_init__(self) -> None:
        if self.time_limit_s is not None and not self.time_limit_s > 0.0:  # not a number is refused, too
            raise InputError("settings", "time_limit_s", f"{self.time_limit_s} is no positive number")


@dataclass(frozen=True)
class Artifact:
    """A model or policy that answers depend on.

    Attributes:
        kind: a surrogate, a policy, or the code of a method that lies outside this package.
        name: the model's kind, the method of a policy, or `module:function`.
        fingerprint: changes whenever the numbers inside (or the code) do.
        path: the file it was read from; None if it follows from the case or is no file.
    """

    kind: Literal["model", "policy", "code"]
    name: str
    fingerprint: str
    path: Path | None = None


def model_artifact(case: Case, settings: Settings, default: str = "koopman") -> Artifact:
    """The surrogate that the settings name, else the method's own.

    Raises:
        InputError: there is no such model, or its file is wrong.
    """
    from ded_bench.surrogates.find import find_surrogate  # and SciPy: the door does without

    model = find_surrogate(case, settings.model, settings.search, default)
    return Artifact("model", model.kind, model.fingerprint, getattr(model, "path", None))


def named(artifacts: Iterable[Artifact], kind: str) -> str:
    """The models, or the policies, that shaped an answer, as rows say it: `name@fingerprint`, joined by +."""
    return "+".join(f"{a.name}@{a.fingerprint}" for a in artifacts if a.kind == kind)


#: What `prepare(case, regime, settings)` returns.
Solver = Callable[[Instance], Solution]


def answer(outcome: Outcome, build_s: float, schedule: Callable[[], Schedule | None]) -> Solution:
    """A solver's outcome as the method's answer; the schedule is read only if there is one."""
    has_values = outcome.objective is not None
    return Solution(
        status=outcome.status,
        schedule=schedule() if has_values else None,
        iterations=outcome.iterations,
        build_s=build_s,
        setup_s=outcome.setup_s,
        solve_s=outcome.solve_s,
        solver_objective=outcome.objective,
        solver_version=outcome.version,
        error="" if has_values else outcome.message,
    )


def too_large(needed: float, program: str, advice: str) -> Solution | None:
    """Return a `Failed` answer if a program would take more than `MAX_BYTES`; None if it may be made.

    Args:
        needed: an estimate from its size, bytes.
        program: what the message calls it.
        advice: what to do instead, for the same message.
    """
    if needed <= MAX_BYTES:
        return None
    error = f"{program} would take {needed / 2**30:.0f} GiB; {advice}"
    return Solution(Status.FAILED, build_s=0.0, setup_s=0.0, solve_s=0.0, error=error)
