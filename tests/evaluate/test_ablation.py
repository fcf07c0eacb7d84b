"""Tables of variants: which rows the paper's tables leave to them, models and trainings side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ded_bench.evaluate.ablation import (
    ablation_table,
    main_rows,
    model_table,
    split_slug,
    starts_table,
    training_table,
)
from ded_bench.evaluate.summary import judged_rows, summary
from ded_bench.files.arrays import write_arrays
from ded_bench.methods.policy_file import policy_file
from tests.evaluate.test_summary import frame_of, row, with_gaps


@pytest.fixture
def table() -> pd.DataFrame:
    return frame_of(
        row("a", "ded", 100.0),
        row("a", "ded-ko", 101.0),
        row("a", "ded-ko", 103.0, settings="default-linear"),
        row("a", "ded-ko", 102.0, settings="default-koopman-paper"),
        row("a", "ded-ko-knots", 104.0, settings="default-linear"),
        row("a", "ded-dpc", 105.0),
        row("a", "ded-dpc", 106.0, settings="train400"),
        row("a", "ded-dpc", 120.0, settings="study"),
        row("a", "ded-dpc", 110.0, settings="study-narrow"),
        row("a", "ded-dpc", 130.0, settings="study-linear"),
        row("b", "ded-dpc", 9.0, settings="study"),
    )


def test_settings_name_their_model() -> None:
    assert split_slug("default") == ("default", "koopman")
    assert split_slug("default-linear") == ("default", "linear")
    assert split_slug("steps-25-koopman-paper") == ("steps-25", "koopman-paper")
    assert split_slug("linear") == ("linear", "koopman")


def test_the_papers_tables_keep_to_one_model_and_to_no_study(table: pd.DataFrame) -> None:
    rows = main_rows(judged_rows(table))
    assert sorted(zip(rows["method"], rows["settings"], strict=True)) == [
        ("ded", "default"),
        ("ded-dpc", "default"),
        ("ded-dpc", "train400"),
        ("ded-ko", "default"),
        ("ded-ko-knots", "default-linear"),  # it has no other
    ]


def test_models_stand_side_by_side(table: pd.DataFrame) -> None:
    models = model_table(summary(with_gaps(judged_rows(table))))
    assert models["model"].to_list() == ["koopman", "koopman-paper", "linear"]
    assert set(models["title"]) == {"DED-KO"}
    np.testing.assert_allclose(models["gap_percent_mean"], [1.0, 2.0, 3.0])
    assert not len(model_table(summary(with_gaps(frame_of(row("a", "ded", 1.0))))))
    assert not len(model_table(summary(with_gaps(frame_of()))))


def test_ablation_says_what_differs_and_what_it_cost(table: pd.DataFrame, tmp_path: Path) -> None:
    for slug, seconds in (("study", 10.0), ("study-narrow", 7.0)):
        header = {"training": {"seconds": seconds, "epochs": 6, "parameters": 5}}
        write_arrays(policy_file(tmp_path, "ded-dpc", "TO", settings=slug), {"x": np.zeros(1)}, header)
    assert not len(ablation_table(table, tmp_path))  # these are test instances: nothing is chosen on them
    knots = frame_of(row("a", "ded-ko-knots", 100.0))
    judged = pd.concat([table[table["method"] == "ded-dpc"], knots]).assign(split="validation")
    rows = ablation_table(judged, tmp_path)
    assert rows["change"].to_list() == ["width = 12", "nothing", "model = linear"]
    np.testing.assert_allclose(rows["gap_percent_mean"], [10.0, 20.0, 30.0])
    assert rows["n"].to_list() == [1, 1, 1]  # no reference on instance b
    assert rows["seconds"].to_list()[:2] == [7.0, 10.0]
    assert rows["seconds"].isna().to_list() == [False, False, True]  # no such policy in the folder
    assert not len(ablation_table(frame_of(row("a", "ded", 1.0)), tmp_path))


def test_starting_points_are_compared_by_what_the_solver_says() -> None:
    """Instance a: the same optimum; b: a better one; c: none from this start; d: none from the cold one."""
    frame = frame_of(
        row("a", "ded", 9.0, solver_objective=100.0, iterations=40),
        row("b", "ded", 9.0, solver_objective=100.0, iterations=60),
        row("c", "ded", 9.0, solver_objective=100.0, iterations=50),
        row("a", "ded", 9.0, settings="start-ed", solver_objective=100.00001, iterations=30),
        row("b", "ded", 9.0, settings="start-ed", solver_objective=99.0, iterations=20),
        row("c", "ded", settings="start-ed"),
        row("d", "ded", 9.0, settings="start-ed", solver_objective=50.0),
        row("a", "ded", 9.0, settings="accelerated", solver_objective=100.0),
        row("a", "ded-ko", 9.0, solver_objective=100.0),
    )
    found = starts_table(frame).to_dict("records")
    assert len(found) == 1
    assert found[0] | {"lowest_percent": 0, "highest_percent": 0} == {
        "regime": "TO",
        "start": "ed",
        "n": 2,
        "same": 1,
        "lowest_percent": 0,
        "highest_percent": 0,
        "iterations": 25.0,
        "iterations_cold": 50.0,
    }
    assert found[0]["lowest_percent"] == pytest.approx(-1.0)
    assert found[0]["highest_percent"] == pytest.approx(1e-5)
    assert set(judged_rows(frame)["settings"]) == {"default", "accelerated"}
    assert not len(starts_table(frame_of()))
    assert not len(starts_table(frame_of(row("a", "ded-ko", 1.0))))


def test_training_table_names_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = policy_file(tmp_path, "ded-dpc", "TO")
    write_arrays(path, {"x": np.zeros(1)}, {"training": {"seconds": 3.0}})
    path.with_name("broken.safetensors").write_bytes(b"no")
    rows = training_table(tmp_path, ["seconds"]).set_index("policy")
    assert rows.loc["ded-dpc-TO", "seconds"] == 3.0
    assert "broken.safetensors" in rows.loc["broken", "problem"]
