"""What an overview of several grids is made from: one results folder each, and tables across them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.break_even import payoff
from ded_bench.analysis.paper_numbers import read_paper
from ded_bench.analysis.reference import DEFAULT, Reference, choose_reference
from ded_bench.analysis.summary import benchmark_rows, gaps, groups, judged_rows, summary
from ded_bench.evaluate.ablation import main_rows, split_slug, training_table
from ded_bench.evaluate.ac_summary import validated, with_ac
from ded_bench.files.arrays import read_arrays
from ded_bench.files.errors import InputError
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.benchmark import load_split
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.objectives import reference_objectives
from ded_bench.results.rows import Results
from ded_bench.results.timing import read_timing, timing_summary
from ded_bench.run.ac_scoring import AcResults

#: An exponent is fitted to at least so many grids.
LEAST_GRIDS = 3


@dataclass(frozen=True, eq=False)
class Grid:
    """One case and its results.

    Attributes:
        judged: rows with their gaps that the tables are about, default settings only.
        every: the same with all settings and models.
        timing: see `timing.timing_summary`.
        ac: what the AC network says of the same schedules, all settings: see `ac_summary.validated`.
    """

    case: Case
    folder: Path
    reference: Reference
    judged: pd.DataFrame
    every: pd.DataFrame
    timing: pd.DataFrame
    ac: pd.DataFrame


def read_grid(folder: Path) -> Grid:
    """Read the results of one shipped case.

    Raises:
        InputError: no results, several cases or one that is not shipped, or a table that is wrong.
    """
    paths = ResultsFolder(folder)
    if not paths.results.is_file():
        raise InputError(paths.results, "", "is missing: this is no results folder")
    frame = Results(folder).frame()
    names = sorted(set(frame["case"]))
    if len(names) != 1:
        raise InputError(paths.results, "case", f"is not one: {', '.join(names) or 'no rows'}")
    case = Case.load(names[0])
    problems = SHIPPED_CASES / case.id
    reference = choose_reference(frame, read_paper(problems), reference_objectives(case))
    every = judged_rows(gaps(frame, reference.objectives))
    rows = main_rows(every)
    usual = [split_slug(slug)[0] == DEFAULT for slug in rows["settings"]]
    timing = timing_summary([row for row in read_timing(paths.timing) if row.case == case.id])
    ac = validated(with_ac(benchmark_rows(frame), AcResults(folder).rows.values()))
    return Grid(case, folder, reference, rows[usual], every, timing, ac)


def sizes(grids: Sequence[Grid]) -> pd.DataFrame:
    """One row per grid: how large it is, how it oscillates, what its results are about."""
    rows = []
    for grid in grids:
        case = grid.case
        network = Network(case)
        modes = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
        modes = modes[modes.imag > 0]
        hertz = np.abs(modes) / (2 * np.pi)
        tight = min(limit.omega_hz for limit in case.regimes.values())
        rows.append(
            {
                "case": case.id,
                "buses": len(case.buses),
                "generators": len(case.generators),
                "loads": len(case.loads),
                "tests": len(load_split(SHIPPED_CASES / case.id).test),
                "modes_hz": f"{hertz.min():.2g}–{hertz.max():.2g}" if len(hertz) else "–",
                "damping": float((-modes.real / np.abs(modes)).min()) if len(modes) else np.nan,
                "tight_hz": tight,
                "knots": case.n_knots,
                "judged": int(grid.judged["instance"].nunique()),
                "reference": grid.reference.title,
            }
        )
    return pd.DataFrame(rows)


def points(grids: Sequence[Grid]) -> pd.DataFrame:
    """One row per (grid, regime, method): gaps, rates, violations, times, memory."""
    parts = []
    for grid in grids:
        found = summary(grid.judged)
        timing = grid.timing.set_index(["regime", "method", "settings"])
        keys = list(found[["regime", "method", "settings"]].itertuples(index=False, name=None))
        for name in ("solve_s", "build_s", "peak_memory_mib"):
            found[name] = [float(timing[name].get(key, np.nan)) for key in keys]
        found["is_reference"] = found["method"] == grid.reference.method
        named = [title.split(" [")[0] for title in found["title"]]
        parts.append(found.assign(case=grid.case.id, generators=len(grid.case.generators), title=named))
    return pd.concat(parts, ignore_index=True)


def on_ac(grids: Sequence[Grid]) -> pd.DataFrame:
    """One row per (grid, regime, method, settings): claimed, verified, validated on the AC network."""
    parts = [grid.ac.assign(case=grid.case.id, generators=len(grid.case.generators)) for grid in grids]
    return pd.concat(parts, ignore_index=True)


def across(table: pd.DataFrame, cell: Callable[[dict[str, Any]], str]) -> pd.DataFrame:
    """One row per regime and method, one column per grid, from the smallest to the largest.

    Args:
        table: see `points` and `on_ac`.
        cell: what to print of a row; empty where there is nothing.
    """
    order = table.drop_duplicates("case").sort_values("generators")["case"].tolist()
    titles = [row["title"] for _, _, _, part in groups(table) for row in part.to_dict("records")]
    rows = []
    for regime in sorted(table["regime"].unique()):
        for title in dict.fromkeys(titles):
            mine = table[(table["regime"] == regime) & (table["title"] == title)]
            cells = {str(row["case"]): cell(row) for row in mine.to_dict("records")}
            if any(cells.values()):
                known = {name: cells.get(name) or "–" for name in order}
                rows.append({"regime": regime, "title": title} | known)
    return pd.DataFrame(rows, columns=["regime", "title", *order])


def slopes(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Exponents b of value = a · generators^b, by least squares on logarithms, per regime and method.

    Args:
        table: see `points`.
        names: of the values; a value on fewer than LEAST_GRIDS grids has no exponent.
    """
    rows = []
    for (regime, title), part in table.groupby(["regime", "title"], sort=False):
        row: dict[str, Any] = {"regime": regime, "title": title}
        for name in names:
            known = part[part[name] > 0]
            row[f"{name}_grids"] = len(known)
            row[name] = np.nan
            if known["generators"].nunique() >= LEAST_GRIDS:
                row[name] = float(np.polyfit(np.log(known["generators"]), np.log(known[name]), 1)[0])
        rows.append(row)
    columns = ["regime", "title", *(f for name in names for f in (name, f"{name}_grids"))]
    return pd.DataFrame(rows, columns=columns).sort_values("regime", kind="stable", ignore_index=True)


def trainings(grids: Sequence[Grid]) -> pd.DataFrame:
    """What was trained for each grid, models and policies, from the headers of their files."""
    shown = ["seconds", "instances", "trajectories", "parameters", "device"]
    parts = []
    for grid in grids:
        policies = training_table(grid.folder, shown).rename(columns={"policy": "name"})
        models = [
            {"name": path.name.removesuffix(".safetensors")} | _training(path)
            for path in ResultsFolder(grid.folder).models
        ]
        parts.append(pd.concat([pd.DataFrame(models, columns=["name", *shown]), policies[["name", *shown]]]))
        parts[-1].insert(0, "case", grid.case.id)
    return pd.concat(parts, ignore_index=True)


def payoffs(grids: Sequence[Grid]) -> pd.DataFrame:
    """What the trained policies of all grids are worth: see `payoff`."""
    parts = []
    for grid in grids:
        seconds = training_table(grid.folder, ["seconds"]).set_index("policy")["seconds"].dropna()
        by_file = {str(name): float(value) for name, value in seconds.items()}
        parts.append(payoff(grid.every, grid.timing, by_file))
        parts[-1].insert(0, "case", grid.case.id)
    return pd.concat(parts, ignore_index=True)


def _training(path: Path) -> dict[str, Any]:
    facts = read_arrays(path)[1].get("training")
    return facts if isinstance(facts, dict) else {}
