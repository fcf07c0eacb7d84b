"""What results say, in sentences: who keeps every limit and at what cost, who breaks which, who failed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import records
from ded_bench.methods.registry import METHODS


def own_first(found: pd.DataFrame) -> pd.DataFrame:
    """Lines of a table in their order, but methods that are not the suite's before all others."""
    is_ours = found["method"].isin(list(METHODS))
    return pd.concat([found[~is_ours], found[is_ours]])


def findings(found: pd.DataFrame, reference: str) -> Iterator[str]:
    """Sentences about the methods that were run, for each regime.

    Args:
        found: see `summary.outcome`.
        reference: title of what gaps are to.
    """
    for regime, lines in found.groupby("regime", sort=False):
        kept = records(lines[(lines["feasible"] == lines["rows"]) & lines["seconds"].notna()])
        said = [f"{len(kept)} of {len(lines)} methods and settings keep every limit on every instance"]
        if kept:
            fastest = min(kept, key=lambda row: row["seconds"])
            said.append(f"the fastest of these is {_cost(fastest, reference)}")
            cheapest = min(kept, key=lambda row: np.nan_to_num(row["gap_percent"], nan=np.inf))
            said += [f"the cheapest {_cost(cheapest, reference)}"] * (cheapest is not fastest)
        yield f"**{regime}:** {'; '.join(said)}."
    for row in records(own_first(found)):
        name = f"{row['title']} {row['regime']}"
        if row["solved"] < row["rows"]:
            yield f"**{name}** failed on {row['rows'] - row['solved']} of {row['rows']} instances."
        if row["method"] not in METHODS and row["solved"]:
            kept_on = f"it keeps every limit on {row['feasible']} of {row['rows']} instances"
            yield f"**{name}:** {_cost(row, reference)}; {kept_on}; largest violation: {row['largest']}."
    broken = [
        f"{row['title']} {row['regime']} by {row['largest']}"
        for row in records(found)
        if row["feasible"] < row["solved"] and row["method"] in METHODS and row["settings"] == "default"
    ]
    if broken:
        yield f"Limits are broken, on some instance, by up to: {', '.join(broken)}."


def _cost(row: dict[str, Any], reference: str) -> str:
    """A method, its gap and its time."""
    gap = "no gap" if np.isnan(row["gap_percent"]) else f"{row['gap_percent']:+.3g} % over {reference}"
    return f"{row['title']} ({gap}, {row['seconds']:.2g} s)"
