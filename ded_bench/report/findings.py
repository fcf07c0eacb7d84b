"""What the rows say, in three sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from ded_bench.analysis.summary import title
from ded_bench.problem.case import Case
from ded_bench.report.columns import TABLE_V, TABLE_VI, tabulate
from ded_bench.report.paper import Line


def findings(case: Case, lines: Sequence[Line], reference: str) -> list[str]:
    """At most three sentences about the lines of Tables V and VI.

    Args:
        reference: title of the method that gaps are measured against.
    """
    return [*_fastest(case, lines, reference), *_claims(lines), *_paper(lines)]


def _fastest(case: Case, lines: Sequence[Line], reference: str) -> Iterator[str]:
    """The fastest method that keeps every limit in the tightest regime."""
    tight = min(case.regimes, key=lambda name: case.regimes[name].omega_hz)
    ours = [line for line in lines if line.regime == tight and line.statistics["rows"]]
    good = [line for line in ours if line.statistics["correct_rate"] == 1 and "solve_s" in line.timing]
    good = [line for line in good if np.isfinite(line.timing["solve_s"])]
    limit = f"{tight} (|ω| ≤ {case.regimes[tight].omega_hz:g} Hz)"
    if not good:
        if any("solve_s" in line.timing for line in ours):
            yield f"**Fast and feasible:** no timed method keeps every limit on every instance of {limit}."
        return
    best = min(good, key=lambda line: line.timing["solve_s"])
    text = (
        f"**Fast and feasible:** in {limit}, {best.title} is the fastest method whose schedules keep every "
        f"limit on all {best.statistics['rows']} instances: {_seconds(best.timing['solve_s'])}"
    )
    if not best.reference and np.isfinite(best.increase_percent):
        text += f" and a mean gap of {best.increase_percent:+.2g} % to {reference}"
    yield text + _ratio(best, ours) + "."


def _ratio(best: Line, lines: Sequence[Line]) -> str:
    """How much longer the reference takes."""
    slow = next((line.timing.get("solve_s", np.nan) for line in lines if line.reference), np.nan)
    ratio = slow / best.timing["solve_s"]
    if not (np.isfinite(ratio) and ratio > 1):
        return ""
    return f", {float(f'{ratio:.2g}'):,g} times faster than that"


def _claims(lines: Sequence[Line]) -> Iterator[str]:
    """Where claims and verdicts differ most."""
    judged = [line for line in lines if np.isfinite(line.statistics["freq_violation_hz_max"])]
    if not judged:
        return
    apart = max(judged, key=lambda line: line.statistics["success_rate"] - line.statistics["correct_rate"])
    claimed, verified = apart.statistics["success_rate"], apart.statistics["correct_rate"]
    if claimed > verified:
        yield (
            f"**Claimed and verified:** they differ most for {apart.title} in {apart.regime}, which claims "
            f"success on {claimed:.0%} of the instances and is feasible on {verified:.0%}; its frequency "
            f"exceeds the limit by up to {apart.statistics['freq_violation_hz_max']:.2g} Hz."
        )
    else:
        yield "**Claimed and verified:** every schedule that its method claims is feasible."


def _paper(lines: Sequence[Line]) -> Iterator[str]:
    """How many cells of the paper's tables are ahead; else the smallest gap of all but the reference."""
    papers = [line for line in lines if line.paper and line.statistics["rows"]]
    if papers:
        tables = [tabulate(columns, papers) for columns in (TABLE_V, TABLE_VI)]
        cells = pd.concat([t.filter(like="against_paper").stack() for t in tables])
        counts = cells[cells != ""].value_counts()
        behind = [
            f"{row['title']} {row['regime']}"
            for table in tables
            for row in table.to_dict("records")
            if "behind" in row.values()
        ]
        ahead = f"{counts.get('ahead', 0)} of {counts.sum()} cells"
        text = f"**Against the paper:** {ahead} of both tables are ahead of its numbers"
        text += f", {counts['equal']} equal" if "equal" in counts else ""
        names = ", ".join(dict.fromkeys(behind))
        yield f"{text}; behind: {names}." if behind else f"{text}, none behind."
        return
    others = [
        line
        for line in lines
        if not line.reference and line.statistics["n"] and line.statistics["correct_rate"] == 1
    ]
    if others:
        most = max(line.statistics["n"] for line in others)  # a method that was asked little proves little
        asked = (line for line in others if line.statistics["n"] == most)
        best = min(asked, key=lambda line: abs(line.increase_percent))
        name = title(best.method, best.settings)
        yield (
            f"**Nearest to the reference:** of the methods that keep every limit, {name} in {best.regime}, "
            f"{best.increase_percent:+.2g} % on {most} instance{'s' if most > 1 else ''}."
        )


def _seconds(value: float) -> str:
    return f"{1e3 * value:.3g} ms" if value < 1 else f"{value:.3g} s"
