"""What a method answers: a frozen Solution, and the settings under which it was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ded_bench.methods.options import DEFAULT
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status


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
    solver_objective: float | None = None
    solver_version: str = ""
    error: str = ""


@dataclass(frozen=True)
class Settings:
    """How a method is run: its options, and what its answers may depend on besides."""

    options: str = DEFAULT  # as `--set` takes them, see `methods.options`
    model: str = ""  # a surrogate's name or file; empty: the method's own choice
    policy: Path | None = None  # a policy's file; None: the trained one
    time_limit_s: float | None = None
    search: tuple[Path, ...] = ()  # folders where trained models and policies may lie


#: What `prepare(case, regime, settings)` returns.
Solver = Callable[[Instance], Solution]
