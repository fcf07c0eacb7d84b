"""Times alone on a machine, times under load, and performance profiles."""

from __future__ import annotations

import pandas as pd

from ded_bench.analysis.lines import groups, titled
from ded_bench.analysis.summary import TIME_SHIFT_S, table_times
from ded_bench.methods.options import DEFAULT
from ded_bench.report.columns import LOADED_TIMES, TIMING
from ded_bench.report.page import Block, Heading, PageTable, Text, folded, usual_first
from ded_bench.report.sources import Draft, Sources


def tables(sources: Sources) -> dict[str, PageTable]:
    """Those under load; the others stand in timing.csv."""
    caption = "Comparable by orders of magnitude only, s"
    return {"times_under_load": PageTable(table_times(sources.judged), LOADED_TIMES, caption)}


def blocks(draft: Draft) -> list[Block]:
    """Default settings in sight, all others and times under load folded away."""
    made: list[Block] = [Heading("Times")]
    if len(draft.sources.timing):
        timing = titled(pd.concat([rows for *_, rows in groups(draft.sources.timing)]))
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        made += usual_first(PageTable(timing, TIMING, caption), timing["settings"] == DEFAULT)
    else:
        made.append(Text("No method was timed alone yet; run `ded-bench bench`."))
    mean = Text(
        f"The shifted geometric mean is exp(mean(log(t + {TIME_SHIFT_S:g} s))) − {TIME_SHIFT_S:g} s: it "
        f"counts ratios of times, not seconds, and times far below {TIME_SHIFT_S:g} s as equal."
    )
    made += folded(
        "Times under parallel load, from the results table", draft.tables["times_under_load"], mean
    )
    return [*made, *draft.pictures["profile"]]
