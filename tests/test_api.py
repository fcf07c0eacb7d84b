"""The package's door: what a notebook calls, and what it does not make anyone import."""

from __future__ import annotations

import json
import subprocess
import sys
import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import ded_bench
from ded_bench.files.errors import InputError
from ded_bench.methods.registry import Method
from ded_bench.methods.solution import Settings
from ded_bench.plants import plant, score
from ded_bench.plants.detailed.detailed_stepper import integrate_plant
from ded_bench.plants.lossless.stepper import integrate
from ded_bench.problem.benchmark import write_benchmark
from ded_bench.problem.case import Case
from ded_bench.solvers.status import Status
from tests.conftest import CASE_FILES
from tests.detailed_cases import MIXED

HEAVY = ("casadi", "matplotlib", "numba", "pandas", "pyomo", "scipy", "torch")


def loaded_after(code: str) -> list[str]:
    """Heavy libraries that a fresh interpreter holds after this code."""
    command = f"{code}\nimport json, sys; print(json.dumps(sorted(set({HEAVY}) & set(sys.modules))))"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_a_light_door() -> None:
    """Whoever reads instances waits for no solver, no torch and no simulator."""
    assert (
        loaded_after("from ded_bench import Case, Instance, Schedule, Settings, load_instances, solve") == []
    )


def test_help_waits_for_no_compiler() -> None:
    """Nor for a solver, data frames or torch: each command imports its own."""
    assert loaded_after("from ded_bench.cli.commands import parser; parser()") == []


WITHOUT_TORCH = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")

sys.meta_path.insert(0, NoTorch())
"""


def test_answers_need_no_torch() -> None:
    """Of any method, our policies among them; only training imports it."""
    code = "from ded_bench.cli import commands\n"
    code += "from ded_bench.methods.registry import METHODS\n"
    code += "[m.options for m in METHODS.values()]\n"
    code += "import ded_bench.run.runner, ded_bench.analysis.certificate, ded_bench.report.report\n"
    assert "torch" not in loaded_after(code)


def test_training_says_what_to_install(tmp_path) -> None:
    """One line, before anything is made."""
    for command in (["train-dpc", "--regime", "TO"], ["train-ko", "--kind", "koopman-paper"]):
        arguments = [*command, "--out", str(tmp_path / "new.safetensors"), "--method", "ded-dpc"]
        arguments = arguments if "train-dpc" in command else arguments[:-2]
        code = f"{WITHOUT_TORCH}from ded_bench.cli import main; sys.exit(main({arguments}))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert done.stderr == "ded-bench: torch: training needs it: pip install torch\n"
        assert not list(tmp_path.iterdir())


def test_the_scorer_needs_no_method() -> None:
    code = "from ded_bench import Schedule, load_instances, score\nimport numpy as np\n"
    code += "from ded_bench.problem.instance import Instance\n"
    code += "[i] = load_instances('9bus', limit=1)\n"
    code += "i = i.model_copy(update={'horizon_s': 0.05})\n"
    code += "p = list(i.initial.power.values())\n"
    code += "score(i, Schedule(np.array([0.0, 0.05]), np.array([p, p])), 'TO')"
    assert loaded_after(code) == ["numba", "scipy"]


def test_linear_algebra_in_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the commands, and the caller's own threads afterwards."""
    [instance] = ded_bench.load_instances("9bus", limit=1)
    found = []

    def threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    def counting(*_: object) -> None:
        found.append(threads())

    monkeypatch.setattr(Method, "prepare", lambda *_: counting)
    with threadpool_limits(2):
        ded_bench.solve(instance, "ed", "TO", settings=Settings(time_limit_s=123.0))
        assert set(threads()) == {2}
    assert set(found[0]) == {1}


@pytest.mark.parametrize("limit_s", [0.0, -1.0, float("nan")])
def test_a_time_limit_is_a_positive_number(limit_s: float) -> None:
    with pytest.raises(InputError, match="time_limit_s"):
        Settings(time_limit_s=limit_s)


def test_threads_share_the_cores_with_no_linear_algebra() -> None:
    def threads(_: int) -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2):
        assert plant.in_threads(threads, range(4)) == [{1}] * 4
        assert threads(0) == {2}


def test_everything_promised_is_there() -> None:
    for name in ded_bench.__all__:
        assert getattr(ded_bench, name).__name__ == name
        assert name in dir(ded_bench)
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = ded_bench.magic


def test_instances_by_split(tmp_path, threebus: Case) -> None:
    shipped = ded_bench.load_instances("9bus", limit=2)
    assert [i.case for i in shipped] == ["9bus", "9bus"]
    write_benchmark(threebus, 5, 7, tmp_path / "threebus")
    assert len(ded_bench.load_instances(tmp_path / "threebus", split="train")) == 4
    with pytest.raises(InputError, match="holdout"):
        ded_bench.load_instances("9bus", split="holdout")


def test_functions_are_those_of_the_floors(ninebus: Case, quiet_instance, constant) -> None:
    instance = quiet_instance(ninebus, horizon_s=0.1)
    schedule = constant(instance, ninebus.p_nominal)
    assert ded_bench.score(instance, schedule, "TO") == score.score(ninebus, instance, schedule, "TO")
    ours, theirs = ded_bench.simulate(instance, schedule), plant.simulate(ninebus, instance, schedule)
    assert np.array_equal(ours.omega, theirs.omega)


def test_a_name_is_no_case(quiet_instance, ninebus: Case) -> None:
    with pytest.raises(InputError, match=r"must be a Case, such as Case.load\('9bus'\)"):
        ded_bench.solve(quiet_instance(ninebus), "ed", "TO", case="9bus")


def test_solve_answers_like_the_method(threebus: Case, quiet_instance) -> None:
    instance = quiet_instance(threebus, horizon_s=0.5)
    solution = ded_bench.solve(instance, "ded", "NO", case=threebus)
    assert solution.status is Status.OPTIMAL
    verdict = ded_bench.score(instance, solution.schedule, "NO", case=threebus)
    assert verdict.feasible
    # The model's backward Euler steps differ a little from the simulation.
    assert solution.solver_objective == pytest.approx(verdict.objective, rel=1e-3)
    with pytest.raises(InputError, match="unknown method"):
        ded_bench.solve(instance, "magic", "NO", case=threebus)
    with pytest.raises(InputError, match="unknown regime"):
        ded_bench.solve(instance, "ded", "XX", case=threebus)
    with pytest.raises(InputError, match="--set: magic: no such option"):
        ded_bench.solve(instance, "ded", "NO", case=threebus, settings=Settings("magic"))


@pytest.mark.parametrize("method", ["ded", "ded-slp", "ded-radau"])
def test_what_no_plant_can_begin_with_is_a_failed_solution(threebus: Case, quiet_instance, method) -> None:
    load = {"initial": -40.0, "start": 0.0, "duration": 0.0, "rate": 0.0}
    instance = quiet_instance(threebus, horizon_s=0.5, load=dict.fromkeys(threebus.loads, load))
    solution = ded_bench.solve(instance, method, "NO", case=threebus)
    assert (solution.status, solution.schedule) == (Status.FAILED, None)
    assert solution.error


def test_a_case_that_is_not_shipped_must_be_given(
    threebus: Case, ninebus: Case, quiet_instance, constant
) -> None:
    instance = quiet_instance(threebus, horizon_s=0.1)
    schedule = constant(instance, threebus.p_nominal)
    with pytest.raises(InputError, match="case: 'threebus' is no shipped case: give it"):
        ded_bench.score(instance, schedule, "NO")
    with pytest.raises(InputError, match="is for case 'threebus', not '9bus'"):
        ded_bench.solve(instance, "ded", "NO", case=ninebus)
    assert ded_bench.score(instance, schedule, "NO", case=threebus).feasible


def test_a_trajectory_is_a_frame_by_bus(case: Case, quiet_instance, constant) -> None:
    instance = quiet_instance(case, horizon_s=0.1)
    trajectory = plant.simulate(case, instance, constant(instance, case.p_nominal))
    frame = trajectory.to_frame()
    assert len(frame) == 11
    assert len(frame.columns) == 2 + 2 * len(case.generators) + len(case.loads) + len(case.buses)
    assert frame["t"].to_list() == instance.grid.tolist()
    for g, bus in enumerate(case.generators):
        assert np.array_equal(frame[f"P_{bus}"], trajectory.p_gen[:, g])
        assert np.array_equal(frame[f"omega_{bus}"], trajectory.omega[:, g])
    for i, bus in enumerate(case.buses):
        assert np.array_equal(frame[f"theta_{bus.id}"], trajectory.states[:, i])
    injections = frame[[c for c in frame.columns if c.startswith(("P_", "L_"))]]
    # At rest generation and load balance in a lossless network; the power flow solves to 1e-12 pu.
    assert injections.sum(axis=1).to_numpy() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("folder", [CASE_FILES["fivemachine"].parent, MIXED], ids=["lossless", "detailed"])
def test_many_simulations_are_those_of_one_after_the_other(folder, quiet_instance, constant) -> None:
    """To the last bit; what fails stands as its error among the others, which are not lost."""
    case = Case.load(folder)
    instances = [quiet_instance(case, horizon_s=0.5, id=f"mine-{i}") for i in range(5)]
    schedules = [constant(i, case.p_nominal * (1 + 0.01 * k)) for k, i in enumerate(instances)]
    schedules[1] = constant(instances[1], case.p_nominal + 1e3)
    schedules[3] = constant(quiet_instance(case, horizon_s=0.4), case.p_nominal)
    found = ded_bench.simulate_many(instances, schedules, case, threads=3)
    assert [type(f).__name__ for f in found] == [
        *("Trajectory", "SimulationError", "Trajectory", "InputError", "Trajectory")
    ]
    for k in (0, 2, 4):
        alone = ded_bench.simulate(instances[k], schedules[k], case)
        assert np.array_equal(found[k].omega, alone.omega)
        assert np.array_equal(found[k].p_gen, alone.p_gen)
    [of_one, _] = ded_bench.simulate_many(instances[0], schedules[:2], case, plant=case.plant_name)
    assert np.array_equal(of_one.omega, found[0].omega)
    with pytest.raises(InputError, match="schedules: there are 5 for 4 instances"):
        ded_bench.simulate_many(instances[:4], schedules, case)
    assert ded_bench.simulate_many([], []) == []


def test_threads_work_at_once() -> None:
    """Each of two waits until the other is there; and compiled plants let go of the interpreter."""
    together = threading.Barrier(2)
    assert sorted(plant.in_threads(lambda _: together.wait(20), range(2), 2)) == [0, 1]
    for compiled in (integrate, integrate_plant):
        assert compiled.targetoptions["nogil"]
