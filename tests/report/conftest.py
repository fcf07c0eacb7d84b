"""A short 9-bus benchmark for the report, and figures that need no drawing."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from ded_bench.files.strict import write_atomically, write_record
from ded_bench.problem.benchmark import load_split, write_benchmark
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.report.figures import style

HORIZON = 1.0
TEST, TRAIN = 5, 3


@pytest.fixture(scope="module")
def problems(ninebus: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark of eight instances of one second."""
    folder = tmp_path_factory.mktemp("problems")
    write_benchmark(ninebus, TEST + TRAIN, 3, folder)
    names = sorted(path.stem for path in (folder / "instances").glob("*.json"))
    for path in (folder / "instances").glob("*.json"):
        instance, _ = Instance.load_file(path, ninebus)
        write_record(instance.model_copy(update={"horizon_s": HORIZON}), path)
    split = load_split(folder)
    write_record(
        split.model_copy(update={"test": tuple(names[:TEST]), "train": tuple(names[TEST:])}),
        folder / "split.json",
    )
    shutil.copy(SHIPPED_CASES / ninebus.id / "paper.json", folder)
    return folder


@pytest.fixture
def sketched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of figures hold a digest of what is drawn instead of the drawing, which takes long."""

    def sketch(figure: Figure, path: Path) -> None:
        lines = [line for ax in figure.axes for line in ax.get_lines()]
        drawn = b"".join(np.asarray(line.get_ydata(), dtype=float).tobytes() for line in lines)
        write_atomically(path, hashlib.sha256(drawn).hexdigest())

    monkeypatch.setattr(style, "save_figure", sketch)
