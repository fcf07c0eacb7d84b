"""Tasks: one row to be made each, and what worker processes do for it; a failure is an answer, too."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import re
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ded_bench.files.errors import InputError
from ded_bench.methods.plugin import accept
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Artifact, Settings, Solution, Solver, named
from ded_bench.plants.plant import SimulationError, plant_of
from ded_bench.plants.score import Score, score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key
from ded_bench.run.environment import host
from ded_bench.run.pool import NoAnswerError, WorkerDiedError
from ded_bench.solvers.status import Status

#: Contents of files by their path below a results folder.
Files = tuple[tuple[str, bytes], ...]
#: A call in a traceback: file, line, function, code.
_CALL = re.compile(r'File "(.+)", line (\d+), in (.+)\n +(.+)')
#: Errors that say all there is to know.
_EXPLAINED = (InputError, SimulationError, NoAnswerError, WorkerDiedError)


@dataclass(frozen=True)
class Task:
    """One row to be made. `settings` are canonical, `version` is the method's."""

    instance: Instance
    split: str
    regime: str
    method: str
    settings: Settings
    fingerprint: str = ""
    artifacts: tuple[Artifact, ...] = ()
    version: int = 0
    files: Files = ()  # for a worker without the results folder
    given: Solution | None = None  # the answer of another tool, which is only scored

    @property
    def key(self) -> Key:
        """The row's place in the results table."""
        made_with = named(self.artifacts, "model"), named(self.artifacts, "policy")
        name = self.instance.case, self.instance.id, self.regime, self.method, self.settings.options
        return Key(*name, *made_with, self.settings.time_limit_s)

    def fingerprinted(self, case: Case, content: str = "") -> Task:
        """The same with twelve hex digits that change with whatever decides on its answer but our own code.

        Args:
            case: of its instance.
            content: fingerprint of what else it is made of, as a schedule that was submitted.
        """
        parts = [case.fingerprint, self.instance.fingerprint, *map(str, self.key[2:]), content]
        digits = hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]
        return dataclasses.replace(self, fingerprint=digits)


def make_tasks(
    case: Case,
    instances: Sequence[tuple[Instance, str]],
    methods: Sequence[str],
    regimes: Sequence[str],
    settings: Settings,
) -> list[Task]:
    """List every row of a run; methods and regimes outermost, so that a worker's model is reused.

    Raises:
        InputError: unknown method, regime or options, or a model or policy that is missing.
    """
    case.check_regimes(regimes)
    tasks = []
    for method in map(get_method, methods):
        own = method.canonical(settings)
        for regime in regimes:
            artifacts = method.artifacts(case, regime, own)
            for instance, split in instances:
                task = Task(instance, split, regime, method.name, own, "", artifacts, method.version)
                tasks.append(task.fingerprinted(case, named(artifacts, "code")))
    return tasks


class Answered(NamedTuple):
    """A method's answer, the scorer's verdict if there is a schedule, the machine, and what it raised."""

    solution: Solution
    verdict: Score | Exception | None
    host: str
    trace: str = ""


@functools.lru_cache(maxsize=4)
def prepared(case: Case, method: str, regime: str, settings: Settings, files: Files = ()) -> Solver:
    """A method that is ready to solve, kept for the next call in this process; raises as `Method.prepare`."""
    with unpacked(settings, files) if files else contextlib.nullcontext(settings) as own:
        return get_method(method).prepare(case, regime, own)


#: What the scorer is asked: how an instance's schedule does in a regime on a plant. The error stands for a
#: schedule that could not be read.
Question = tuple[Instance, Schedule | InputError, str, str]


def score_all(case: Case, questions: Sequence[Question]) -> list[Score | Exception]:
    """Score schedules one by one; the error stands for one that its plant cannot follow."""
    verdicts: list[Score | Exception] = []
    for instance, schedule, regime, plant in questions:
        try:
            if isinstance(schedule, InputError):
                raise schedule
            verdicts.append(score(case, instance, schedule, regime, plant_of(case, plant)))
        except (InputError, SimulationError) as error:
            verdicts.append(error)
    return verdicts


def solve_and_score(case: Case, task: Task, plant: str) -> Answered:
    """Solve and score one task in this process.

    A method that raises, or answers with something that is no Solution for this instance, gives a
    failed Solution that says so.
    """
    solution, trace, started = task.given, "", time.perf_counter()
    try:
        if solution is None:
            solve = prepared(case, task.method, task.regime, task.settings, task.files)
            solution = accept(solve(task.instance), case, task.instance, time.perf_counter() - started)
    except Exception as error:  # the boundary to other people's methods: a failure is a row
        solution, trace = failed(error), trace_of(error)
    verdict = None
    if solution.schedule is not None:
        (verdict,) = score_all(case, [(task.instance, solution.schedule, task.regime, plant)])
    return Answered(solution, verdict, host(), trace)


def failed(error: object) -> Solution:
    """A Solution for a method that raised or gave no answer, or whose process died."""
    status = Status.TIME_LIMIT if isinstance(error, NoAnswerError) else Status.FAILED
    return Solution(status, error=reason_of(error))


def reason_of(error: object) -> str:
    """One line that a person understands and any file can hold: the error, and the call that raised it."""
    first = (str(error).strip().splitlines() or ["no message"])[0]
    if isinstance(error, BaseException) and not isinstance(error, NoAnswerError | WorkerDiedError):
        first = f"{type(error).__name__}: {first}"
    if calls := _CALL.findall(trace_of(error)):
        path, line, name, code = calls[-1]
        first = f"{first[:200]} ({Path(path).name}, line {line}, in {name}: {code})"
    return first.encode("utf-8", "replace").decode()[:300]


def trace_of(error: object) -> str:
    """The traceback of what was raised here or in another process; empty where the input is at fault."""
    if not isinstance(error, BaseException) or isinstance(error, _EXPLAINED):
        return ""
    notes = getattr(error, "__notes__", None)
    return str(notes[-1]) if notes else "".join(traceback.format_exception(error))


def pack(artifacts: Iterable[Artifact]) -> Files:
    """Read every file that an answer depends on."""
    return tuple((_place(a.kind, a.path), a.path.read_bytes()) for a in artifacts if a.path)


@contextlib.contextmanager
def unpacked(settings: Settings, files: Files) -> Iterator[Settings]:
    """Settings that find the packed files, which lie in a temporary folder until the end of the block."""
    with tempfile.TemporaryDirectory(prefix="ded-bench-") as name:
        folder = Path(name)
        for place, content in files:
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).write_bytes(content)
        policy, model = settings.policy and folder / _place("policy", settings.policy), settings.model
        if model and (given := folder / _place("model", model)).is_file():
            model = str(given)
        yield dataclasses.replace(settings, search=(folder,), policy=policy, model=model)


def _place(kind: str, path: str | Path) -> str:
    """Where a results folder, and a worker, has a file."""
    return f"{'policies' if kind == 'policy' else 'koopman'}/{Path(path).name}"
