"""The closed loop: tables and figures of online.csv."""

from __future__ import annotations

from collections.abc import Mapping

from ded_bench.analysis.lines import titled
from ded_bench.analysis.online_summary import own_latency
from ded_bench.report.columns import ONLINE
from ded_bench.report.page import Block, Heading, Items, PageTable, Picture, folded
from ded_bench.report.sources import Sources

EXPLANATION = (
    "Every scenario is operated for its whole length: every period, or when the last plan is due if that is "
    "later, a method gets the measured state and a forecast, and its plan takes effect after its latency, "
    "the median time of `timing.csv`. Cost is that of the true trajectory over the optimum of the "
    "whole scenario with true loads (hindsight), which keeps the bound: who exceeds it may cost less.",
    "Largest excess: of any generator at any time over the bound, the mean over scenarios. Time outside: "
    "share of grid points with some generator more than 1e-6 Hz beyond the bound. Slack travel: Σ|ΔP_s|.",
    "Moved by unforeseen loads: how far loads that no plan in force knew of move the frequency of some "
    "generator, the largest of a scenario. A plan can have room for twice the bound at most.",
    "Late: no answer within the limit of the clock. Failed: an answer without a schedule; the last plan goes "
    "on. Infeasible: by the method's own word no schedule meets every limit, and the one of least excess is "
    "followed.",
)


def closed_loop(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """Nothing without rows."""
    own = titled(own_latency(sources.online))
    if not len(own):
        return []
    caption = "Methods in the closed loop at their own latency, forecasts as announced"
    explained = folded("How to read the closed loop", Items(EXPLANATION))
    table = PageTable(own, ONLINE, caption, "online_methods")
    return [Heading("The closed loop"), table, *explained, *pictures["online"]]
