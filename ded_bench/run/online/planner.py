"""Methods in the loop: every plan is asked of a process of its own, which is killed if it takes too long."""

from __future__ import annotations

import atexit
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

from ded_bench.methods.plugin import accept
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.pool import NoAnswerError, WorkerDiedError, Workers
from ded_bench.run.runner import GRACE_S
from ded_bench.run.tasks import prepared, reason_of, trace_of
from ded_bench.solvers.status import Status

#: How long a method may take for one plan unless told otherwise, s of the clock.
LIMIT_S = 60.0


@dataclass(frozen=True)
class Planned:
    """A method's answer to one instance: a schedule, or why there is none."""

    schedule: Schedule | None
    late: bool = False  # it did not come in time
    warm: bool = False  # the method was given the plan in force
    infeasible: bool = False  # no schedule meets every limit, says the method; this one, if any, comes near
    seconds: float = 0.0  # of the clock, with the way to the method's process and back
    error: str = ""
    trace: str = ""  # of what it raised


#: Asks for a plan; the second argument is the last one, on the time of the instance.
Ask = Callable[[Instance, Schedule | None], Planned]


@dataclass
class Planner:
    """Asks one method for plans. A method that raises or dies gives none; one that hangs is late."""

    case: Case
    regime: str
    method: str
    settings: Settings
    limit_s: float = LIMIT_S
    _ready: bool = False

    def __call__(self, instance: Instance, last: Schedule | None = None) -> Planned:
        """Ask for a plan; the process prepares the method first, if it has not done so yet."""
        started = time.perf_counter()
        job = self.case, self.method, self.regime, self.settings
        if not self._ready:
            prepared = _call(_prepare, job, self.limit_s + GRACE_S)
            if not isinstance(prepared, bool):
                return self._none(prepared, started)
            self._ready = True
        answer = _call(answered, (*job, instance, last), self.limit_s)
        if not isinstance(answer, tuple):
            return self._none(answer, started)
        solution, warm = answer
        seconds, infeasible = time.perf_counter() - started, solution.status == Status.INFEASIBLE
        return Planned(solution.schedule, False, warm, infeasible, seconds, solution.error)

    def _none(self, error: object, started: float) -> Planned:
        self._ready = self._ready and not isinstance(error, NoAnswerError | WorkerDiedError)
        late = isinstance(error, NoAnswerError)
        seconds = time.perf_counter() - started
        return Planned(None, late, seconds=seconds, error=reason_of(error), trace=trace_of(error))


def _call(function: Callable[..., object], arguments: tuple[object, ...], limit_s: float) -> object:
    """What a function answers in the other process, or the exception that came instead."""
    ((_, answer),) = _workers().imap([(function, arguments)], [None], [limit_s])
    return answer


@functools.cache
def _workers() -> Workers:
    workers = Workers()
    atexit.register(workers.close)
    return workers


def _prepare(case: Case, method: str, regime: str, settings: Settings) -> bool:
    prepared(case, method, regime, settings)
    return True


def answered(
    case: Case, method: str, regime: str, settings: Settings, instance: Instance, last: Schedule | None
) -> tuple[Solution, bool]:
    """Solve in this process as in operation, if the method knows how; tells if it was given the last plan."""
    started = time.perf_counter()
    solver = prepared(case, method, regime, settings)
    operate = getattr(solver, "solve", None)
    start = None if last is None else Solution(Status.FEASIBLE, last)
    answer = solver(instance) if operate is None else operate(instance, last=start)
    warm = operate is not None and start is not None
    return accept(answer, case, instance, time.perf_counter() - started), warm
