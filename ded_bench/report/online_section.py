"""The report's part on the closed loop: tables and figures of online.csv."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from ded_bench.analysis.online_summary import (
    KINDS,
    RUN,
    STATIC,
    crossed,
    online_rows,
    operated,
    own_latency,
    sweeps,
)
from ded_bench.analysis.summary import title
from ded_bench.problem.benchmark import problem_folder
from ded_bench.problem.case import Case
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.benchmark import scenario_folder
from ded_bench.report.columns import Column
from ded_bench.report.figures.online import (
    KIND_NAMES,
    Operated,
    counted,
    forecast_figure,
    latency_figure,
    scenario_figure,
)
from ded_bench.report.gallery import Gallery
from ded_bench.report.page import Block, Heading, Items, Table, folded
from ded_bench.results.online_results import OnlineKey, OnlineResults, read_trajectory
from ded_bench.run.pool import Call

#: So many methods are drawn on one scenario: static dispatch of every second, then those of least excess.
SHOWN = 3

_HEAD = (Column("regime", "Regime"), Column("title", "Method"))
OWN = (
    *_HEAD,
    Column("period_s", "every", "s", "g"),
    Column("latency_s", "latency", "s", ".2g"),
    Column("n", "n"),
    Column("failures", "failures"),
    Column("increase_percent_mean", "cost over hindsight", "%", ".4f"),
    Column("increase_percent_max", "largest", "%", ".4f"),
    Column("over_known_percent_mean", "over perfect forecast and no latency", "%", ".4f"),
    Column("over_static_percent_mean", "over ED every second", "%", ".4f"),
    Column("max_excess_mhz_mean", "largest excess, mean", "mHz", ".4f"),
    Column("max_excess_mhz_max", "largest", "mHz", ".4f"),
    Column("static_excess_mhz_mean", "ED every second there, mean", "mHz", ".4f"),
    Column("unforeseen_mhz_mean", "moved by unforeseen loads, mean", "mHz", ".4f"),
    Column("share_outside", "time outside", form=".2%"),
    Column("slack_travel_pu", "slack travel", "pu", ".2f"),
    Column("late", "plans late", form=".1%"),
    Column("failed", "failed", form=".1%"),
    Column("infeasible", "infeasible", form=".1%"),
)
_NAMED = {column.name: column for column in OWN} | {
    "forecast": Column("forecast", "forecast"),
    "mean_excess_mhz": Column("mean_excess_mhz", "mean excess", "mHz", ".4f"),
}
#: Columns of the loop on the AC network, where every way of operating has a line.
ON_AC = tuple(
    _NAMED[name]
    for name in (
        *("regime", "title", "period_s", "latency_s", "forecast", "n", "failures", "increase_percent_mean"),
        *("max_excess_mhz_mean", "max_excess_mhz_max", "mean_excess_mhz", "unforeseen_mhz_mean"),
        *("share_outside", "late", "failed", "infeasible"),
    )
)
CROSSED = (
    *_HEAD,
    Column("latency_s", "latency", "s", ".3g"),
    Column("n", "n"),
    *(Column(f"increase_percent_mean_{kind}", f"cost: {KIND_NAMES[kind]}", "%", ".4f") for kind in KINDS),
    *(Column(f"max_excess_mhz_mean_{kind}", f"excess: {KIND_NAMES[kind]}", "mHz", ".4f") for kind in KINDS),
)
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


def draw_online(gallery: Gallery) -> Iterator[Call]:
    """Figures: latency, one scenario under several methods, its forecasts."""
    case, folder = gallery.sources.case, gallery.sources.results.folder
    results = OnlineResults(folder)
    frame = online_rows(results, case.id)
    swept, own = sweeps(frame), own_latency(frame)
    for (method, settings), lines in swept.groupby(RUN[1:], sort=False):
        name = title(str(method), str(settings))
        caption = (
            f"{name} in the closed loop against its latency, by what its plans know; the mean over "
            f"{counted(lines)} scenarios. Markers: methods at their own latency, over all scenarios that "
            "they operated. Axes are linear near zero."
        )
        drawn = (latency_figure, lines, own, f"{case.id}: {name}")
        yield gallery.add("online", f"online_latency_{method}_{settings}", caption, *drawn)
    yield from _draw_scenarios(gallery, results, frame)


def own_lines(folder: Path, case: Case) -> pd.DataFrame:
    """The lines of the table OWN: methods at their own latency; none without rows."""
    return _titled(own_latency(online_rows(OnlineResults(folder), case.id)))


def online_tables(gallery: Gallery) -> dict[str, Table]:
    """The tables that have rows, by the name of their file."""
    case, folder = gallery.sources.case, gallery.sources.results.folder
    own, table = own_lines(folder, case), crossed(sweeps(online_rows(OnlineResults(folder), case.id)))
    tables = {}
    if len(own):
        caption = "Methods in the closed loop at their own latency, forecasts as announced"
        tables["online_methods"] = Table(own, OWN, caption)
    if len(table):
        known = tuple(c for c in CROSSED if c.name in table or c.name == "title")
        caption = "What latency costs, by what is known: means over the same scenarios"
        tables["online_latency"] = Table(_titled(table), known, caption)
    on_ac = operated(online_rows(OnlineResults(folder), case.id, "ac"))
    if len(on_ac):
        caption = "The closed loop on the full AC network, hindsight there too"
        tables["online_ac"] = Table(_titled(on_ac), ON_AC, caption)
    return tables


def online_blocks(gallery: Gallery) -> list[Block]:
    """Heading, tables and figures; nothing without rows."""
    tables = online_tables(gallery)
    if not tables:
        return []
    explained = folded("How to read the closed loop", Items(EXPLANATION))
    return [Heading("The closed loop"), *tables.values(), *explained, *gallery.of("online")]


def _titled(lines: pd.DataFrame) -> pd.DataFrame:
    names = [title(m, s) for m, s in zip(lines["method"], lines["settings"], strict=True)]
    return lines.assign(title=names)


def _draw_scenarios(gallery: Gallery, results: OnlineResults, frame: pd.DataFrame) -> Iterator[Call]:
    """In the tightest regime, of the scenarios with most methods, that whose worst excess is the median."""
    case = gallery.sources.case
    regime = min(case.regimes, key=lambda name: case.regimes[name].omega_hz)
    rows = frame[
        (frame["latency_source"] == "timing") & (frame["regime"] == regime) & (frame["period_s"] == 1)
    ]
    kept = [results.files.trajectory(OnlineKey(*key)).is_file() for key in _keys(rows)]
    rows = rows[kept]
    if not len(rows):
        return
    methods = rows.groupby("scenario")["method"].transform("nunique")
    rows = rows[methods == methods.max()]
    worst = rows.groupby("scenario")["max_excess_hz"].max().sort_values(kind="stable")
    scenario = str(worst.index[len(worst) // 2])
    one = rows[rows["scenario"] == scenario].sort_values("latency_s", kind="stable")
    chosen = _chosen(one)
    shown = [_operated(results, key) for key in _keys(chosen)]
    look = results.files.hindsight_trajectory(scenario, regime)
    if look.is_file():  # first, below the others
        shown.insert(0, Operated("", "", "hindsight", read_trajectory(look)))
    names = ", ".join(one.label for one in shown)
    caption = f"Scenario {scenario}, {regime}: loads, powers, frequencies and slack power under {names}."
    yield gallery.add(
        "online", "online_scenario", caption, scenario_figure, case, regime, f"{scenario}, {regime}", shown
    )
    yield from _draw_forecasts(gallery, case, scenario)


def _draw_forecasts(gallery: Gallery, case: Case, name: str) -> Iterator[Call]:
    path = scenario_folder(problem_folder(case.id, case)) / f"{name}.json"
    if path.is_file():
        scenario = Scenario.load_file(path, case)
        caption = f"Loads of {name} as they came, and as forecasts of three moments saw them, as announced."
        yield gallery.add("online", "online_forecast", caption, forecast_figure, case, scenario, name)


def _keys(rows: pd.DataFrame) -> list[OnlineKey]:
    return [OnlineKey(*key) for key in rows[list(OnlineKey._fields)].itertuples(index=False)]


def _chosen(rows: pd.DataFrame) -> pd.DataFrame:
    """Static dispatch, and of the other methods those of least excess, each with its best settings."""
    static = (rows["method"] == STATIC[0]) & (rows["settings"] == STATIC[1])
    others = rows[~static].sort_values("max_excess_hz", kind="stable").drop_duplicates("method")
    return pd.concat([rows[static], others])[:SHOWN]


def _operated(results: OnlineResults, key: OnlineKey) -> Operated:
    label = f"{title(key.method, key.settings)}, {key.latency_s:.2g} s"
    return Operated(key.method, key.settings, label, read_trajectory(results.files.trajectory(key)))
