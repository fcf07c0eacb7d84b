"""One page over several grids: sizes, gaps, violations, times and memory against size, trainings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.break_even import MANY
from ded_bench.files.strict import write_atomically
from ded_bench.report.columns import Column
from ded_bench.report.figures.growth import gap_figure, growth_figure
from ded_bench.report.figures.style import save_figure
from ded_bench.report.grids import Grid, across, on_ac, payoffs, points, read_grid, sizes, slopes, trainings
from ded_bench.report.online_section import OWN, own_lines
from ded_bench.report.page import (
    Block,
    Heading,
    Items,
    Picture,
    SideBySide,
    Table,
    Text,
    render_html,
    render_markdown,
)
from ded_bench.report.render import to_markdown
from ded_bench.run.environment import environment, now

_HEAD = (Column("regime", "Regime"), Column("title", "Method"))
SIZES = (
    Column("case", "Grid"),
    Column("buses", "buses"),
    Column("generators", "generators"),
    Column("loads", "loads"),
    Column("tests", "test instances"),
    Column("judged", "instances with rows"),
    Column("modes_hz", "modes", "Hz"),
    Column("damping", "least damping", form=".1%"),
    Column("tight_hz", "tightest bound", "Hz"),
    Column("knots", "knots"),
    Column("reference", "gaps are to"),
)
#: A table of so many grids leaves room for a figure beside it.
BESIDE = 3
#: Values that grow with the grid, and what their axes say.
VALUES = (("solve_s", "time per schedule (s)"), ("peak_memory_mib", "peak memory (MiB)"))
SLOPES = (
    *_HEAD,
    Column("solve_s", "exponent of time", form=".2f"),
    Column("solve_s_grids", "grids"),
    Column("peak_memory_mib", "exponent of memory", form=".2f"),
    Column("peak_memory_mib_grids", "grids"),
)
TRAININGS = (
    Column("case", "Grid"),
    Column("name", "model or policy"),
    Column("seconds", "training", "s"),
    Column("instances", "instances"),
    Column("trajectories", "trajectories"),
    Column("parameters", "parameters"),
    Column("device", "device"),
)
PAYOFF = (
    Column("case", "Grid"),
    *_HEAD,
    Column("rival", "other"),
    Column("training_s", "training", "s", ".3g"),
    Column("paid_after", "paid after", "schedules", ".0f"),
    *(
        Column(name, text, unit, form)
        for own, what, unit, form in (
            ("gap_percent_mean", "gap", "%", ".3g"),
            ("freq_violation_hz_mean", "mean excess", "Hz", ".2g"),
            ("correct_rate", "feasible", "", ".0%"),
            ("solve_s", "one schedule", "s", ".2g"),
            ("many_s", f"training and {MANY}", "s", ".3g"),
        )
        for name, text in ((own, what), (f"rival_{own}", "other's"))
    ),
)
EXPLANATION = (
    "Methods stand with their default settings on their default surrogate. Gaps are means over `n` instances "
    "of the signed 100·(J / J_ref − 1), both re-simulated, to each grid's own reference.",
    "**Claimed → verified**: share of the instances on which the method says it succeeded, and on which the "
    "scorer finds every limit kept. **Validated**: of the instances that the full AC network can carry under "
    "some schedule, the share on which it finds the same schedule feasible.",
    "Times are medians, alone on one machine with one thread (`ded-bench bench`); memory is the most that "
    "the method's process held, all that it imports included. Exponents b are of value = a · generators^b, "
    "by least squares on logarithms, on three grids at least.",
)


def write_overview(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write `overview.md`, `overview.html`, tables and figures.

    Args:
        folders: results folders, one shipped case each.

    Returns:
        The files written.

    Raises:
        InputError: a folder holds no results, or not those of one shipped case.
    """
    grids = sorted((read_grid(folder) for folder in folders), key=lambda g: len(g.case.generators))
    found = points(grids)
    tables = _tables(grids, found)
    files = []
    for name, table in tables.items():
        texts = (("csv", table.frame.to_csv(index=False)), ("md", to_markdown(table.frame, table.columns)))
        for form, text in texts:
            files.append(out / "tables" / f"{name}.{form}")
            write_atomically(files[-1], text)
    pictures = _draw(found, out)
    files += [out / "figures" / f"{name}.{form}" for name in pictures for form in ("png", "pdf")]
    seen = {grid.case.id: Path(os.path.relpath(grid.folder, out)).as_posix() for grid in grids}
    blocks = _blocks(grids, seen, tables, pictures)
    write_atomically(out / "overview.md", render_markdown(blocks))
    write_atomically(out / "overview.html", render_html(blocks, out))
    return [*files, out / "overview.md", out / "overview.html"]


def _tables(grids: Sequence[Grid], found: pd.DataFrame) -> dict[str, Table]:
    """All tables by the name of their file."""
    columns = (*_HEAD, *(Column(grid.case.id, grid.case.id) for grid in grids))
    cells = {
        "gaps": ("Mean gap to the reference, % (instances)", _gap),
        "verified": ("Claimed → verified: success and feasibility", _rates),
        "violations": ("Largest excess over the frequency bound, Hz", _number("freq_violation_hz_max")),
        "times": ("Median time of a schedule, s", _number("solve_s")),
        "memory": ("Peak memory of the method's process, MiB", _number("peak_memory_mib")),
    }
    tables = {"grids": Table(sizes(grids), SIZES, "The grids")}
    for name, (caption, cell) in cells.items():
        frame = across(found, cell)
        if len(frame):
            tables[name] = Table(frame, columns, caption)
    validated = across(on_ac(grids), _validated)
    if len(validated):
        cases = tuple(Column(name, name) for name in validated.columns if name not in ("regime", "title"))
        caption = "Claimed → verified → validated on the full AC network (instances), mean excess there"
        tables["ac"] = Table(validated, (*_HEAD, *cases), caption)
    fitted = slopes(found, [name for name, _ in VALUES])
    fitted = fitted[fitted[[name for name, _ in VALUES]].notna().any(axis=1)]
    if len(fitted):
        tables["slopes"] = Table(fitted, SLOPES, "How time and memory grow with the number of generators")
    trained = trainings(grids)
    if len(trained):
        tables["trainings"] = Table(trained, TRAININGS, "What was trained")
    worth = payoffs(grids)
    if len(worth):
        caption = "Trained policies beside linear programs, which need no training"
        tables["payoff"] = Table(worth, PAYOFF, caption)
    operated = pd.concat([own_lines(grid.folder, grid.case).assign(case=grid.case.id) for grid in grids])
    if len(operated):
        caption = "The closed loop: methods at their own latency, forecasts as announced"
        tables["online"] = Table(operated, (Column("case", "Grid"), *OWN), caption)
    return tables


def _gap(row: dict[str, Any]) -> str:
    if row["is_reference"]:
        return "reference"
    return f"{row['gap_percent_mean']:+.3g} ({row['n']})" if row["n"] else ""


def _rates(row: dict[str, Any]) -> str:
    return f"{row['success_rate']:.0%} → {row['correct_rate']:.0%}"


def _validated(row: dict[str, Any]) -> str:
    shares = " → ".join(f"{row[name]:.0%}" for name in ("claimed", "verified", "validated"))
    excess = row["freq_violation_hz_mean"]
    return f"{shares} ({row['instances']})" + ("" if np.isnan(excess) else f", {1e3 * excess:.2g} mHz")


def _number(name: str) -> Any:
    return lambda row: "" if np.isnan(row[name]) else f"{row[name]:.3g}"


def _draw(found: pd.DataFrame, out: Path) -> dict[str, Picture]:
    """The figures that there is data for, by name."""
    pictures = {}
    known = [(name, label) for name, label in VALUES if found[name].notna().any()]
    if known:
        save_figure(growth_figure(found, known), out / "figures" / "growth")
        caption = "Time and memory of each method against the number of generators. Hollow: some infeasible."
        pictures["growth"] = Picture("figures/growth.png", caption)
    if found["gap_percent_mean"].notna().any():
        save_figure(gap_figure(found), out / "figures" / "gap")
        caption = "Mean gap to each grid's reference; linear within ±0.01 %. Hollow: some infeasible."
        pictures["gap"] = Picture("figures/gap.png", caption)
    return pictures


def _blocks(
    grids: Sequence[Grid], seen: dict[str, str], tables: dict[str, Table], pictures: dict[str, Picture]
) -> list[Block]:
    """The page; `seen` says where the folder of each grid lies, seen from there."""

    def part(heading: str, *names: str) -> list[Block]:
        known: dict[str, Block] = {**tables, **pictures}
        inside = [known[name] for name in names if name in known]
        return [Heading(heading), *inside] if inside else []

    gaps = part("Gaps", "gaps", "gap")
    if len(gaps) == 3 and len(grids) <= BESIDE:  # its heading, the table and the figure
        gaps = [gaps[0], SideBySide((gaps[1],), (gaps[2],))]
    missing = [] if "times" in tables else [Text("No method was timed alone yet; run `ded-bench bench`.")]
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    hosts = sorted({str(host) for grid in grids for host in grid.timing["host"]})
    items = [f"`{case}`: `{folder}`, seen from this page" for case, folder in seen.items()]
    return [
        Heading(f"Dynamics-aware economic dispatch on {len(grids)} grids", 1),
        Text(_finding(tables)),
        *part("The grids", "grids"),
        *gaps,
        Items(EXPLANATION),
        *part("Claimed and verified", "verified", "violations", "ac"),
        *part("Time and memory against size", "growth", "slopes", "times", "memory"),
        *missing,
        *part("The closed loop", "online"),
        *part("Trainings", "payoff", "trainings"),
        Heading("Where the rows come from"),
        Items((*items, f"Times taken on: {', '.join(hosts) or '–'}.", f"Written {now()} with: {here}.")),
    ]


def _finding(tables: dict[str, Table]) -> str:
    """What the exponents say, in a sentence."""
    if "slopes" not in tables:
        return "Too few grids were timed to say how times grow with size."
    fitted = tables["slopes"].frame
    tight = fitted[fitted["regime"] == fitted["regime"].iloc[-1]].dropna(subset=["solve_s"])
    named = [f"{row.title} {row.solve_s:.1f}" for row in tight.sort_values("solve_s").itertuples()]
    regime = fitted["regime"].iloc[-1]
    return f"In {regime}, time grows with the number of generators to the power of: {', '.join(named)}."
