"""The wheel by itself, without torch, in an empty folder: README's first results, and gaps in the report."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pandas as pd
import pytest

from ded_bench.problem.case import REPOSITORY

WITHOUT_TORCH = """
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Missing())
from ded_bench.cli import main

sys.exit(main())
"""
SETUP = "import setuptools; setuptools.setup()"


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """Built from this checkout, outside of it, with what is installed here."""
    folder = tmp_path / "wheel"
    folder.mkdir()
    steps = ["egg_info", "--egg-base", folder, "build", "--build-base", folder / "build", "bdist_wheel"]
    command = [sys.executable, "-c", SETUP, "-q", *steps, "--bdist-dir", folder / "b", "-d", folder / "dist"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = (folder / "dist").glob("*.whl")
    return built


@pytest.fixture
def command(wheel: Path, tmp_path: Path) -> list[str]:
    """`ded-bench` from the unpacked wheel, where torch cannot be imported."""
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    for source in (REPOSITORY / "ded_bench").rglob("*.py"):
        target = site / source.relative_to(REPOSITORY)
        shutil.copystat(source, target)  # what Numba has compiled already, it finds by file and date
        for compiled in (source.parent / "__pycache__").glob(f"{source.stem}.*.nb?"):
            (target.parent / "__pycache__").mkdir(exist_ok=True)
            shutil.copy2(compiled, target.parent / "__pycache__")
    (site / "without_torch.py").write_text(WITHOUT_TORCH)
    return [sys.executable, "-m", "without_torch"]


def check_weight(wheel: Path) -> None:
    """It has models, policies and objectives of the reference runs; no rows, no schedules, no figures."""
    with zipfile.ZipFile(wheel) as archive:
        kept = [item for item in archive.infolist() if "_reference_runs/" in item.filename]
        assert "ded_bench/py.typed" in archive.namelist()
        whole = sum(item.compress_size for item in archive.infolist())
    assert {Path(item.filename).suffix for item in kept} == {".safetensors", ".csv"}
    assert {Path(item.filename).name for item in kept if item.filename.endswith("csv")} == {"objectives.csv"}
    assert whole < 20e6


def test_answers_and_gaps_in_an_empty_folder(wheel: Path, command: list[str], tmp_path: Path) -> None:
    check_weight(wheel)
    place = tmp_path / "empty"
    place.mkdir()
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "site"), "OMP_NUM_THREADS": "1"}

    def run(arguments: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            [*command, *arguments.split()],
            cwd=place,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done

    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    solve, report, *_ = re.findall(r"^ded-bench (.*)$", readme, re.MULTILINE)
    assert solve == "solve --method ded-dpc,ded-ko-knots --regime TO --limit 2"
    said = run(solve).stderr
    package = tmp_path / "site" / "ded_bench" / "_reference_runs" / "9bus-reference"
    assert f"from {package / 'policies' / 'ded-dpc-TO.safetensors'}" in said
    assert f"from {package / 'koopman' / 'koopman.safetensors'}" in said
    first, *_, last = run(report).stdout.splitlines()
    assert "methods and settings keep every limit" in first
    assert last.endswith("; read results/9bus/report.html or results/9bus/report.md")
    assert (place / "results" / "9bus" / "report.html").is_file()
    summary = pd.read_csv(place / "results" / "9bus" / "tables" / "summary.csv").set_index("method")
    for method in ("ded-dpc", "ded-ko-knots"):
        assert summary.loc[method, "n"] == 2
        assert -0.1 < summary.loc[method, "gap_percent_mean"] < 1.0
    assert [path.name for path in place.iterdir()] == ["results"]
