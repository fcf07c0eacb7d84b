"""Other people's methods: what counts as one, what they may answer, and how each mistake is told."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.methods.plugin import accept
from ded_bench.methods.registry import METHODS, get_method, registered
from ded_bench.methods.solution import Settings, Solution
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status

MODULE = """
from dataclasses import dataclass
import numpy as np
from ded_bench import Schedule, Solution, Status
from ded_bench.methods.options import read_options

@dataclass(frozen=True)
class Options:
    share: float = 1.0

def flat(instance, power):
    return Schedule(t=np.array([0.0, instance.horizon_s]), p=np.array([power, power]))

def solve(instance, regime):
    return flat(instance, list(instance.initial.power.values()))

def with_case(instance, regime, case):
    return flat(instance, case.p_nominal)

def prepare(case, regime, settings):
    share = read_options(Options, settings.options).share
    def run(instance):
        return Solution(Status.OPTIMAL, flat(instance, share * case.p_nominal), iterations=7, solve_s=0.25)
    return run

class Warm:
    def __init__(self, case):
        self.case = case

    def solve(self, instance, last=None):
        return flat(instance, self.case.p_nominal) if last is None else last

def warm(case, regime, settings):
    return Warm(case)

def greedy(instance, regime, case):
    power = list(instance.initial.power.values())
    instance.cost.update(dict.fromkeys(instance.cost, 0.0))
    instance.initial.power.clear()
    case.p_max[:] = 0.0
    return flat(instance, power)

def hollow(case, regime, settings):
    return None

def alone(instance):
    return None

def bent(case, regime):
    return None

constant = 3
"""


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of somebody's in the working directory; returns its name."""
    name = f"theirs_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p != ""])
    yield name
    sys.modules.pop(name, None)


@pytest.fixture
def instance(threebus: Case, quiet_instance):
    return quiet_instance(threebus, horizon_s=1.0)


def answer(name: str, case: Case, instance, settings: Settings | None = None) -> Solution:
    return get_method(name).prepare(case, "NO", settings or Settings())(instance)


def test_a_function_of_instance_and_regime_or_case_is_a_method(theirs, threebus, instance) -> None:
    solution = answer(f"{theirs}:solve", threebus, instance)
    assert solution.status is Status.FEASIBLE
    assert solution.schedule.p.tolist() == [[0.6], [0.6]]
    assert 0 < solution.solve_s < 1
    assert answer(f"{theirs}:with_case", threebus, instance).schedule.p.tolist() == [[0.6], [0.6]]


def test_what_a_method_does_to_its_data_nobody_else_sees(theirs, threebus, instance) -> None:
    """The row is judged by what was asked."""
    asked, limits = instance.model_dump(), threebus.p_max.copy()
    assert answer(f"{theirs}:greedy", threebus, instance).schedule.p.tolist() == [[0.6], [0.6]]
    assert instance.model_dump() == asked
    np.testing.assert_array_equal(threebus.p_max, limits)


def test_a_prepare_is_one_with_its_options(theirs, threebus, instance) -> None:
    solution = answer(f"{theirs}:prepare", threebus, instance, Settings("share=0.5"))
    assert (solution.status, solution.iterations, solution.solve_s) == (Status.OPTIMAL, 7, 0.25)
    assert solution.schedule.p.tolist() == [[0.3], [0.3]]
    with pytest.raises(InputError, match=r"--set: meek: no such option \(known: share\)"):
        answer(f"{theirs}:prepare", threebus, instance, Settings("meek=1"))
    with pytest.raises(InputError, match=r"share: no such option \(this method has none\)"):
        answer(f"{theirs}:solve", threebus, instance, Settings("share=1"))
    with pytest.raises(TypeError, match="returned nothing, not a function"):
        answer(f"{theirs}:hollow", threebus, instance)


def test_an_object_that_solves_may_start_from_the_last_plan(theirs, threebus, instance) -> None:
    solver = get_method(f"{theirs}:warm").prepare(threebus, "NO", Settings())
    assert solver(instance).schedule.p.tolist() == [[0.6], [0.6]]
    last = Schedule(np.array([0.0, 1.0]), np.array([[0.6], [0.7]]))
    assert solver.solve(instance, last=Solution(Status.FEASIBLE, last)).schedule.p.tolist() == [[0.6], [0.7]]
    short = Schedule(np.array([0.0, 0.5]), last.p)
    wrong = solver.solve(instance, last=Solution(Status.FEASIBLE, short))
    assert (wrong.status, wrong.schedule) == (Status.FAILED, None)
    assert not hasattr(get_method(f"{theirs}:prepare").prepare(threebus, "NO", Settings()), "solve")


def test_its_name_in_the_rows_leads_back_to_it(theirs) -> None:
    method = get_method(f"{theirs}:solve")
    assert method.name == f"{theirs}.solve"
    assert get_method(method.name) == method


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("nowhere_at_all:solve", "nowhere_at_all cannot be imported (ModuleNotFoundError"),
        ("{}:absent", ".py has no function 'absent'"),
        ("{}:constant", "has no function 'constant'"),
        ("{}:alone", "takes other arguments than solve(instance, regime)"),
        ("{}:bent", "takes other arguments than"),
        ("{}:solve()", "not of the form module:function"),
        ("nowhere.at_all", "cannot be imported"),
        ("magic", "unknown method (known: "),
        ("x" * 70 + ":solve", "cannot be imported"),
    ],
)
def test_what_is_no_method_is_told_in_one_line(theirs, target, told) -> None:
    with pytest.raises(InputError) as caught:
        get_method(target.format(theirs))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["raise SystemExit(3)", "1 / 0", "def f(:", "print('hi'); import gone"])
def test_a_module_that_cannot_be_imported_is_bad_input(text, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "broken_module_of_theirs.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="broken_module_of_theirs cannot be imported"):
        get_method("broken_module_of_theirs:f")
    assert capsys.readouterr().out == ""


def test_the_fingerprint_follows_the_sources_and_what_the_module_says(
    tmp_path, threebus, monkeypatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    prints = []
    for name, text, helper in (("one", "", "x = 1"), ("two", "", "x = 1"), ("three", "", "x = 2")):
        package = tmp_path / f"pack_{name}"
        package.mkdir()
        (package / "__init__.py").write_text(text)
        (package / "helper.py").write_text(helper)
        (package / "main.py").write_text("def solve(instance, regime): ...")
        method = get_method(f"pack_{name}.main:solve")
        prints.append(method.artifacts(threebus, "NO", Settings()))
    assert [(a.kind, a.path) for (a,) in prints] == [("code", None)] * 3
    one, two, three = (a.fingerprint for (a,) in prints)
    assert one == two != three  # a change anywhere in the package counts
    (tmp_path / "speaking.py").write_text(
        "def artifact(case, regime, settings): return 'weights-7-'\ndef solve(instance, regime): ..."
    )
    (speaking,) = get_method("speaking:solve").artifacts(threebus, "NO", Settings())
    assert speaking.fingerprint.startswith("weights-7-")


@pytest.mark.parametrize("body", ["raise KeyError('model')", "print('loading'); raise SystemExit(5)"])
def test_an_artifact_that_fails_is_bad_input(body, tmp_path, threebus, monkeypatch, capsys) -> None:
    """And what it does to the case is not the judge's."""
    monkeypatch.syspath_prepend(tmp_path)
    name, limits = f"silent_{tmp_path.name}", threebus.p_max.copy()
    text = f"def artifact(case, regime, settings): case.p_max[:] = 9.0; {body}"
    (tmp_path / f"{name}.py").write_text(f"{text}\ndef solve(instance, regime): ...")
    with pytest.raises(InputError, match=r"its artifact\(\) failed \((KeyError|SystemExit)"):
        get_method(f"{name}:solve").artifacts(threebus, "NO", Settings())
    assert capsys.readouterr().out == ""
    np.testing.assert_array_equal(threebus.p_max, limits)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ("n: int", r"its Options.n has no default"),
        ("x: list = dataclasses.field(default_factory=list)", "its Options.x has no default"),
        ("n: 'Undefined' = 3", "types of its Options cannot be read"),
    ],
)
def test_options_that_cannot_be_read_are_bad_input(fields, told, tmp_path, threebus, monkeypatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    name = f"optional_{tmp_path.name}"
    declared = f"import dataclasses\n@dataclasses.dataclass(frozen=True)\nclass Options:\n    {fields}\n"
    (tmp_path / f"{name}.py").write_text(f"{declared}def prepare(case, regime, settings): ...")
    with pytest.raises(InputError, match=told):
        get_method(f"{name}:prepare").canonical(Settings())


GOOD = Schedule(np.array([0.0, 1.0]), np.array([[0.6], [0.6]]))
END = np.array([0.0, 1.0])


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (None, "returned nothing, not a Schedule"),
        ([[0.6], [0.6]], "an object of type list"),
        (Schedule(END, np.array([[0.6], [np.nan]])), "finite numbers"),
        (Schedule(END, np.array([0.6, 0.6])), "has the shape (2,), but needs (2, 1)"),
        (Schedule(END, np.full((2, 2), 0.6)), "has the shape (2, 2)"),
        (Schedule(END[:1], np.full((1, 1), 0.6)), "at least two rows"),
        (Schedule(0.5 * END, np.full((2, 1), 0.6)), "must end at the horizon 1.0, not 0.5"),
        (Schedule(END[::-1], np.full((2, 1), 0.6)), "increase strictly"),
        (Schedule("ab", np.full((2, 1), 0.6)), "wrong schedule"),
        (Schedule(END, np.full((2, 1), 1j)), "must be real numbers"),
        (Solution(Status.OPTIMAL, "soon"), "wrong schedule"),
        (Solution(Status.OPTIMAL), "claims Optimal but returned no schedule"),
        (Solution("Splendid", GOOD), "unknown status 'Splendid'"),
    ],
)
def test_nonsense_is_a_failed_solution_that_says_why(returned, told, threebus, instance) -> None:
    solution = accept(returned, threebus, instance, 0.5)
    assert solution.status is Status.FAILED
    assert solution.schedule is None
    assert told in solution.error
    assert solution.solve_s == 0.5


def test_no_schedule_is_told_in_words(threebus, instance) -> None:
    assert accept(Solution(Status.INFEASIBLE), threebus, instance, 0.0).error == Status.INFEASIBLE.sentence


def test_what_a_table_cannot_hold_is_left_out(threebus, instance) -> None:
    strange = Solution(
        Status.FEASIBLE,
        Schedule([0, 1], [[0.6], [0.6]]),  # lists will do
        iterations=np.int64(4),
        build_s=float("nan"),
        setup_s=-1.0,
        solve_s=float("inf"),
        solver_objective="much",
        solver_version="a\nb",
        error="\ud800",
    )
    assert dataclasses.replace(accept(strange, threebus, instance, 0.5), schedule=None) == Solution(
        Status.FEASIBLE, None, 4, None, None, 0.5, None, "a b", "?"
    )
    limit = Solution(Status.TIME_LIMIT, error="no time left")
    assert accept(limit, threebus, instance, 0.5) == dataclasses.replace(limit, solve_s=0.5)


def install(folder: Path, name: str, text: str) -> None:
    """What an installer leaves of a package's entry points."""
    (folder / f"{name}-1.0.dist-info").mkdir(parents=True)
    (folder / f"{name}-1.0.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    )
    (folder / f"{name}-1.0.dist-info" / "entry_points.txt").write_text(f"[ded_bench.methods]\n{text}\n")


def test_installed_packages_bring_methods(theirs, tmp_path, threebus, instance, monkeypatch) -> None:
    install(
        tmp_path / "site", "pack", f"wise = {theirs}:solve\nded = {theirs}:solve\nun/safe = {theirs}:solve"
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert list(registered()) == [*METHODS, "wise"]
    assert get_method("ded") is METHODS["ded"]  # ours keep their names
    assert get_method("wise").name == "wise"
    assert answer("wise", threebus, instance).status is Status.FEASIBLE
    with pytest.raises(InputError, match=r"known: .*ded-ko.*, wise, or module:function"):
        get_method("magic")
    install(tmp_path / "other", "rival", f"wise = {theirs}:with_case")
    monkeypatch.syspath_prepend(tmp_path / "other")
    with pytest.raises(InputError, match="wise: two packages"):
        get_method("wise")


def test_an_installed_method_that_is_broken_is_told(tmp_path, monkeypatch) -> None:
    install(tmp_path / "site", "pack", "gone = nowhere_at_all:solve\nbare = json")
    monkeypatch.syspath_prepend(tmp_path / "site")
    with pytest.raises(InputError, match="nowhere_at_all cannot be imported"):
        get_method("gone")
    with pytest.raises(InputError, match="json: is not of the form module:function"):
        get_method("bare")
