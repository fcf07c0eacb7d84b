"""What every registered method keeps to, on every plant, on grids that it has never seen.

A new method or plant is tested here without being asked. Policies are trained for a moment first: what they
promise holds for any weights.
"""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.methods import solution
from ded_bench.methods.options import described
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings, Solution
from ded_bench.plants.plant import PLANTS, plant_of
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.sampling import sample_instance
from ded_bench.solvers.status import Status
from tests.test_strange_grid import grid

REGIME = "TO"


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A strange grid with its instances, a Koopman model and policies trained for an epoch."""
    place = tmp_path_factory.mktemp("contract")
    problem, results = place / "strange", place / "results"
    problem.mkdir()
    (problem / "case.json").write_text(json.dumps(grid(3, seed=3)))
    case = ["--case", str(problem)]
    assert main(["instances", *case, "--count", "5", "--test", "1"]) == 0
    assert main(["train-ko", *case, "--results", str(results)]) == 0
    train = ["train-dpc", *case, "--regime", REGIME, "--results", str(results)]
    assert main([*train, "--epochs", "1", "--limit", "4"]) == 0
    return place


@pytest.fixture(scope="session")
def strange(folder: Path) -> Case:
    return Case.load(folder / "strange")


@pytest.fixture(params=list(METHODS))
def name(request: pytest.FixtureRequest) -> str:
    """Each method in turn."""
    return str(request.param)


def solved(case: Case, folder: Path, name: str, instance: Instance, options: str = "default") -> Solution:
    settings = Settings(options, search=(folder / "results",))
    return METHODS[name].prepare(case, REGIME, settings)(instance)


def check(case: Case, instance: Instance, answer: Solution) -> None:
    """Limits of powers are kept strictly, or no schedule is claimed."""
    if answer.schedule is None:
        assert answer.status not in (Status.OPTIMAL, Status.FEASIBLE, Status.POLICY)
        assert answer.error
        return
    verdict = score(case, instance, answer.schedule, REGIME)
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) <= 1e-8
    assert np.isfinite(verdict.objective)


def test_the_same_question_has_the_same_answer(name: str, folder: Path, strange: Case) -> None:
    instance = sample_instance(strange, 77, 0)
    first, second = (solved(strange, folder, name, instance) for _ in range(2))
    assert first.schedule is not None, first.error
    np.testing.assert_array_equal(first.schedule.p, second.schedule.p)
    check(strange, instance, first)
    again = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(again.schedule.p, first.schedule.p)
    assert again.status == first.status


@pytest.mark.parametrize("seed", range(2))
def test_any_state_and_any_load_path(name: str, seed: int, folder: Path, strange: Case) -> None:
    """A measured state that is no equilibrium, and loads by points that bend where they like."""
    rng = np.random.default_rng(seed)
    drawn = sample_instance(strange, 78, seed)
    start = plant_of(strange).observed(plant_of(strange).initial(drawn))
    times = np.sort(rng.uniform(0.0, drawn.horizon_s, 5)).round(3)
    load = {
        bus: LoadPoints(
            points=tuple(
                (t, float(ramp.at(np.array(t)) * (1 + 0.01 * rng.uniform(-1, 1))))
                for t in (0.0, *times.tolist(), drawn.horizon_s)
            )
        )
        for bus, ramp in drawn.load.items()
    }
    theta = dict(zip(strange.generators, (start.theta + 1e-3 * rng.normal(size=3)).tolist(), strict=True))
    initial = drawn.initial.model_copy(update={"theta": theta})
    change = {"schema_": "ded-bench/instance/2", "load": load, "initial": initial}
    instance = drawn.model_copy(update=change)
    check(strange, instance, solved(strange, folder, name, instance))


def test_options_are_refused_by_name(name: str, folder: Path, strange: Case) -> None:
    """An unknown option names those that there are; a wrong value names the option."""
    known = [option for option, _, _ in described(METHODS[name].options)]
    with pytest.raises(InputError) as error:
        METHODS[name].canonical(Settings("swiftness=11"))
    assert "swiftness" in str(error.value)
    assert all(option in str(error.value) for option in known)
    for option in known:
        with pytest.raises(InputError, match=option):
            METHODS[name].canonical(Settings(f"{option}=lavender"))


def test_defaults_may_be_written_out(name: str) -> None:
    """Rows carry what differs from the defaults, so that these are not told."""
    defaults = ",".join(f"{option}={value}" for option, value, _ in described(METHODS[name].options))
    assert METHODS[name].canonical(Settings(defaults or "default")).options == "default"


def test_too_little_memory_is_an_answer(
    name: str, folder: Path, strange: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that does not fit is refused before it is made; small ones are still answered."""
    monkeypatch.setattr(solution, "MAX_BYTES", 1000)
    instance = sample_instance(strange, 77, 1)
    answer = solved(strange, folder, name, instance)
    assert answer.schedule is not None or "GiB" in answer.error


@pytest.mark.parametrize("plant", list(PLANTS))
def test_every_plant_judges(name: str, plant: str, folder: Path, strange: Case) -> None:
    """Whatever a schedule was planned for, any plant of the case can be asked what it does."""
    instance = sample_instance(strange, 77, 0)
    answer = solved(strange, folder, name, instance)
    assert answer.schedule is not None
    verdict = score(strange, instance, answer.schedule, REGIME, plant_of(strange, plant))
    assert verdict.ramp_violation <= 1e-8
