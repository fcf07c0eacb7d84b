"""What every registered method keeps to, on every plant, on grids that it has never seen.

A new method or plant is tested here without being asked.
"""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.methods import solution
from ded_bench.methods.options import described
from ded_bench.methods.registry import METHODS, trainable
from ded_bench.methods.solution import Settings, Solution
from ded_bench.methods.training_record import TrainingOptions, policy_file
from ded_bench.plants.plant import plant_of, simulate
from ded_bench.plants.score import judge, score
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.lossless_case import LosslessCase
from ded_bench.problem.sampling import sample_instance
from ded_bench.results.folder import ResultsFolder
from ded_bench.solvers.status import Status
from ded_bench.surrogates.linear import linear_model
from tests.lagged_plant import lagged
from tests.methods.policies import RANDOM, random_policy, short_instances
from tests.plants.test_protocol import carried
from tests.test_strange_grid import HORIZON, grid

__all__ = ["lagged"]

REGIME = "TO"
#: The paper's recipe punishes what exceeds the limits of powers, and promises nothing.
PROMISES_NOTHING = "ded-dpc-paper"


@pytest.fixture(scope="session")
def strange() -> Case:
    """A grid that nothing was made for."""
    return parse_record(LosslessCase, json.dumps(grid(3, seed=3)), "strange")


@pytest.fixture(scope="session")
def folder(strange: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with a Koopman model, and policies of random weights: what they promise holds for any."""
    results = tmp_path_factory.mktemp("contract")
    linear_model(strange).save(ResultsFolder(results).model("koopman"))
    for method in trainable():
        out, few = policy_file(results, method, REGIME), short_instances(strange, 4, horizon=HORIZON)
        if method in RANDOM:
            random_policy(method, strange, horizon=HORIZON).save(out)
        else:
            METHODS[method].train(strange, REGIME, few, out, TrainingOptions(epochs=1, search=(results,)))
    return results


@pytest.fixture(params=list(METHODS))
def name(request: pytest.FixtureRequest) -> str:
    """Each method in turn."""
    return str(request.param)


def solved(case: Case, folder: Path, name: str, instance: Instance, limit_s: float | None = None) -> Solution:
    settings = Settings(search=(folder,), time_limit_s=limit_s)
    return METHODS[name].prepare(case, REGIME, settings)(instance)


def check(name: str, case: Case, instance: Instance, answer: Solution) -> None:
    """Limits of powers are kept strictly, or no schedule is claimed."""
    if answer.schedule is None:
        assert answer.status not in (Status.OPTIMAL, Status.FEASIBLE, Status.POLICY)
        assert answer.error
        return
    verdict = score(case, instance, answer.schedule, REGIME)
    assert np.isfinite(verdict.objective)
    worst = max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation)
    assert worst <= 1e-8 or name == PROMISES_NOTHING


def test_the_same_question_has_the_same_answer(name: str, folder: Path, strange: Case) -> None:
    instance = sample_instance(strange, 77, 0)
    first, second = (solved(strange, folder, name, instance) for _ in range(2))
    assert first.schedule is not None, first.error
    np.testing.assert_array_equal(first.schedule.p, second.schedule.p)
    check(name, strange, instance, first)
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
    check(name, strange, instance, solved(strange, folder, name, instance))


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


def test_no_time_is_no_optimum(name: str, folder: Path, strange: Case) -> None:
    """What stops early says so; what asks no solver may answer, and claims no optimum."""
    answer = solved(strange, folder, name, sample_instance(strange, 77, 0), 1e-6)
    assert answer.status in (Status.TIME_LIMIT, Status.POLICY, Status.FEASIBLE)
    assert answer.schedule is not None or answer.error


@pytest.mark.parametrize("beyond", ["power", "omega"])
def test_what_cannot_be_is_no_optimum(name: str, beyond: str, folder: Path, strange: Case) -> None:
    """Machines that start beyond their limits, or turn far faster than the bound."""
    instance = sample_instance(strange, 77, 0)
    values = strange.p_max + 0.05 if beyond == "power" else np.full(len(strange.generators), 2.0)
    initial = {beyond: dict(zip(strange.generators, values.tolist(), strict=True))}
    bad = instance.model_copy(update={"initial": instance.initial.model_copy(update=initial)})
    answer = solved(strange, folder, name, bad)
    assert answer.status != Status.OPTIMAL
    assert answer.schedule is not None or (answer.status, bool(answer.error)) == (Status.INFEASIBLE, True)


def test_every_plant_judges(name: str, folder: Path, strange: Case, lagged: None) -> None:
    """Whatever a schedule was planned for, any plant of the case can be asked what it does."""
    instance = sample_instance(strange, 77, 0)
    answer = solved(strange, folder, name, instance)
    assert answer.schedule is not None
    plants = carried(strange)
    assert {"lossless", "lagged"} <= set(plants)
    for plant in plants:
        trajectory = simulate(strange, instance, answer.schedule, plant_of(strange, plant))
        verdict = judge(strange, instance, trajectory, REGIME)
        assert np.isfinite(verdict.objective)
        assert trajectory.omega.shape == trajectory.p_gen.shape == trajectory.p_set.shape
        np.testing.assert_array_equal(trajectory.p_set, answer.schedule.at(instance.grid))
