"""One page over several grids: what is read, tables across them, figures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.report.overview import read_grid
from ded_bench.results.rows import Results, Row
from ded_bench.results.timing import TIMING, TimingRow
from tests.reading import Page

#: Generators of the shipped cases that the tests have rows of.
GENERATORS = {"9bus": 2, "two-area": 3, "39bus": 9}


def results_of(folder: Path, case: str) -> Path:
    """The reference and ded-slp, 1 % above it, on two instances; times grow as generators squared."""
    names = ("ded" if case == "9bus" else "ded-radau", "ded-slp")
    facts = {"feasible": True, "feasible_strict": True, "freq_violation_hz": 0.0, "ramp_violation": 0.0}
    facts |= {"bound_violation": 0.0, "initial_violation": 0.0, "case": case}
    rows = [
        Row(instance, "test", "TO", name, "default", "Optimal", objective=100.0 + place, **facts)
        for instance in ("a", "b")
        for place, name in enumerate(names)
    ]
    rows[-1] = dataclasses.replace(rows[-1], freq_violation_hz=1e-3, feasible=False)
    Results(folder).add(rows)
    seconds = 0.1 * GENERATORS[case] ** 2
    times = TimingRow("r", 1, "TO", "ded-slp", "default", "a", "Optimal", solve_s=seconds, case=case)
    TIMING.write(folder / "timing.csv", [dataclasses.replace(times, peak_memory_mib=300.0, host="h")])
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("results")
    return [results_of(folder / case, case) for case in GENERATORS]


def test_the_page_and_its_tables(folders: list[Path], tmp_path: Path) -> None:
    """From the smallest grid to the largest, whatever the order of the folders."""
    out = tmp_path / "overview"
    assert main(["overview", "--results", *map(str, folders[::-1]), "--out", str(out)]) == 0

    def table(name: str) -> pd.DataFrame:
        return pd.read_csv(out / "tables" / f"{name}.csv").set_index(["regime", "title"])

    assert list(pd.read_csv(out / "tables" / "grids.csv")["generators"]) == list(GENERATORS.values())
    gaps = table("gaps")
    assert list(gaps.columns) == list(GENERATORS)
    assert gaps.loc[("TO", "DED (SLP)")].to_list() == ["+1 (2)"] * 3
    assert gaps.loc[("TO", "DED (Radau)")].to_list() == ["–", "reference", "reference"]
    assert table("verified").loc[("TO", "DED (SLP)"), "39bus"] == "100% → 50%"
    assert table("violations").loc[("TO", "DED (SLP)"), "39bus"] == "0.001"
    page = Page((out / "overview.html").read_text())
    assert not page.open
    assert not list(page.every("img"))
    assert f"- Times of {', '.join(GENERATORS)} were taken on: h.\n" in (out / "overview.md").read_text()


def test_folders_without_results_of_one_shipped_case_are_refused(folders, threebus, tmp_path, capsys) -> None:
    with pytest.raises(InputError, match="is missing"):
        read_grid(tmp_path)
    row = Row("a", "test", "TO", "ed", "default", "Optimal", objective=1.0, case="9bus")
    Results(tmp_path / "two").add([row, dataclasses.replace(row, instance="b", case="39bus")])
    with pytest.raises(InputError, match="is not one: 39bus, 9bus"):
        read_grid(tmp_path / "two")
    Results(tmp_path / "own").add([dataclasses.replace(row, case="threebus")])
    with pytest.raises(InputError, match="threebus: no such case"):
        read_grid(tmp_path / "own")
    assert read_grid(tmp_path / "own", [threebus]).case == threebus
    Results(tmp_path / "chosen").add([dataclasses.replace(row, split="validation")])
    with pytest.raises(InputError, match="split: is validation in all rows"):
        read_grid(tmp_path / "chosen")
    assert (
        main(["overview", "--results", str(folders[0]), str(folders[0]), "--out", str(tmp_path / "out")]) == 2
    )
    assert "--results: 9bus: has more than one folder" in capsys.readouterr().err
    assert main(["overview", "--results", str(tmp_path / "typo"), "--out", str(tmp_path / "out")]) == 2
    assert "typo/results.csv: is missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
