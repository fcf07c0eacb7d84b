"""Cases that generic tests run on, and small factories for records."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from ded_bench.files.strict import Record, parse_record
from ded_bench.problem.benchmark import write_benchmark
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.pool import Workers
from tests.detailed_cases import MIXED

#: Generic properties are tested on every case here: the paper's; a chain slack - load - generator whose power
#: flow, load angle and modes have closed forms; and a meshed grid with all that a case may have: junctions, a
#: double line, a feed-in among the loads, a slack in the middle, 50 Hz, ramp limits and rates of case/2.
CASE_FILES = {
    "9bus": SHIPPED_CASES / "9bus" / "case.json",
    "threebus": Path(__file__).parent / "cases" / "threebus" / "case.json",
    "fivemachine": Path(__file__).parent / "cases" / "fivemachine" / "case.json",
}

#: Their tests compile more than all others; what stands first in the list goes to one process.
LEARNED = ("test_admm.py", "test_policies.py")

R = TypeVar("R", bound=Record)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of learned methods stand together, so that two processes do not compile the same at once."""
    items.sort(key=lambda item: item.path.name not in LEARNED)


@pytest.fixture(scope="session", params=list(CASE_FILES))
def case_file(request: pytest.FixtureRequest) -> Path:
    """Path of each case's file in turn."""
    return CASE_FILES[request.param]


@pytest.fixture(scope="session")
def case(case_file: Path) -> Case:
    """Each case in turn."""
    return Case.load(case_file)


@pytest.fixture(scope="session")
def ninebus() -> Case:
    """The shipped 9-bus case, for its known numbers."""
    return Case.load(CASE_FILES["9bus"])


@pytest.fixture(scope="session")
def threebus() -> Case:
    """The three-bus chain, for closed forms."""
    return Case.load(CASE_FILES["threebus"])


def _alter(record: Record, **changes: Any) -> Record:
    data = json.loads(record.model_dump_json(by_alias=True))
    return parse_record(type(record), json.dumps(data | changes), "altered record")


@pytest.fixture(scope="session")
def alter() -> Callable[..., Any]:
    """`alter(record, **fields)`: a validated copy with top-level fields replaced by plain JSON data."""
    return _alter


def _quiet_instance(case: Case, **changes: Any) -> Instance:
    data = {
        "schema": "ded-bench/instance/1",
        "id": f"{case.id}-quiet",
        "case": case.id,
        "seed": 0,
        "horizon_s": case.sampling.horizon_s,
        "dt_s": case.sampling.dt_s,
        "cost": dict.fromkeys(case.priced, 0.5),
        "load": {
            bus: {"initial": value, "start": 0.0, "duration": 0.0, "rate": 0.0}
            for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
        },
        "initial": {
            "power": dict(zip(case.generators, case.p_nominal.tolist(), strict=True)),
            "omega": {bus: 0.0 for bus in case.generators},
        },
    }
    return parse_record(Instance, json.dumps(data | changes), "quiet instance")


@pytest.fixture(scope="session")
def quiet_instance() -> Callable[..., Instance]:
    """`quiet_instance(case, **fields)`: at rest at nominal power, no load ramps, unless fields say so."""
    return _quiet_instance


@pytest.fixture(scope="session")
def island() -> Case:
    """The mixed island of `detailed_cases`."""
    return Case.load(MIXED)


@pytest.fixture(scope="module")
def problem(threebus: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark folder with five instances of the three-bus chain, one for testing."""
    folder = tmp_path_factory.mktemp("problems") / "threebus"
    write_benchmark(threebus, 5, 2022, folder)
    return folder


def _constant(instance: Instance, power: Any) -> Schedule:
    return Schedule(t=np.array([0.0, instance.horizon_s]), p=np.array([power, power], dtype=float))


@pytest.fixture(scope="session")
def constant() -> Callable[..., Schedule]:
    """`constant(instance, power)`: the schedule that holds `power`, shape (n_gen,), pu."""
    return _constant


def answers_here(
    workers: Workers, calls: Any, labels: Any, limits_s: Any = None
) -> Iterator[tuple[Any, object]]:
    """Stands for `Workers.imap`."""
    for label, call in zip(labels, calls, strict=True):
        function, arguments = pickle.loads(pickle.dumps(call))  # as on their way to another process
        try:
            yield label, function(*arguments)
        except Exception as error:
            yield label, error


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """What goes to worker processes is done in this one, whose libraries are loaded already.

    For tests of what is done with the answers; processes have tests of their own.
    """
    monkeypatch.setattr(Workers, "imap", answers_here)
