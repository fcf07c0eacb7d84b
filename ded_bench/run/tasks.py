"""What worker processes do: solve one task, score a few; a failure is an answer, too."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ded_bench.methods.artifact import Artifact
from ded_bench.methods.plugin import accept
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solution, Solver
from ded_bench.plants.score import Score, score
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key
from ded_bench.run.environment import host
from ded_bench.run.pool import NoAnswerError, WorkerDiedError
from ded_bench.run.shipping import Files, unpacked
from ded_bench.solvers.status import Status


@dataclass(frozen=True)
class Task:
    """One row to be made."""

    instance: Instance
    split: str
    regime: str
    method: str
    settings: Settings
    fingerprint: str
    artifacts: tuple[Artifact, ...] = ()
    code: str = ""
    files: Files = ()  # for a worker without the results folder

    @property
    def key(self) -> Key:
        """The row's place in the results table."""
        return Key(self.instance.id, self.regime, self.method, self.settings.slug)


def solve_task(case: Case, task: Task) -> tuple[Solution, str]:
    """Solve one task in this process; returns the Solution and the machine.

    A method that raises, or answers with something that is no Solution for this instance, gives a
    failed Solution that says so.
    """
    started = time.perf_counter()
    try:
        answer = _prepared(case, task.method, task.regime, task.settings, task.files)(task.instance)
        return accept(answer, case, task.instance, time.perf_counter() - started), host()
    except Exception as error:  # the boundary to other people's methods: a failure is a row
        return failed(error), host()


#: How a schedule is judged: `scorer(case, instance=…, schedule=…, regime=…)`, a function that can be pickled.
Scorer = Callable[..., Score]


def score_tasks(
    case: Case, tasks: Sequence[Task], schedules: Sequence[Schedule], scorer: Scorer = score
) -> list[Score | SimulationError]:
    """Score tasks one by one; the error stands for those that lose synchronism."""
    verdicts: list[Score | SimulationError] = []
    for task, schedule in zip(tasks, schedules, strict=True):
        try:
            verdicts.append(scorer(case, instance=task.instance, schedule=schedule, regime=task.regime))
        except SimulationError as error:
            verdicts.append(error)
    return verdicts


def failed(error: object) -> Solution:
    """A Solution for a method that raised or gave no answer, or whose process died."""
    status = Status.TIME_LIMIT if isinstance(error, NoAnswerError) else Status.FAILED
    return Solution(status, error=reason_of(error))


@functools.lru_cache(maxsize=4)
def _prepared(case: Case, method: str, regime: str, settings: Settings, files: Files) -> Solver:
    if not files:
        return get_method(method).prepare(case, regime, settings)
    with unpacked(settings, files) as own:
        return get_method(method).prepare(case, regime, own)


def reason_of(error: object) -> str:
    """One line that a person understands and any file can hold."""
    first = (str(error).strip().splitlines() or ["no message"])[0]
    if isinstance(error, BaseException) and not isinstance(error, NoAnswerError | WorkerDiedError):
        first = f"{type(error).__name__}: {first}"
    return first.encode("utf-8", "replace").decode()[:300]
