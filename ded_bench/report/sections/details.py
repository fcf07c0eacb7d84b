"""What stands below the first screen: methods in detail, times, trainings, the closed loop, provenance."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from ded_bench.analysis.online_summary import own_latency
from ded_bench.analysis.summary import groups, titled
from ded_bench.methods.options import DEFAULT
from ded_bench.report.columns import (
    CERTIFICATE,
    DETAIL,
    ONLINE,
    OTHER_RATES,
    TIMING,
    TRAINING,
)
from ded_bench.report.page import Block, PageTable, Picture, bullets, folded, usual_first
from ded_bench.report.sections.opening import idealisation, rows_caption
from ded_bench.report.sources import Sources, trainings
from ded_bench.run.environment import environment, now

CLOSED_LOOP = (
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
OTHERS = (
    "Validated on full machine models with exciters, stabilisers and governors, losses and loads of constant "
    "power; confirmed by ANDES on the same: shares of those schedules that these can carry to the "
    "end, of all that were kept"
)


def each_method(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away."""
    overview, usual = sources.summary, sources.summary["settings"] == DEFAULT
    others = OTHER_RATES if overview[["validated_asked", "confirmed_asked"]].to_numpy().any() else ()
    caption = (
        f"Gap to {sources.reference.title}, % ({rows_caption(sources)}); claimed, and verified on "
        f"{idealisation(sources.case)}: shares of all rows" + f". {OTHERS}" * bool(others)
    )
    table = PageTable(overview, (*DETAIL, *others), caption, "summary")
    return ["## Each method in detail", *usual_first(table, usual)]


def solve_times(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away."""
    made: list[Block] = ["No method was timed alone yet; run `ded-bench bench`."]
    if len(sources.timing):
        timing = titled(pd.concat([rows for *_, rows in groups(sources.timing)]))
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        made = usual_first(PageTable(timing, TIMING, caption), timing["settings"] == DEFAULT)
    return ["## Times", *made]


def trained(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """How policies and models were trained, and certificates."""
    paths = sources.results.paths
    frame = trainings((*paths.policies, *paths.models))
    made: list[Block] = ["## Training"]
    if len(frame):
        filled = frame.map(lambda value: value not in ("", None)).any()
        columns = tuple(column for column in TRAINING if filled[column.name])
        made.append(PageTable(frame, columns, "", "training"))
    else:
        made.append("The folder holds no policy or model; `ded-bench train-dpc` and `train-ko` make some.")
    made.append("## Certificate")
    if not sources.certificates:
        return [*made, "No certificate was made for these results; `ded-bench certify` makes one."]
    certificates = titled(pd.DataFrame([{"model": ""} | c.model_dump() for c in sources.certificates]))
    return [*made, PageTable(certificates, CERTIFICATE, "All that makes them up stands in certificate.json")]


def closed_loop(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """Nothing without rows."""
    own = titled(own_latency(sources.online))
    if not len(own):
        return []
    caption = "Methods in the closed loop at their own latency, forecasts as announced"
    explained = folded("How to read the closed loop", bullets(CLOSED_LOOP))
    table = PageTable(own, ONLINE, caption, "online_methods")
    pictured = pictures["online"] if sources.case.slack else ()  # of an island it stands beside practice
    return ["## The closed loop", table, *explained, *pictured]


def made_by(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Machines, versions, models and policies."""
    rows = sources.rows

    def distinct(name: str) -> str:
        return "; ".join(sorted({str(value) for value in rows[name] if value})) or "–"

    masters = sorted({seed.split(" ")[0] for seed in rows["seed"] if seed})
    counts = rows["split"].replace({"train": "training", "none": "other"}).value_counts()
    dates = sorted(date for date in rows["date"] if date) or ["–"]
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    items = (
        f"Rows: {', '.join(f'{count} on {name} instances' for name, count in counts.items()) or 'none'}.",
        f"Rows made: {dates[0]} to {dates[-1]}; problem version: {distinct('problems_version')}.",
        f"Hosts of the rows: {distinct('host')}; parallel workers: {distinct('workers')}, one thread each.",
        f"Versions of ded-bench: {distinct('version')}; commits: {distinct('commit')}; "
        f"solvers: {distinct('solver_version')}.",
        f"Surrogates and policies: {distinct('made_with')}.",
        f"Master seeds of the instances: {', '.join(masters) or '–'}.",
        f"This report was written {now()} with: {here}.",
    )
    return ["## What made the rows", bullets(items)]
