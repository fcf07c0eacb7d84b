"""A trained method is one module and one line in the registry: it is trained, solves and travels."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ded_bench.cli import main
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import policy_file
from ded_bench.problem.benchmark import select_split
from ded_bench.problem.case import Case
from ded_bench.results.folder import ResultsFolder
from ded_bench.run.tasks import make_tasks, pack, solve_and_score
from ded_bench.surrogates.linear import linear_model
from tests.learned_method import LEARNED


@pytest.fixture
def out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, threebus: Case) -> Path:
    """The method's one line is added; a results folder that has a Koopman model."""
    monkeypatch.setitem(METHODS, LEARNED.name, LEARNED)
    monkeypatch.chdir(tmp_path)
    linear_model(threebus).save(ResultsFolder(tmp_path / "out").model("koopman"))
    return tmp_path / "out"


def train(problem: Path, out: Path, *more: str) -> int:
    arguments = ["train-dpc", "--method", "learned", "--regime", "TO", "--case", str(problem)]
    return main([*arguments, "--results", str(out), *more])


def test_it_is_trained_by_the_command(problem: Path, out: Path, capsys) -> None:
    assert train(problem, out) == 0
    assert "3 epochs in 0 s, training loss" in capsys.readouterr().out
    path = policy_file(out, "learned", "TO")
    history = pd.read_csv(path.with_suffix(".history.csv"))
    assert history["epoch"].tolist() == [1, 2, 3]
    assert history["training"].is_monotonic_decreasing
    assert history["held out"].isna().all()
    before = path.read_bytes()
    assert train(problem, out, "--epochs", "9") == 0
    assert path.read_bytes() == before  # it is there already
    assert train(problem, out, "--force", "--epochs", "9") == 0
    assert path.read_bytes() != before
    assert train(problem, out, "--model", "linear") == 0
    assert policy_file(out, "learned", "TO", "linear").is_file()
    assert train(problem, out, "--force", "--device", "cuda") == 2
    assert "--device" in capsys.readouterr().err


def test_it_solves_here_and_where_the_results_folder_is_not(problem: Path, out: Path, tmp_path: Path) -> None:
    """What its artifacts name travels with the task, and nothing else."""
    train(problem, out)
    chosen = select_split(problem)
    settings = Settings("slope=0.001", search=(out,))
    (task, *_) = make_tasks(chosen.case, chosen.instances, ["learned"], ["TO"], settings)
    here = solve_and_score(chosen.case, task, "lossless").solution
    assert here.schedule is not None
    files = pack(LEARNED.artifacts(chosen.case, "TO", settings))
    assert sorted(name for name, _ in files) == [
        "koopman/koopman.safetensors",
        "policies/learned-TO.safetensors",
    ]
    elsewhere = dataclasses.replace(settings, search=(tmp_path / "nowhere",))
    packed = dataclasses.replace(task, settings=elsewhere, files=files)
    there = solve_and_score(chosen.case, packed, "lossless").solution
    assert there.schedule is not None, there.error
    np.testing.assert_array_equal(there.schedule.p, here.schedule.p)
    alone = solve_and_score(chosen.case, dataclasses.replace(packed, files=()), "lossless").solution
    assert "train-dpc --method learned --regime TO" in alone.error


def test_a_place_that_cannot_be_written_is_told_before_the_training(problem: Path, out: Path, capsys) -> None:
    (out / "file").write_text("")
    for place in (out / "file" / "p.safetensors", Path("/proc/p.safetensors")):
        assert train(problem, out, "--out", str(place)) == 2
        _, line = capsys.readouterr().err.splitlines()  # after what it is about to do
        assert str(place) in line
        assert "cannot be written" in line
