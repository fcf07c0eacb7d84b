"""Everything that a report is made from, read once. A table that cannot be read is an error, not a gap."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from ded_bench.analysis.certificate import Certificate, read_certificates
from ded_bench.analysis.paper_numbers import Paper, read_paper
from ded_bench.analysis.reference import Reference, choose_reference
from ded_bench.analysis.summary import gaps, judged_rows
from ded_bench.files.arrays import read_arrays
from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_text
from ded_bench.files.table import records
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.benchmark import load_manifest, load_split
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.objectives import reference_objectives
from ded_bench.results.rows import Results
from ded_bench.results.timing import TIMING, WARM_UP, read_timing, timing_summary
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import linear_model


@dataclass(frozen=True, eq=False)
class History:
    """How a training went.

    Attributes:
        name: of the policy's file.
        method: that was trained; empty if the policy is not there.
        table: columns seconds and, if they were taken, training, held out, and terms of the loss.
    """

    name: str
    method: str
    table: pd.DataFrame


@dataclass(frozen=True, eq=False)
class Sources:
    """What a report of one case is made from.

    Attributes:
        reference: what gaps are measured against.
        rows: all rows of the case in the results table with their gaps; `judged`: those that the tables are
            about.
        calls: the timing table; `timing`: one row per (regime, method, settings), see `timing_summary`.
        other_times: how many more the timing table has, of other cases.
        paper: the paper's numbers, if they are about this very case.
        instances: those of the benchmark, test instances first, by id.
        test_count: how many of them are test instances.
        problems_version: of the benchmark's files; empty if there are none.
        rollouts: tables of the Koopman models' errors by the name of their file.
        notes: what could not be used, in sentences.
    """

    case: Case
    results: Results
    reference: Reference
    rows: pd.DataFrame
    judged: pd.DataFrame
    calls: pd.DataFrame
    timing: pd.DataFrame
    other_times: int
    paper: Paper | None
    instances: dict[str, Instance]
    test_count: int
    problems_version: str
    models: list[Koopman]
    rollouts: dict[str, pd.DataFrame]
    histories: list[History]
    certificates: tuple[Certificate, ...]
    notes: list[str] = field(default_factory=list)


def read_sources(case: Case, folder: Path, problems: Path) -> Sources:
    """Read a results folder and the benchmark that it is about.

    Args:
        problems: folder of the case's instances, split, manifest and the paper's numbers.

    Raises:
        InputError: there is no such folder, nothing in it, only rows of other cases, or something wrong.
    """
    paths = ResultsFolder(folder)
    if not any(path.exists() for path in paths.contents):
        raise InputError(folder, "", "holds no results" if folder.is_dir() else "is no folder")
    results = Results(folder)
    rows = results.frame()
    others = sorted(set(rows["case"]) - {case.id, ""})
    if others and len(rows[rows["case"].isin([case.id, ""])]) == 0:
        raise InputError(
            paths.results, "case", f"holds rows of {', '.join(others)}, not of {case.id}; give --case"
        )
    rows = rows[rows["case"].isin([case.id, ""])].reset_index(drop=True)
    reference = choose_reference(rows, read_paper(problems), reference_objectives(case))
    rows = gaps(rows, reference.objectives)
    calls = read_timing(paths.timing)
    timings = timing_summary(calls)
    timing = timings[timings["case"] == case.id]
    notes: list[str] = []
    instances, test_count, version = _benchmark(case, problems, notes)
    return Sources(
        case,
        results,
        reference,
        rows,
        judged_rows(rows),
        TIMING.frame([call for call in calls if call.case == case.id and call.round != WARM_UP]),
        timing,
        len(timings) - len(timing),
        _paper(case, problems, notes),
        instances,
        test_count,
        version,
        _models(case, paths, notes),
        {path.name.removesuffix(".errors.csv"): _read_numbers(path) for path in paths.all_model_errors},
        [_history(path) for path in paths.training_histories],
        read_certificates(folder),
        notes,
    )


def _benchmark(case: Case, problems: Path, notes: list[str]) -> tuple[dict[str, Instance], int, str]:
    """Instances by id, how many of them are for testing, and the version of the files."""
    instances: dict[str, Instance] = {}
    try:
        split = load_split(problems)
        manifest = load_manifest(problems)
        for name in (*split.test, *split.train):
            path = problems / "instances" / f"{name}.json"
            instances[name] = Instance.load_file(path, case)[0]
    except InputError as error:
        notes.append(f"The problem files cannot be read: {error}")
        return instances, 0, ""
    return instances, len(split.test), manifest.version if manifest else ""


def _paper(case: Case, problems: Path, notes: list[str]) -> Paper | None:
    paper = read_paper(problems)
    if paper and (unknown := sorted(set(paper.regimes) - set(case.regimes))):
        raise InputError(problems / "paper.json", f"regimes.{unknown[0]}", f"is no regime of case {case.id}")
    if paper and paper.case_fingerprint != case.fingerprint:
        notes.append("The paper's numbers are about another version of the case and left out.")
        return None
    return paper


def _models(case: Case, paths: ResultsFolder, notes: list[str]) -> list[Koopman]:
    """The linearisation, and every model that the folder holds for this case."""
    models = [linear_model(case)]
    for path in paths.models:
        try:
            models.append(Koopman.load(path, case))
        except InputError as error:
            notes.append(f"Left out: {error}")
    if len(models) == 1:
        notes.append(
            "The folder holds no Koopman model, so the linearisation stands in its figures; "
            "`ded-bench train-ko` identifies one."
        )
    return models


def _history(path: Path) -> History:
    table = _read_numbers(path)
    if "seconds" not in table or not len(table):
        raise InputError(path, "seconds", "a column with at least one number is needed")
    name = path.name.removesuffix(".history.csv")
    policy = path.with_name(f"{name}.safetensors")
    method = ""
    if policy.is_file():
        with contextlib.suppress(InputError):  # the table of trainings says what is wrong
            method = str(read_arrays(policy)[1].get("method", ""))
    return History(name, method, table.select_dtypes("number"))


def _read_numbers(path: Path) -> pd.DataFrame:
    """A table that has numbers in most columns; InputError if it is none."""
    text = read_text(path)
    (_, header), *rest = records(text, path) or [(0, [])]
    for line, cells in rest:
        if len(cells) != len(header):
            raise InputError(path, f"line {line}", f"{len(cells)} values for {len(header)} columns")
    if not header:
        raise InputError(path, "", "is empty")
    return pd.read_csv(io.StringIO(text))
