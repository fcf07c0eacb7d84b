"""Cases: the published 9-bus data, every way a case.json can be wrong, and where names resolve."""

from __future__ import annotations

import copy
import json
import pickle
import shlex
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record, write_record
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.lossless_case import LosslessCase
from ded_bench.problem.sampling import sample_instance


def test_ninebus_holds_the_papers_tables(ninebus):
    """Tables I, II and IV: voltages, lines, limits of half the nominal power to either side, ε = 5e-4."""
    voltage = {bus.id: bus.v for bus in ninebus.buses}
    assert voltage == {"s": 1.04, "2": 1.02533, "3": 1.02536} | {bus: 1.0 for bus in "456789"}
    assert {frozenset((line.from_bus, line.to_bus)): line.x for line in ninebus.lines} == {
        frozenset(("s", "4")): 0.0576,
        frozenset(("4", "5")): 0.092,
        frozenset(("5", "6")): 0.17,
        frozenset(("3", "6")): 0.0586,
        frozenset(("6", "7")): 0.1008,
        frozenset(("7", "8")): 0.072,
        frozenset(("8", "2")): 0.0625,
        frozenset(("8", "9")): 0.161,
        frozenset(("9", "4")): 0.085,
    }
    assert (ninebus.slack, ninebus.generators, ninebus.loads) == ("s", ("2", "3"), ("5", "7", "9"))
    np.testing.assert_allclose(ninebus.p_min, 0.5 * ninebus.p_nominal, rtol=1e-15)
    np.testing.assert_allclose(ninebus.p_max, 1.5 * ninebus.p_nominal, rtol=1e-15)
    np.testing.assert_array_equal(ninebus.p_nominal, [1.63, 0.85])
    np.testing.assert_array_equal(ninebus.load_nominal, [-0.9, -1.0, -1.25])
    assert ninebus.ramp_pu_per_s * ninebus.sampling.dt_s == pytest.approx(5e-4, rel=1e-15)
    assert ninebus.sampling.horizon_s / ninebus.sampling.dt_s == 6000


def test_regime_bounds_are_in_rad_per_s(case):
    """0.05 Hz and 0.0016 Hz, times 2π."""
    assert case.omega_bound("NO") == pytest.approx(0.3141592653589793, rel=1e-15)
    assert case.omega_bound("TO") == pytest.approx(0.010053096491487338, rel=1e-15)
    with pytest.raises(InputError, match=r"unknown regime 'XX'.*NO, TO"):
        case.omega_bound("XX")


def test_a_case_resolves_from_name_folder_and_file(ninebus, tmp_path, monkeypatch):
    """Shipped names work from any working directory; a path wins where one exists."""
    monkeypatch.chdir(tmp_path)
    shipped = SHIPPED_CASES / "9bus"
    assert Case.load("9bus") == Case.load(shipped) == Case.load(shipped / "case.json") == ninebus
    with pytest.raises(InputError, match=r"nowhere: no such case .*9bus"):
        Case.load("nowhere")
    with pytest.raises(InputError, match=r"case.json: cannot be read"):
        Case.load(tmp_path)
    (tmp_path / "case.json").write_text('{"schema": "ded-bench/case/4", "mean_hz": 1}')
    with pytest.raises(InputError, match=r"case.json: schema: is 'ded-bench/case/4', not one of"):
        Case.load(tmp_path)


def _set(path: str, value: object):
    """Return an edit of plain JSON data that sets the field at a dotted path."""

    def edit(data):
        *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        for part in parents:
            data = data[part]
        data[last] = value

    return edit


def _drop(path: str):
    def edit(data):
        *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        for part in parents:
            data = data[part]
        del data[last]

    return edit


def _append_line(start: str, stop: str):
    return lambda data: data["lines"].append({"from": start, "to": stop, "r": 0.0, "x": 0.1})


def _add_bus(**bus: object):
    return lambda data: data["buses"].append(bus)


@pytest.mark.parametrize(
    ("edit", "field", "problem"),
    [
        (_set("colour", "red"), "colour", "unknown field"),
        (_drop("f0_hz"), "f0_hz", "required"),
        (_set("schema", "ded-bench/case/3"), "schema", "'ded-bench/case/1' or 'ded-bench/case/2'"),
        (_set("schema", []), "schema", "'ded-bench/case/1' or 'ded-bench/case/2'"),
        (_set("knots", 50), "", "knots: belongs to schema ded-bench/case/2"),
        (_set("source", "a book"), "", "source: belongs to schema ded-bench/case/2"),
        (
            _set("machines.plant.ramp_pu_per_s", 0.1),
            "",
            "machines.plant.ramp_pu_per_s: belongs to schema ded-bench/case/2",
        ),
        (
            _set("sampling.rate_relative_per_s", None),
            "",
            "sampling.rate_relative_per_s: belongs to schema ded-bench/case/2",
        ),
        (_set("sampling.rate_relative_per_s", [0.0, 0.1]), "sampling", "exactly one of"),
        (_drop("sampling.rate_pu_per_s"), "sampling", "exactly one of"),
        (_set("id", "../evil"), "id", "pattern"),
        (_set("f0_hz", "60"), "f0_hz", "valid number"),
        (_set("buses.0.v", 0.0), "buses.0.v", "greater than"),
        (_set("buses.0.v", float("nan")), "buses.0.v", "finite"),
        (_set("buses.0.kind", "windmill"), "buses.0.kind", "'slack', 'generator', 'load' or 'junction'"),
        (_set("lines.0.x", 0.0), "lines.0.x", "greater than"),
        (_set("machines.plant.p_min", 0.9), "machines.plant", "p_min must be below p_max"),
        (_set("machines", {}), "", "exactly the generator buses"),
        (_set("regimes", {}), "", "at least one regime"),
        (_set("sampling.start_s", [2.0, 1.0]), "sampling", "start_s: lower end above upper end"),
        (_set("sampling.cost", [-1.0, 1.0]), "sampling", "cost: must not be negative"),
        (_set("sampling.rate_zero_probability", 1.5), "sampling.rate_zero_probability", "less than or equal"),
        (_set("buses.0.id", "s"), "", "same id"),
        (_set("buses.0.p_nominal", None), "", "town: p_nominal belongs to load buses"),
        (_set("buses.1.kind", "junction"), "", "exactly one slack"),
        (_append_line("town", "moon"), "", "town-moon does not join two known buses"),
        (_add_bus(id="moon", kind="junction", v=1.0), "", "moon is not connected"),
    ],
)
def test_a_wrong_case_is_refused(threebus, edit, field, problem):
    """Each error names the source, the field, and what is wrong with it."""
    data = json.loads(threebus.model_dump_json(by_alias=True))
    edit(data)
    with pytest.raises(InputError) as caught:
        parse_record(LosslessCase, json.dumps(data), Path("bad/case.json"))
    assert caught.value.source == str(Path("bad/case.json"))
    assert caught.value.field == field
    assert problem in caught.value.problem


def _extended(data: dict) -> dict:
    """The same case in case/2, with every field that it adds."""
    data = copy.deepcopy(data) | {"schema": "ded-bench/case/2", "knots": 7, "source": {"data": "a book"}}
    data["machines"]["plant"]["ramp_pu_per_s"] = 0.125
    data["sampling"]["rate_relative_per_s"] = [0.01, 0.5]
    del data["sampling"]["rate_pu_per_s"]
    return data


def test_fields_of_case_2(threebus):
    """What each of them means, and that a case keeps them through a file."""
    plain = json.loads(threebus.model_dump_json(by_alias=True))
    case = parse_record(LosslessCase, json.dumps(_extended(plain)), "case.json")
    assert json.loads(case.model_dump_json(by_alias=True)) == _extended(plain)
    np.testing.assert_array_equal(case.ramp, [0.125])
    np.testing.assert_array_equal(case.load_rate, [[0.01 * 1.0], [0.5 * 1.0]])
    np.testing.assert_array_equal(case.knot_times(3.0), [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    assert case.fingerprint != threebus.fingerprint
    for path, value, field in (
        ("knots", 1, "knots"),
        ("knots", 50.0, "knots"),
        ("machines.plant.ramp_pu_per_s", 0.0, "machines.plant.ramp_pu_per_s"),
        ("sampling.rate_relative_per_s", [-0.1, 0.1], "sampling"),
        ("sampling.rate_relative_per_s", [0.2, 0.1], "sampling"),
    ):
        data = _extended(plain)
        _set(path, value)(data)
        with pytest.raises(InputError) as caught:
            parse_record(LosslessCase, json.dumps(data), "case.json")
        assert caught.value.field == field


def test_without_fields_of_case_2_a_case_is_as_in_case_1(ninebus, threebus):
    """The case's ramp limit and range of rates, 50 knots; nothing of case/2 is written."""
    np.testing.assert_array_equal(ninebus.ramp, [0.05, 0.05])
    np.testing.assert_array_equal(ninebus.load_rate, [[0.01] * 3, [0.05] * 3])
    assert ninebus.n_knots == 50
    np.testing.assert_array_equal(ninebus.knot_times(60.0), np.linspace(0.0, 60.0, 50))
    assert (ninebus.fingerprint, threebus.fingerprint) == ("a0fa08e05e5d", "8cc5cb23d399")
    file = json.loads((SHIPPED_CASES / "9bus" / "case.json").read_text())
    assert json.loads(ninebus.model_dump_json(by_alias=True)).keys() == file.keys()


def test_equality_is_about_content_not_about_what_was_computed(case_file: Path) -> None:
    used, fresh = Case.load(case_file), Case.load(case_file)
    assert used.p_min.shape == (len(used.generators),)  # now cached in one of them
    sent = copy.deepcopy(used)
    assert used == fresh == sent
    assert len({used, fresh, sent}) == 1
    instance = sample_instance(used, 1, 2)
    assert instance.grid[0] == 0.0
    assert instance == sample_instance(fresh, 1, 2)
    assert instance != sample_instance(fresh, 1, 3)


def test_a_case_that_arrives_again_is_read_once(case_file: Path) -> None:
    """Requests of one case cost its bytes only; what a worker keeps by case stays with it."""
    case = Case.load(case_file)
    first, again = pickle.loads(pickle.dumps(case)), pickle.loads(pickle.dumps([case, 1]))[0]
    assert first is again
    assert first == case
    assert (first.fingerprint, first.folder, first._grid) == (case.fingerprint, case.folder, case._grid)


def test_the_place_of_a_case_is_one_word_of_a_shell(threebus: Case, tmp_path: Path) -> None:
    folder = tmp_path / "my grid"
    write_record(threebus, folder / "case.json")
    assert shlex.split(Case.load(folder).place) == [str(folder)]
    assert Case.load("9bus").place == "9bus"
