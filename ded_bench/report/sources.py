"""Everything that a report is made from, read once. A table that cannot be read is an error, not a gap."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import pandas as pd

from ded_bench.analysis import summary
from ded_bench.analysis.certificate import Certificate, read_certificates
from ded_bench.analysis.online_summary import online_rows, practice_rows
from ded_bench.analysis.referee import REFEREE, RefereeRow
from ded_bench.analysis.reference import Paper, Reference, choose_reference, read_paper
from ded_bench.files.arrays import read_arrays
from ded_bench.files.errors import InputError
from ded_bench.plants.plant import SimulationError, simulate
from ded_bench.problem.benchmark import load_split, select_split
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Trajectory
from ded_bench.report.columns import TRAINING
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.online_results import OnlineResults
from ded_bench.results.rows import VALIDATED, Key, Results, reference_objectives
from ded_bench.results.timing import TIMING, TimingRow, timing_summary


@dataclass(frozen=True, eq=False)
class Sources:
    """What a report of one case is made from.

    Attributes:
        case: the grid.
        results: the folder's table and schedules.
        paper: the paper's numbers, if they are about this very case.
        reference: what gaps are measured against.
        rows: all rows of the case that count, with their gaps; `key` is each row's in the results table.
        judged: those of them that the tables are about.
        timing: one row per line of the timing table, see `timing_summary`.
        instances: those of the benchmark, test instances first, by id.
        test_count: how many of them are test instances.
        problems_version: of the benchmark's files; empty if there are none.
        notes: what could not be used, in sentences; figures add theirs.
    """

    case: Case
    results: Results
    paper: Paper | None
    reference: Reference
    rows: pd.DataFrame
    judged: pd.DataFrame
    timing: pd.DataFrame
    instances: dict[str, Instance]
    test_count: int
    problems_version: str
    certificates: tuple[Certificate, ...]
    notes: list[str] = field(default_factory=list)

    @property
    def tightest(self) -> str:
        """The regime with the tightest bound."""
        return min(self.case.regimes, key=lambda name: self.case.regimes[name].largest_hz)

    @property
    def shown(self) -> pd.DataFrame:
        """Judged rows that stand beside each other: with a paper's numbers, on usual surrogates alone."""
        return summary.on_usual_model(self.judged) if self.paper else self.judged

    @cached_property
    def outcome(self) -> pd.DataFrame:
        """Of the rows shown: see `summary.outcome`."""
        return summary.outcome(self.shown, self.timing)

    @cached_property
    def online(self) -> pd.DataFrame:
        """Rows of the closed loop: see `online_rows`."""
        return online_rows(OnlineResults(self.results.folder), self.case.id)

    @cached_property
    def practice(self) -> pd.DataFrame:
        """Rows of the closed loop on an island: see `practice_rows`."""
        return practice_rows(OnlineResults(self.results.folder), self.case.id)

    def has_schedule(self, key: Key) -> bool:
        """Whether a row can be drawn: its instance is known and its schedule is in the folder."""
        try:
            return key.instance in self.instances and self.results.has_schedule(self.results.rows[key])
        except InputError as error:
            self._note(error)
            return False

    def trajectory(self, key: Key) -> Trajectory | None:
        """The simulated schedule of a row; None, and a note, if it is damaged or cannot be simulated."""
        instance = self.instances[key.instance]
        try:
            schedule = self.results.schedule(self.results.rows[key], self.case, instance)
            return simulate(self.case, instance, schedule)
        except (InputError, SimulationError) as error:
            self._note(error)
            return None

    def _note(self, error: Exception) -> None:
        if (text := f"Not drawn: {error}") not in self.notes:
            self.notes.append(text)


def read_sources(case: Case, folder: Path) -> Sources:
    """Read a results folder and the benchmark that it is about.

    Args:
        case: whose rows count; its folder has the instances and the paper's numbers.
        folder: the results folder.

    Raises:
        InputError: there is no such folder, nothing in it, only rows of other cases, or something wrong.
    """
    paths = ResultsFolder(folder)
    contents = paths.results, paths.timing, paths.online, paths.certificates, paths.koopman, paths.policies
    if not any(path.exists() for path in contents):
        raise InputError(folder, "", "holds no results" if folder.is_dir() else "is no folder")
    results, notes = Results(folder), list[str]()
    everything = summary.named(results.frame().assign(key=pd.Series(list(results.rows), dtype=object)))
    ours = everything[everything["case"].isin([case.id, ""])]
    if len(everything) and not len(ours):
        others = ", ".join(sorted(set(everything["case"])))
        raise InputError(paths.results, "case", f"holds rows of {others}, not of {case.id}; give --case")
    (counting, left_out), (judged, _) = summary.newest(ours), summary.newest(summary.judged_rows(ours))
    notes += left_out
    paper = read_paper(case.folder)
    reference = choose_reference(counting, paper, reference_objectives(case))
    newest_of = everything.groupby("method")["method_version"].max().to_dict()

    def is_of_today(one: RefereeRow | TimingRow) -> bool:  # it is about these answers; 0 is unknown
        return one.method_version in (0, newest_of.get(one.method, one.method_version))

    def is_about(fingerprint: str, key: Key) -> bool:  # this row, not one that it replaced
        return key in results.rows and results.rows[key].fingerprint == fingerprint

    elsewhere = [r for r in VALIDATED.existing(paths.validated) if r.plant == "detailed" != case.plant_name]
    judgements: dict[str, dict[Key, bool | None]] = {
        "validated": {r.key[0]: r.feasible for r in elsewhere if is_about(r.fingerprint, r.key[0])},
        "confirmed": {
            r.key: r.confirmed
            for r in filter(is_of_today, REFEREE.existing(paths.referee))
            if not r.row or is_about(r.row, r.key)
        },
    }

    calls = [call for call in TIMING.existing(paths.timing) if call.case == case.id and is_of_today(call)]
    of_rows = counting.groupby(summary.GROUP)["made_with"].last()
    for job, made in {call.job: f"{call.model} {call.policy}".strip() for call in calls}.items():
        if of_rows.get(job, made) != made:
            notes.append(f"Times of {summary.title(*job[1:])} {job[0]} are of {made}, its rows are not.")
    instances, test_count, version = _benchmark(case, notes)
    if paper and (unknown := sorted(set(paper.regimes) - set(case.regimes))):
        problem = f"is no regime of case {case.id}"
        raise InputError(case.folder / "paper.json", f"regimes.{unknown[0]}", problem)
    if paper and paper.case_fingerprint != case.fingerprint:
        notes.append("The paper's numbers are about another version of the case and left out.")
        paper = None
    return Sources(
        case=case,
        results=results,
        paper=paper,
        reference=reference,
        rows=summary.judged_elsewhere(summary.gaps(counting, reference.objectives), judgements),
        judged=summary.judged_elsewhere(summary.gaps(judged, reference.objectives), judgements),
        timing=summary.named(timing_summary(calls)),
        instances=instances,
        test_count=test_count,
        problems_version=version,
        certificates=read_certificates(folder),
        notes=notes,
    )


def _benchmark(case: Case, notes: list[str]) -> tuple[dict[str, Instance], int, str]:
    """Instances by id, how many of them are for testing, and the version of the files."""
    try:
        found, tests = select_split(case.folder, "all"), load_split(case.folder).test
    except InputError as error:
        notes.append(f"The problem files cannot be read: {error}")
        return {}, 0, ""
    return {instance.id: instance for instance, _ in found.instances}, len(tests), found.version


def trainings(paths: Iterable[Path]) -> pd.DataFrame:
    """How models or policies were trained, from their files' headers; `problem` if one is damaged."""
    rows = []
    for path in paths:
        try:
            facts, problem = read_arrays(path)[1].get("training"), ""
        except InputError as error:
            facts, problem = None, str(error)
        rows.append({"name": path.stem, "problem": problem} | (facts if isinstance(facts, dict) else {}))
    return pd.DataFrame(rows, columns=[column.name for column in TRAINING])
