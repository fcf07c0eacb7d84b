"""What a method answers: a frozen Solution, and the settings under which it was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

DEFAULT_MODEL = "koopman"


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
    """How a method is run: a named choice of the method's own, and what it may depend on."""

    name: str = "default"
    model: str = DEFAULT_MODEL
    policy: Path | None = None
    time_limit_s: float | None = None
    search: tuple[Path, ...] = ()  # folders where trained models and policies may lie

    @property
    def slug(self) -> str:
        """The name in the results; another Koopman model than ours makes other rows."""
        return self.name if self.model == DEFAULT_MODEL else f"{self.name}-{Path(self.model).stem}"


#: What `prepare(case, regime, settings)` returns.
Solver = Callable[[Instance], Solution]
