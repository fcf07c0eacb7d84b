"""One page over several grids: sizes, gaps, violations, times and memory against size."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.online_summary import own_latency
from ded_bench.analysis.summary import GROUP, findings, groups, main_lines, records, summary
from ded_bench.files.errors import InputError
from ded_bench.methods.options import DEFAULT
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Case
from ded_bench.report.columns import CASE, GRIDS, ONLINE, REGIME, TITLE, Column
from ded_bench.report.page import Block, PageTable, bullets, folded, write_page
from ded_bench.report.sources import Sources, read_sources
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.rows import Results
from ded_bench.run.environment import environment, now

EXPLANATION = (
    "Methods stand with their default settings, on the surrogate that most of these grids have rows with. "
    "Gaps are means over `n` instances of the signed 100·(J / J_ref − 1), both re-simulated, to each grid's "
    "own reference.",
    "**Claimed → verified**: share of the instances on which the method says it succeeded, and on which the "
    "scorer finds every limit kept.",
    "Times are medians, alone on the machine with one thread (`ded-bench bench`), and compare between grids "
    "of one host only (see the end); memory is the most that the method's process held, all that it imports "
    "included.",
)


def write_overview(folders: Sequence[Path], out: Path, cases: Sequence[Case] = ()) -> list[Path]:
    """Write `overview.md`, `overview.html` and tables as CSV.

    Args:
        folders: results folders, one case each.
        out: folder of the page.
        cases: those of them that do not ship.

    Returns:
        The files written.

    Raises:
        InputError: a folder holds no results, or not those of one case that is known; two are of one case.
    """
    grids = [read_grid(folder, cases) for folder in folders]
    if twice := [case for case, n in Counter(grid.case.id for grid in grids).items() if n > 1]:
        raise InputError("--results", twice[0], "has more than one folder")
    grids.sort(key=lambda grid: len(grid.case.generators))
    found, said = points(grids), list[str]()
    for grid in grids:  # of default settings, in its tightest regime
        rows = grid.outcome
        lines = rows[(rows["regime"] == grid.tightest) & (rows["settings"] == DEFAULT)]
        said += [f"{grid.case.id}: {text}" for text in findings(lines, grid.reference.title)]
    made: list[Block] = [
        f"# Dynamics-aware economic dispatch on {len(grids)} grids",
        bullets(said),
        *folded("How to read this page", bullets(EXPLANATION)),
    ]
    for heading, blocks in _parts(grids, found).items():
        made += [f"## {heading}", *blocks] if blocks else []
    if not found["time_s"].notna().any():
        made.append("No method was timed alone yet; run `ded-bench bench`.")
    places = {grid.case.id: Path(os.path.relpath(grid.results.folder, out)) for grid in grids}
    items = [f"`{case}`: `{place.as_posix()}`, seen from this page" for case, place in places.items()]
    hosts = sorted({str(host) for grid in grids for host in grid.timing["host"]})
    items += [f"{grid.case.id}: {note}" for grid in grids for note in grid.notes if note.startswith("Times")]
    for host in hosts:
        timed = ", ".join(grid.case.id for grid in grids if (grid.timing["host"] == host).any())
        items.append(f"Times of {timed} were taken on: {host}.")
    items.append(f"Written {now()} with: {environment()}.")
    return write_page([*made, "## Where the rows come from", bullets(items)], out, "overview")


def _parts(grids: Sequence[Sources], found: pd.DataFrame) -> dict[str, list[Block]]:
    """Tables by the heading that they stand under."""
    cases = (REGIME, TITLE, *(Column(grid.case.id, grid.case.id) for grid in grids))

    def table(file: str, frame: pd.DataFrame, columns: tuple[Column, ...], caption: str) -> list[Block]:
        return [PageTable(frame, columns, caption, file)] if len(frame) else []

    def side_by_side(file: str, cell: Callable[[dict[str, Any]], str], caption: str) -> list[Block]:
        return table(file, across(found, cell), cases, caption)

    operated = pd.concat([own_latency(grid.online).assign(case=grid.case.id) for grid in grids])
    excess = "Largest excess over the frequency bound, Hz"
    loop = "The closed loop: methods at their own latency, forecasts as announced"
    return {
        "The grids": table("grids", sizes(grids), GRIDS, "The grids"),
        "Gaps": side_by_side("gaps", _gap, "Mean gap to the reference, % (instances)"),
        "Claimed and verified": [
            *side_by_side(
                "verified",
                _rates,
                "Claimed → verified on its plant → validated on full machine models, of what these carry",
            ),
            *side_by_side("violations", _number("freq_violation_hz_max"), excess),
        ],
        "Time and memory against size": [
            *side_by_side("times", _number("time_s"), "Median time of a schedule, s"),
            *side_by_side("memory", _number("peak_memory_mib"), "Peak memory of the method's process, MiB"),
        ],
        "The closed loop": table("online", operated, (CASE, *ONLINE), loop),
    }


def read_grid(folder: Path, cases: Sequence[Case] = ()) -> Sources:
    """Read the results of one case: one of these, or one that ships.

    Raises:
        InputError: no results, several cases or one that is unknown, rows of validation instances alone, or
            a table that is wrong.
    """
    path = ResultsFolder(folder).results
    if not path.is_file():
        raise InputError(path, "", "is missing: this is no results folder")
    names = sorted({row.case for row in Results(folder).rows.values()})
    if len(names) != 1:
        raise InputError(path, "case", f"is not one: {', '.join(names) or 'no rows'}")
    case = next((case for case in cases if case.id == names[0]), None) or Case.load(names[0])
    sources = read_sources(case, folder)
    if not len(sources.judged):
        raise InputError(path, "split", "is validation in all rows, which serve choices: nothing to compare")
    return sources


def sizes(grids: Sequence[Sources]) -> pd.DataFrame:
    """One row per grid: how large it is, how it oscillates, what its results are about."""
    rows = []
    for grid in grids:
        case, modes = grid.case, plant_of(grid.case).nominal().modes
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
        timing = grid.timing.set_index(GROUP)[["time_s", "peak_memory_mib"]]
        found = summary(rows[rows["case"] == grid.case.id]).join(timing, on=GROUP)
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


def _gap(row: dict[str, Any]) -> str:
    if row["is_reference"]:
        return "reference"
    return f"{row['gap_percent_mean']:+.3g} ({row['n']})" if row["n"] else ""


def _rates(row: dict[str, Any]) -> str:
    more = [row["validated_rate"]] * bool(row["validated_n"])
    return " → ".join(f"{share:.0%}" for share in (row["success_rate"], row["correct_rate"], *more))


def _number(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "" if np.isnan(row[name]) else f"{row[name]:.3g}"
