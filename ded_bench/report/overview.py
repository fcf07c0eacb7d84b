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
from ded_bench.files.strict import write_atomically
from ded_bench.report.columns import (
    BREAK_EVEN,
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
    break_evens,
    points,
    read_grid,
    sizes,
    slopes,
    trainings,
)
from ded_bench.report.page import (
    Block,
    Heading,
    Items,
    PageTable,
    Picture,
    Text,
    render_html,
    render_markdown,
)
from ded_bench.report.sources import Sources
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
#: What stands under which heading, by the names of tables and figures.
PARTS = {
    "The grids": ("grids",),
    "Gaps": ("gaps",),
    "Claimed and verified": ("verified", "violations"),
    "Time and memory against size": ("growth", "slopes", "times", "memory"),
    "The closed loop": ("online",),
    "Trainings": ("payoff", "trainings"),
}


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
    tables = {name: table for name, table in _tables(grids, found).items() if len(table.frame)}
    for name, table in tables.items():
        write_atomically(out / "tables" / f"{name}.csv", table.frame.to_csv(index=False))
    known: dict[str, Block] = {**tables}
    files = [out / "tables" / f"{name}.csv" for name in tables]
    if len(found):
        files.append(out / "figures" / "growth.png")
        save_figure(growth_figure(found), files[-1])
        caption = (
            "Time, memory and mean gap of each method against the number of generators; gaps are linear "
            "within ±0.01 %. Hollow: some schedules are infeasible."
        )
        known["growth"] = Picture("figures/growth.png", caption)
    blocks = _blocks(grids, out, known, tables)
    write_atomically(out / "overview.md", render_markdown(blocks))
    write_atomically(out / "overview.html", render_html(blocks, out))
    return [*files, out / "overview.md", out / "overview.html"]


def _tables(grids: Sequence[Sources], found: pd.DataFrame) -> dict[str, PageTable]:
    """All tables by the name of their file."""
    columns = (REGIME, TITLE, *(Column(grid.case.id, grid.case.id) for grid in grids))
    cells = {
        "gaps": ("Mean gap to the reference, % (instances)", _gap),
        "verified": ("Claimed → verified: success and feasibility", _rates),
        "violations": ("Largest excess over the frequency bound, Hz", _number("freq_violation_hz_max")),
        "times": ("Median time of a schedule, s", _number("solve_s")),
        "memory": ("Peak memory of the method's process, MiB", _number("peak_memory_mib")),
    }
    fitted = slopes(found, [name for name, _ in VALUES])
    fitted = fitted[fitted[[name for name, _ in VALUES]].notna().any(axis=1)]
    operated = pd.concat([titled(own_latency(grid.online)).assign(case=grid.case.id) for grid in grids])
    paid = "After how many schedules trainings have paid, beside linear programs that need none"
    loop = "The closed loop: methods at their own latency, forecasts as announced"
    return {
        "grids": PageTable(sizes(grids), GRIDS, "The grids"),
        **{name: PageTable(across(found, cell), columns, caption) for name, (caption, cell) in cells.items()},
        "slopes": PageTable(fitted, SLOPES, "How time and memory grow with the number of generators"),
        "trainings": PageTable(trainings(grids), TRAININGS, "What was trained"),
        "payoff": PageTable(break_evens(grids), BREAK_EVEN, paid),
        "online": PageTable(operated, (CASE, *ONLINE), loop),
    }


def _gap(row: dict[str, Any]) -> str:
    if row["is_reference"]:
        return "reference"
    return f"{row['gap_percent_mean']:+.3g} ({row['n']})" if row["n"] else ""


def _rates(row: dict[str, Any]) -> str:
    return f"{row['success_rate']:.0%} → {row['correct_rate']:.0%}"


def _number(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: "" if np.isnan(row[name]) else f"{row[name]:.3g}"


def _blocks(
    grids: Sequence[Sources], out: Path, known: dict[str, Block], tables: dict[str, PageTable]
) -> list[Block]:
    """The page."""
    made: list[Block] = [
        Heading(f"Dynamics-aware economic dispatch on {len(grids)} grids", 1),
        Items(EXPLANATION),
    ]
    for heading, names in PARTS.items():
        inside = [known[name] for name in names if name in known]
        made += [Heading(heading), *inside] if inside else []
    if "times" not in tables:
        made.append(Text("No method was timed alone yet; run `ded-bench bench`."))
    folders = {grid.case.id: Path(os.path.relpath(grid.folder, out)).as_posix() for grid in grids}
    items = [f"`{case}`: `{folder}`, seen from this page" for case, folder in folders.items()]
    hosts = sorted({str(host) for grid in grids for host in grid.timing["host"]})
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    items += [f"Times taken on: {', '.join(hosts) or '–'}.", f"Written {now()} with: {here}."]
    return [*made, Heading("Where the rows come from"), Items(tuple(items))]
