"""Kept schedules judged on the AC network: the table, its rows, and what cannot be judged."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import ded_bench
from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.ac_scoring import AcResults, score_on_ac
from ded_bench.run.code import code_of
from ded_bench.run.results import Results, Row
from ded_bench.run.scoring import scored_row
from ded_bench.truth.ac_simulate import score_ac
from ded_bench.truth.score import Score, score


@pytest.fixture(scope="module")
def two_area() -> Case:
    return Case.load("two-area")


@pytest.fixture
def instances(two_area: Case, quiet_instance) -> dict[str, Instance]:
    return {name: quiet_instance(two_area, id=name, horizon_s=0.2) for name in "abc"}


@pytest.fixture
def results(two_area: Case, instances: dict[str, Instance], tmp_path: Path) -> Results:
    """Three scored rows in TO; the last one's schedule is not kept."""
    results = Results(tmp_path / "results")
    for i, (name, instance) in enumerate(instances.items()):
        power = instance.p_initial(two_area)
        schedule = Schedule(np.array([0.0, 0.2]), np.array([power, power + 0.01 * i]))
        row = Row(name, "test", "TO", "ded", "default", "Optimal", case="two-area", fingerprint=f"f{i}")
        results.add([scored_row(row, score(two_area, instance, schedule, "TO"))])
        if name != "c":
            schedule.write(results.schedule_path(row.key), two_area.generators)
    return results


def test_rows_of_kept_schedules(two_area: Case, instances, results: Results) -> None:
    data = AcCase.of(two_area)
    path, rows = score_on_ac(two_area, data, instances, results)
    assert path == results.folder / "ac.csv"
    assert [row.instance for row in rows] == ["a", "b"]
    for row in rows:
        assert row.key in results.rows
        schedule = results.schedule(row.key, two_area, instances[row.instance])
        verdict = score_ac(two_area, data, instances[row.instance], schedule, "TO")
        assert verdict == Score(**{f.name: getattr(row, f.name) for f in dataclasses.fields(Score)})
        assert (row.feasible, row.feasible_strict) == (verdict.feasible, verdict.feasible_strict)
        assert (row.case, row.fingerprint) == ("two-area", results.rows[row.key].fingerprint)
        assert (row.data, row.score_code) == (data.fingerprint, code_of("ded_bench.truth.ac_simulate"))
        # The slack carries the losses, so the schedule costs more than on lossless lines.
        assert row.objective > results.rows[row.key].objective + 1.0
    assert list(AcResults(results.folder).rows.values()) == rows


def test_again_replaces_rows_and_keeps_others(two_area: Case, instances, results: Results) -> None:
    data = AcCase.of(two_area)
    _, before = score_on_ac(two_area, data, instances, results)
    del instances["a"]
    path, again = score_on_ac(two_area, data, instances, results)
    assert again == before[1:]
    assert list(AcResults(results.folder).rows.values()) == before
    assert len(path.read_text().splitlines()) == 3


def test_what_cannot_be_judged_is_a_row_that_says_why(two_area: Case, instances, results: Results) -> None:
    heavy = json.loads(instances["a"].model_dump_json(by_alias=True))
    heavy["load"]["9"]["initial"] = -40.0
    instances["a"] = Instance.model_validate_json(json.dumps(heavy))
    (key,) = (key for key in results.rows if key.instance == "b")
    results.schedule_path(key).write_bytes(b"no schedule")
    _, rows = score_on_ac(two_area, AcCase.of(two_area), instances, results)
    assert [row.objective for row in rows] == [None, None]
    assert rows[0].error == (
        "scoring failed: SimulationError: the system cannot follow this schedule: "
        "the AC power flow has no solution"
    )
    assert "b.csv.gz: cannot be read" in rows[1].error


def test_nothing_to_judge_is_an_error(two_area: Case, ninebus: Case, instances, results: Results) -> None:
    data = AcCase.of(two_area)
    with pytest.raises(InputError, match="holds no schedule of these rows"):
        score_on_ac(two_area, data, {"c": instances["c"]}, results)
    with pytest.raises(InputError, match="AC data of case 9bus"):
        score_on_ac(ninebus, data, instances, results)


def files_of(instances: dict[str, Instance], folder: Path) -> list[str]:
    folder.mkdir()
    for name, instance in instances.items():
        (folder / f"{name}.json").write_text(instance.model_dump_json(by_alias=True))
    return [str(folder / f"{name}.json") for name in instances]


def test_the_command_judges_a_folder(instances, results: Results, tmp_path: Path, capsys) -> None:
    files = files_of(instances, tmp_path / "instances")
    said = ["score", "--results", str(results.folder), "--truth", "ac", "--instance", *files]
    assert main(said) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"2 rows in {results.folder / 'ac.csv'}, 0 without a score"
    assert lines[1].endswith("rows that are feasible on the paper's network are so on AC")
    assert main([*said, "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert rows == [dataclasses.asdict(row) for row in AcResults(results.folder).rows.values()]
    (key,) = (key for key in results.rows if key.instance == "b")
    results.schedule_path(key).write_bytes(b"no schedule")
    assert main(said) == 1
    assert "2 rows" in capsys.readouterr().out


def test_the_command_judges_a_schedule(instances, results: Results, tmp_path: Path, capsys) -> None:
    """Data are those of the folder given, of the instances' own, or of the shipped case."""
    _, file, _ = files_of(instances, tmp_path / "instances")
    (key,) = (key for key in results.rows if key.instance == "b")
    said = ["score", "--schedule", str(results.schedule_path(key)), "--instance", file, "--regime", "TO"]
    assert main([*said, "--truth", "ac", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    schedule = results.schedule(key, Case.load("two-area"), instances["b"])
    verdict = ded_bench.score(instances["b"], schedule, "TO", truth="ac")
    assert found["objective"] == verdict.objective
    assert found["freq_violation_hz"] == verdict.freq_violation_hz
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "case.json").write_bytes((SHIPPED_CASES / "two-area" / "case.json").read_bytes())
    own = [*said, "--truth", "ac", "--case", str(folder)]
    assert main(own) == 2
    assert f"{folder / 'ac.json'}: no such file" in capsys.readouterr().err
    (tmp_path / "ac.json").write_text("{}")
    assert main([*said, "--truth", "ac"]) == 2
    assert f"{tmp_path / 'ac.json'}: source: field required" in capsys.readouterr().err
    (tmp_path / "ac.json").unlink()
    assert main([*said, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["objective"] < verdict.objective


@pytest.mark.parametrize(
    "options", [["--results", "X", "--update"], ["--schedules", "X", "--name", "mine", "--regime", "TO"]]
)
def test_rows_of_the_lossless_network_stay_its_own(options: list[str], capsys) -> None:
    assert main(["score", "--truth", "ac", *options]) == 2
    assert "--truth: ac: is not for --" in capsys.readouterr().err
