"""What an overview of several grids is made from: one results folder each, and tables across them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import GROUP, groups, main_lines, records
from ded_bench.analysis.summary import summary
from ded_bench.files.errors import InputError
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.report.sources import Sources, read_sources
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.rows import Results

#: An exponent is fitted to at least so many grids.
LEAST_GRIDS = 3


def read_grid(folder: Path) -> Sources:
    """Read the results of one shipped case.

    Raises:
        InputError: no results, several cases or one that is not shipped, or a table that is wrong.
    """
    path = ResultsFolder(folder).results
    if not path.is_file():
        raise InputError(path, "", "is missing: this is no results folder")
    names = sorted({row.case for row in Results(folder).rows.values()})
    if len(names) != 1:
        raise InputError(path, "case", f"is not one: {', '.join(names) or 'no rows'}")
    case = Case.load(names[0])
    return read_sources(case, folder, SHIPPED_CASES / case.id)


def sizes(grids: Sequence[Sources]) -> pd.DataFrame:
    """One row per grid: how large it is, how it oscillates, what its results are about."""
    rows = []
    for grid in grids:
        case, network = grid.case, Network(grid.case)
        modes = network.linearise(network.power_flow(case.p_nominal, case.load_nominal)).modes()
        modes = modes[modes.imag > 0]
        hertz = np.abs(modes) / (2 * np.pi)
        rows.append(
            {
                "case": case.id,
                "buses": case.n_bus,
                "generators": len(case.generators),
                "loads": len(case.loads),
                "tests": grid.test_count,
                "modes_hz": f"{hertz.min():.2g}–{hertz.max():.2g}" if len(hertz) else "–",
                "damping": float((-modes.real / np.abs(modes)).min()) if len(modes) else np.nan,
                "tight_hz": min(limit.largest_hz for limit in case.regimes.values()),
                "knots": case.n_knots,
                "judged": int(grid.judged["instance"].nunique()),
                "reference": grid.reference.title,
            }
        )
    return pd.DataFrame(rows)


def points(grids: Sequence[Sources]) -> pd.DataFrame:
    """One row per (grid, regime, method): gaps, rates, violations, times, memory of its main line."""
    rows = main_lines(pd.concat([grid.judged.assign(case=grid.case.id) for grid in grids], ignore_index=True))
    parts = []
    for grid in grids:
        found = summary(rows[rows["case"] == grid.case.id])
        timing = grid.timing.set_index(GROUP)
        keys = pd.MultiIndex.from_frame(found[GROUP])
        for name in ("solve_s", "peak_memory_mib"):
            found[name] = timing[name].reindex(keys).to_numpy(dtype=float)
        found["is_reference"] = found["method"] == grid.reference.method
        parts.append(found.assign(case=grid.case.id, generators=len(grid.case.generators)))
    return pd.concat(parts, ignore_index=True)


def across(table: pd.DataFrame, cell: Callable[[dict[str, Any]], str]) -> pd.DataFrame:
    """One row per regime and method, one column per grid, from the smallest to the largest.

    Args:
        table: see `points`.
        cell: what to print of a row; empty where there is nothing.
    """
    order = table.drop_duplicates("case").sort_values("generators")["case"].tolist()
    rows = []
    for regime, _, part in groups(table):
        cells = {str(row["case"]): cell(row) for row in records(part)}
        if any(cells.values()):
            known = {name: cells.get(name) or "–" for name in order}
            rows.append({"regime": regime, "title": part["title"].iloc[0]} | known)
    return pd.DataFrame(rows, columns=["regime", "title", *order])


def slopes(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Exponents b of value = a · generators^b, by least squares on logarithms, per regime and method.

    Args:
        table: see `points`.
        names: of the values; a value on fewer than LEAST_GRIDS grids has no exponent.
    """
    rows = []
    for regime, _, part in groups(table):
        row: dict[str, Any] = {"regime": regime, "title": part["title"].iloc[0]}
        for name in names:
            known = part[part[name] > 0]
            row |= {f"{name}_grids": len(known), name: np.nan}
            if known["generators"].nunique() >= LEAST_GRIDS:
                row[name] = float(np.polyfit(np.log(known["generators"]), np.log(known[name]), 1)[0])
        rows.append(row)
    return pd.DataFrame(
        rows, columns=["regime", "title", *(f for name in names for f in (name, f"{name}_grids"))]
    )
