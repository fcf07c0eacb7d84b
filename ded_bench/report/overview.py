"""One page over several grids: sizes, gaps, violations, times and memory against size, trainings."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import titled
from ded_bench.analysis.online_summary import own_latency
from ded_bench.report.columns import (
    CASE,
    GRIDS,
    ONLINE,
    REGIME,
    SLOPES,
    TITLE,
    TRAININGS,
    Column,
)
from ded_bench.report.figures.growth import VALUES, growth_figure
from ded_bench.report.figures.style import save_figure
from ded_bench.report.grids import (
    across,
    points,
    read_grid,
    sizes,
    slopes,
)
from ded_bench.report.page import (
    Block,
    Heading,
    Items,
    PageTable,
    Picture,
    Text,
    write_page,
)
from ded_bench.report.sources import Sources, trainings
from ded_bench.run.environment import environment, now

EXPLANATION = (
    "Methods stand with their default settings, on the surrogate that most of these grids have rows with. "
    "Gaps are means over `n` instances of the signed 100·(J / J_ref − 1), both re-simulated, to each grid's "
    "own reference.",
    "**Claimed → verified**: share of the instances on which the method says it succeeded, and on which the "
    "scorer finds every limit kept.",
    "Times are medians, alone on one machine with one thread (`ded-bench bench`); memory is the most that "
    "the method's process held, all that it imports included. Exponents b are of value = a · generators^b, "
    "by least squares on logarithms, on three grids at least.",
)


def write_overview(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write `overview.md`, `overview.html`, tables as CSV and a figure.

    Args:
        folders: results folders, one shipped case each.
        out: folder of the page.

    Returns:
        The files written.

    Raises:
        InputError: a folder holds no results, or not those of one shipped case.
    """
    grids = sorted((read_grid(folder) for folder in folders), key=lambda grid: len(grid.case.generators))
    found = points(grids)
    made: list[Block] = [
        Heading(f"Dynamics-aware economic dispatch on {len(grids)} grids", 1),
        Items(EXPLANATION),
    ]
    for heading, blocks in _parts(grids, found, out).items():
        made += [Heading(heading), *blocks] if blocks else []
    if not found["solve_s"].notna().any():
        made.append(Text("No method was timed alone yet; run `ded-bench bench`."))
    folders_here = {grid.case.id: Path(os.path.relpath(grid.folder, out)).as_posix() for grid in grids}
    items = [f"`{case}`: `{folder}`, seen from this page" for case, folder in folders_here.items()]
    hosts = sorted({str(host) for grid in grids for host in grid.timing["host"]})
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    items += [f"Times taken on: {', '.join(hosts) or '–'}.", f"Written {now()} with: {here}."]
    return write_page([*made, Heading("Where the rows come from"), Items(tuple(items))], out, "overview")


def _parts(grids: Sequence[Sources], found: pd.DataFrame, out: Path) -> dict[str, list[Block]]:
    """Tables and the figure by the heading that they stand under."""
    cases = (REGIME, TITLE, *(Column(grid.case.id, grid.case.id) for grid in grids))

    def table(file: str, frame: pd.DataFrame, columns: tuple[Column, ...], caption: str) -> list[Block]:
        return [PageTable(frame, columns, caption, file)] if len(frame) else []

    def side_by_side(file: str, cell: Callable[[dict[str, Any]], str], caption: str) -> list[Block]:
        return table(file, across(found, cell), cases, caption)

    values = [name for name, _ in VALUES]
    fitted = slopes(found, values)
    fitted = fitted[fitted[values].notna().any(axis=1)]
    operated = pd.concat([titled(own_latency(grid.online)).assign(case=grid.case.id) for grid in grids])
    excess = "Largest excess over the frequency bound, Hz"
    trained = [
        trainings((*grid.results.paths.models, *grid.results.paths.policies)).assign(case=grid.case.id)
        for grid in grids
    ]
    loop = "The closed loop: methods at their own latency, forecasts as announced"
    return {
        "The grids": table("grids", sizes(grids), GRIDS, "The grids"),
        "Gaps": side_by_side("gaps", _gap, "Mean gap to the reference, % (instances)"),
        "Claimed and verified": [
            *side_by_side("verified", _rates, "Claimed → verified: success and feasibility"),
            *side_by_side("violations", _number("freq_violation_hz_max"), excess),
        ],
        "Time and memory against size": [
            *_growth(found, out),
            *table("slopes", fitted, SLOPES, "How time and memory grow with the number of generators"),
            *side_by_side("times", _number("solve_s"), "Median time of a schedule, s"),
            *side_by_side("memory", _number("peak_memory_mib"), "Peak memory of the method's process, MiB"),
        ],
        "The closed loop": table("online", operated, (CASE, *ONLINE), loop),
        "Trainings": table("trainings", pd.concat(trained), TRAININGS, "What was trained"),
    }


def _growth(found: pd.DataFrame, out: Path) -> list[Block]:
    """The figure, drawn into the page's folder."""
    if not len(found):
        return []
    save_figure(growth_figure(found), out / "figures" / "growth.png")
    caption = (
        "Time, memory and mean gap of each method against the number of generators; gaps are linear "
        "within ±0.01 %. Hollow: some schedules are infeasible."
    )
    return [Picture("figures/growth.png", caption)]


def _gap(row: dict[str, Any]) -> str:
    if row["is_reference"]:
        return "reference"
    return f"{row['gap_percent_mean']:+.3g} ({row['n']})" if row["n"] else ""


def _rates(row: dict[str, Any]) -> str:
    return f"{row['success_rate']:.0%} → {row['correct_rate']:.0%}"


def _number(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "" if np.isnan(row[name]) else f"{row[name]:.3g}"
