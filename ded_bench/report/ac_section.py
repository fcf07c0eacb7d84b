"""The report's part on the second truth: claimed, verified and validated side by side."""

from __future__ import annotations

from collections.abc import Iterator

from ded_bench.evaluate.ac_summary import validated, with_ac
from ded_bench.evaluate.summary import benchmark_rows, title
from ded_bench.report.columns import Column
from ded_bench.report.gallery import Gallery
from ded_bench.report.page import Block, Heading, Items, Table
from ded_bench.run.ac_scoring import AcResults
from ded_bench.run.pool import Call

VALIDATED = (
    Column("regime", "Regime"),
    Column("title", "Method"),
    Column("instances", "n"),
    Column("claimed", "claimed", form=".0%"),
    Column("verified", "verified", form=".0%"),
    Column("validated", "validated", form=".0%"),
    Column("validated_strict", "strictly", form=".0%"),
    Column("only_verified", "verified, not validated", form=".0%"),
    Column("no_solution", "no solution", form=".0%"),
    Column("freq_violation_hz_mean", "frequency mean", "Hz"),
    Column("freq_violation_hz_max", "frequency max", "Hz"),
    Column("n", "n (cost)"),
    Column("gap_percent_mean", "cost over the optimum on AC", "%"),
)


def draw_ac(gallery: Gallery) -> Iterator[Call]:
    """No figures."""
    yield from ()


def ac_tables(gallery: Gallery) -> dict[str, Table]:
    """The table, if schedules were scored on the AC network."""
    sources = gallery.sources
    rows = [row for row in AcResults(sources.results.folder).rows.values() if row.case == sources.case.id]
    frame = validated(with_ac(benchmark_rows(sources.rows), rows)) if rows else None
    if frame is None or not len(frame):
        return {}
    return {"validated": Table(frame, VALIDATED, "Claimed by solvers, verified here, validated on AC")}


def ac_blocks(gallery: Gallery) -> list[Block]:
    """Heading, explanation and table; nothing without rows."""
    tables = ac_tables(gallery)
    if not tables:
        return []
    sources = gallery.sources
    both = with_ac(benchmark_rows(sources.rows), AcResults(sources.results.folder).rows.values())
    scored, carried = (frame["instance"].nunique() for frame in (both, both[both["carried"]]))
    text = (
        "The same schedules on the full AC network (`ded-bench score --results DIR --truth ac`): lines with "
        "losses, voltages that move, E' of the machines fixed, loads of constant power. Claimed: the "
        "solver's status; verified: feasible for the scorer on the lossless network; validated: on AC.",
        f"Of {scored} instances the AC network can carry {carried} under some schedule of the folder; the "
        "table counts these. The others have no equilibrium at their initial powers and loads, or later.",
        f"{title('ded-slp', 'ac')} optimises on the AC network: it is the yardstick of cost there, and its "
        "violations on the lossless network are no failure of its own.",
    )
    return [Heading("A second truth: the full AC network"), Items(text), *tables.values()]
