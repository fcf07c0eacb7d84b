"""Methods of others: a function in anyone's module, made to look like a module of ours.

A function is named `module:function`, on the command line or by an entry point of the group
`ded_bench.methods` in the package that brings it. It is either

* `solve(instance, regime)` or `solve(instance, regime, case)`, which answers with a `Schedule`, or
  with a `Solution` if it has more to say (status, iterations, times); or
* `prepare(case, regime, settings)` - the first parameter is called `case` - which returns a function
  from an instance to a `Schedule` or `Solution`, as our own methods do, or an object with
  `solve(instance, last=None)`. In the closed loop `last` is the plan in force as a `Solution` on the
  time of the instance, to start from; elsewhere it is None. The module may offer `Options`, a frozen
  dataclass whose fields have defaults: `read_options(Options, settings.options)` (`methods.options`) gives
  what `--set` set.

Either module may offer `artifact(case, regime, settings) -> str`, a fingerprint of data that the
answers depend on; that of the sources is added here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import inspect
import math
import re
import sys
import time
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.options import NoOptions
from ded_bench.methods.solution import Artifact, Settings, Solution, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.quantities import LARGEST
from ded_bench.problem.schedule import Schedule, as_schedule
from ded_bench.solvers.status import Status

#: Entry points of this group are methods: `name = "module:function"`.
GROUP = "ded_bench.methods"
#: What may name a method in the results: it is also the name of a folder.
SLUG = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_TARGET = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")


@dataclass(frozen=True)
class ForeignSolver:
    """Someone's function from an instance to a schedule, whose answers are checked."""

    case: Case
    function: Callable[..., Any]

    def __call__(self, instance: Instance, **more: Any) -> Solution:
        """Solve one instance."""
        own = instance.model_copy(deep=True)  # what it changes is not judged
        started = time.perf_counter()
        answer = self.function(own, **more)
        return accept(answer, self.case, instance, time.perf_counter() - started)


class ForeignWarmSolver(ForeignSolver):
    """Someone's `solve(instance, last=None)`."""

    def solve(self, instance: Instance, last: Solution | None = None) -> Solution:
        """Solve one instance, starting from the plan in force."""
        return self(instance, last=last)


@dataclass(frozen=True)
class Foreign:
    """What the registry asks of a method's module, made from a function of another one."""

    target: str
    module: ModuleType
    function: Callable[..., Any]

    @property
    def Options(self) -> type[Any]:  # noqa: N802  (the name that our modules use)
        """What a `prepare` declares in its module; else there are none.

        Raises:
            InputError: a field has no default, or a type that there is not.
        """
        declared = getattr(self.module, "Options", None) if self._prepares else None
        if not (isinstance(declared, type) and dataclasses.is_dataclass(declared)):
            return NoOptions
        for field in dataclasses.fields(declared):
            if field.default is dataclasses.MISSING:
                raise InputError("--method", self.target, f"its Options.{field.name} has no default")
        with _refusing(self.target, "types of its Options cannot be read"):
            typing.get_type_hints(declared)
        return declared

    def prepare(self, case: Case, regime: str, settings: Settings) -> Solver:
        """Return the function that solves one instance and checks what comes back.

        Raises:
            TypeError: a `prepare` returns something that can neither be called nor solve.
        """
        own = case.model_copy(deep=True)  # what it changes is not the judge's
        if not self._prepares:
            extra = {"case": own} if "case" in inspect.signature(self.function).parameters else {}
            return ForeignSolver(case, lambda instance: self.function(instance, regime, **extra))
        inner = self.function(own, regime, settings)
        if callable(getattr(inner, "solve", None)):
            return ForeignWarmSolver(case, inner.solve)
        if not callable(inner):
            raise TypeError(f"{self.target} returned {_kind(inner)}, not a function")
        return ForeignSolver(case, inner)

    def artifacts(self, case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
        """One: what the module says of itself, then a hash of the sources of its package.

        Raises:
            InputError: the module's `artifact` raises.
        """
        own, said = getattr(self.module, "artifact", None), ""
        if callable(own):
            with _refusing(self.target, "its artifact() failed"):
                said = str(own(case.model_copy(deep=True), regime, settings))
        return (Artifact("code", self.target, said + _sources(self.module)),)

    @property
    def _prepares(self) -> bool:
        return next(iter(inspect.signature(self.function).parameters), "") == "case"


def installed() -> dict[str, str]:
    """Methods that installed packages bring: `module:function` by name.

    Raises:
        InputError: two packages bring different methods of the same name.
    """
    found: dict[str, str] = {}
    for point in importlib.metadata.entry_points(group=GROUP):
        target = point.value.partition("[")[0].replace(" ", "")
        if found.setdefault(point.name, target) != target:
            raise InputError(f"entry points {GROUP}", point.name, "two packages bring a method of this name")
    return found


def load(target: str) -> Foreign:
    """Import `module:function`; modules in the working directory count.

    Raises:
        InputError: the target is not of this form, the module cannot be imported, it has no such
            function, or this takes other arguments.
    """
    if not _TARGET.fullmatch(target):
        raise InputError("--method", target, "is not of the form module:function")
    module_name, _, name = target.partition(":")
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.append(str(Path.cwd()))  # last: nothing installed is shadowed
    with _refusing(target, f"{module_name} cannot be imported"):
        module = importlib.import_module(module_name)
    function = getattr(module, name, None)
    if not callable(function):
        place = getattr(module, "__file__", None) or module_name
        raise InputError("--method", target, f"{place} has no function {name!r}")
    foreign = Foreign(target, module, function)
    _check_signature(foreign)
    return foreign


@contextlib.contextmanager
def _refusing(target: str, problem: str) -> Iterator[None]:
    """Turn whatever happens in someone's module into an InputError; what it prints is no output of ours."""
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except (Exception, SystemExit) as error:
        first = (str(error).strip().splitlines() or ["no message"])[0]
        reason = f"{type(error).__name__}: {first}"[:200]
        raise InputError("--method", target, f"{problem} ({reason})") from None


def accept(answer: object, case: Case, instance: Instance, seconds: float) -> Solution:
    """Turn what someone's function returned into a `Solution` that is sound.

    Anything but a `Schedule` or a `Solution` whose schedule spans the horizon with finite numbers, one
    column per generator, gives a failed `Solution` that says why.

    Args:
        seconds: wall time of the call, for answers that do not time themselves.
    """
    if isinstance(answer, Schedule):
        answer = Solution(Status.FEASIBLE, answer)
    if not isinstance(answer, Solution):
        return _failed(f"returned {_kind(answer)}, not a Schedule or a Solution", seconds)
    if str(answer.status) not in list(Status):
        return _failed(f"returned the unknown status {str(answer.status)[:40]!r}", seconds)
    status = Status(str(answer.status))
    schedule: Schedule | None = None
    if answer.schedule is not None:
        try:
            schedule = as_schedule(answer.schedule, case)
            schedule.check(instance.horizon_s)
        except InputError as error:
            return _failed(f"returned a wrong schedule: {error}", seconds)
    elif status in (Status.OPTIMAL, Status.FEASIBLE, Status.POLICY):
        return _failed(f"claims {status} but returned no schedule", seconds)
    solve_s, iterations = _number(answer.solve_s), _number(answer.iterations)
    return Solution(
        status=status,
        schedule=schedule,
        iterations=None if iterations is None else int(iterations),
        build_s=_number(answer.build_s),
        setup_s=_number(answer.setup_s),
        solve_s=seconds if solve_s is None else solve_s,
        solver_objective=_number(answer.solver_objective, -math.inf, math.inf),
        solver_version=_line(answer.solver_version),
        error=_line(answer.error) or ("" if schedule is not None else status.sentence),
    )


def _failed(reason: str, seconds: float) -> Solution:
    return Solution(Status.FAILED, solve_s=seconds, error=_line(reason))


def _number(value: object, lowest: float = 0.0, highest: float = LARGEST) -> float | None:
    """A finite number within these limits, or nothing."""
    if isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value):
        return float(value) if lowest <= value <= highest else None
    return None


def _line(text: object) -> str:
    """One line that any file can hold."""
    return " ".join(str(text).encode("utf-8", "replace").decode().split())[:300]


def _kind(value: object) -> str:
    return "nothing" if value is None else f"an object of type {type(value).__name__}"


def _check_signature(foreign: Foreign) -> None:
    wanted = "solve(instance, regime), solve(instance, regime, case) or prepare(case, regime, settings)"
    try:
        signature = inspect.signature(foreign.function)
        names = list(signature.parameters)
        if names[:1] == ["case"]:
            signature.bind(None, None, None)
        else:
            signature.bind(None, None, **({"case": None} if "case" in names else {}))
    except (TypeError, ValueError):  # other parameters, or a built-in without a signature
        raise InputError("--method", foreign.target, f"takes other arguments than {wanted}") from None


@functools.cache
def _sources(module: ModuleType) -> str:
    """Hash of the code a module comes from: its package, or its file if it is in none."""
    root = sys.modules.get(module.__name__.partition(".")[0], module)
    file = getattr(root, "__file__", None) or getattr(module, "__file__", None)
    if file is None:
        return ""
    path = Path(file)
    files = [path]
    if hasattr(root, "__path__"):
        suffixes = tuple(importlib.machinery.all_suffixes())
        files = sorted(f for f in path.parent.rglob("*") if f.name.endswith(suffixes) and f.is_file())
    digest = hashlib.sha256()
    for f in files:
        if "__pycache__" not in f.parts:
            digest.update(str(f.relative_to(path.parent)).encode() + b"\0" + f.read_bytes())
    return digest.hexdigest()[:12]
