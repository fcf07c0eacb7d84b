"""The report below its first screen: methods, times, worst instances, models, trainings, problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from ded_bench.analysis.certificate import Certificate
from ded_bench.analysis.reference import DEFAULT
from ded_bench.analysis.rollouts import ROLLOUTS
from ded_bench.analysis.summary import SMALLEST_GAP, TIME_SHIFT_S, groups, title
from ded_bench.evaluate.ablation import SAME, STARTED
from ded_bench.evaluate.lifted_bound import ANY, EXCHANGED
from ded_bench.report.columns import (
    ABLATION,
    CERTIFICATE,
    CLAIMS,
    COVERAGE,
    FRONT_CERTIFICATE,
    FRONT_TIMING,
    GAPS,
    LOADED_TIMES,
    MODELS,
    PROVENANCE,
    RATES,
    STARTS,
    TIMING,
    TRAINING,
    VIOLATIONS,
    WORST,
    Column,
)
from ded_bench.report.figures.plan import first_settings
from ded_bench.report.gallery import Gallery
from ded_bench.report.page import Block, Heading, Items, Table, Text, folded
from ded_bench.report.sources import Sources
from ded_bench.run.environment import environment, now


def rows_caption(frame: pd.DataFrame, everything: pd.DataFrame) -> str:
    """Which rows the tables are about, in words."""
    if not len(frame):
        return "no rows yet"
    instances = frame["instance"].nunique()
    if (frame["split"] == "test").all():
        left = len(everything) - len(frame)
        return f"{instances} test instances" + (f"; {left} other rows left out" if left else "")
    return f"all {instances} instances, none of them of the test split"


def method_blocks(sources: Sources, frames: dict[str, pd.DataFrame], gallery: Gallery) -> list[Block]:
    """Gaps, rates, violations, times and worst instances of each method."""
    rows_from = rows_caption(sources.judged, sources.rows)
    overview = frames["summary"]
    blocks: list[Block] = [
        Heading("Each method in detail"),
        *_usual(overview, GAPS, f"Gap to {sources.reference.title}, % ({rows_from})"),
        *_usual(overview, RATES, "Claimed and verified: shares of all rows"),
        *folded("Solver status against the scorer's verdict", Table(frames["claims"], CLAIMS, "Rows")),
        *_usual(overview, VIOLATIONS, "Largest violation of each schedule"),
    ]
    if len(frames["coverage"]):
        caption = "Methods that were run on training instances too: all their rows"
        blocks += folded(caption, Table(frames["coverage"], COVERAGE))
    if len(frames["starts"]):
        caption = (
            f"{title(*STARTED)} from other starting points: the optimum that its solver claims against "
            f"that from the cold start (the same: within {SAME:g} of its objective)"
        )
        blocks += folded(
            f"{title(*STARTED)} from other starting points", Table(frames["starts"], STARTS, caption)
        )
    blocks += _times(sources.timing, frames, gallery)
    blocks += _worst(frames["worst"], gallery)
    return blocks


def _usual(
    frame: pd.DataFrame, columns: tuple[Column, ...], caption: str, front: tuple[Column, ...] = ()
) -> list[Block]:
    """A table of the default settings, and of some columns; that of all is folded away."""
    usual = frame[frame["settings"] == DEFAULT]
    shown = usual if len(usual) else frame
    table = Table(shown, front or columns, caption)
    if len(shown) == len(frame) and not front:
        return [table]
    summary = "With all settings and columns" if front else "With all settings"
    return [table, *folded(summary, Table(frame, columns, caption))]


def _worst(worst: pd.DataFrame, gallery: Gallery) -> list[Block]:
    """Rows and figures of the worst instances, folded away."""
    usual = first_settings(worst)
    heading = Heading("Worst instances")
    if not len(usual):
        return [heading, Text("No method exceeds a tolerance, or costs more than the reference.")]
    broken = usual[usual["worst_by"] == "violation"]
    names = ", ".join(dict.fromkeys(f"{row.title} {row.regime}" for row in broken.itertuples()))
    said = f"Limits are broken, beyond the tolerance, by {names}." if names else "No limit is broken."
    caption = (
        "The three largest gaps and violations of each method, default settings (all: tables/worst.csv); "
        f"gaps up to {SMALLEST_GAP:g} % and violations within tolerance are left out"
    )
    table = Table(usual, WORST, caption)
    return [heading, Text(said), *folded("Which instances, and their figures", table, *gallery.of("worst"))]


def _times(timing: pd.DataFrame, frames: dict[str, pd.DataFrame], gallery: Gallery) -> list[Block]:
    blocks: list[Block] = [Heading("Times")]
    if len(timing):
        ordered = pd.concat([rows for *_, rows in groups(timing)])
        named = ordered.assign(
            title=[title(m, s) for m, s in zip(ordered["method"], ordered["settings"], strict=True)]
        )
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        blocks += _usual(named, TIMING, caption, FRONT_TIMING)
    else:
        blocks.append(Text("No method was timed alone yet; run `ded-bench bench`."))
    loaded = Table(frames["times_under_load"], LOADED_TIMES, "Comparable by orders of magnitude only, s")
    mean = Text(
        f"The shifted geometric mean is exp(mean(log(t + {TIME_SHIFT_S:g} s))) − {TIME_SHIFT_S:g} s: it "
        f"counts ratios of times, not seconds, and times far below {TIME_SHIFT_S:g} s as equal."
    )
    blocks += folded("Times under parallel load, from the results table", loaded, mean)
    return [*blocks, *gallery.of("profile")]


def training_blocks(sources: Sources, frames: dict[str, pd.DataFrame], gallery: Gallery) -> list[Block]:
    """Koopman models, policies and their trainings, certificates."""
    blocks: list[Block] = [Heading("Koopman models"), *_rollout_errors(sources.rollouts)]
    if len(frames["models"]):
        caption = "What the Koopman model contributes: the same method and settings on several models"
        blocks.append(Table(frames["models"], MODELS, caption))
    blocks += gallery.of("koopman")
    blocks.append(Heading("Training of the policies"))
    if len(frames["training"]):
        filled = frames["training"].map(lambda value: value not in ("", None)).any()
        blocks.append(Table(frames["training"], tuple(c for c in TRAINING if filled[c.name])))
    else:
        blocks.append(Text("The folder holds no policy; `ded-bench train-dpc` trains one."))
    if len(frames["ablation"]):
        names = ", ".join(dict.fromkeys(title(method) for method in frames["ablation"]["method"]))
        caption = f"Ablation of {names}: short trainings, each with one thing changed; validation instances"
        blocks += folded(caption, Table(frames["ablation"], ABLATION))
    blocks += gallery.of("training")
    blocks += folded("Trainings with other settings", *gallery.of("training_settings"))
    blocks.append(Heading("Certificate"))
    blocks += _certificates(sources.certificates)
    return blocks


def _certificates(certificates: Sequence[Certificate]) -> list[Block]:
    if not certificates:
        return [Text("No certificate was made for these results; `ded-bench certify` makes one.")]
    rows = [c.model_dump() | {"title": title(c.method, c.settings)} for c in certificates]
    frame = pd.DataFrame(rows)
    whole = Table(frame, CERTIFICATE)
    return [Table(frame, FRONT_CERTIFICATE), *folded("With tolerances, seed, models and machine", whole)]


#: What a table of rollout errors is about, by its name; the others have a model's.
ERRORS_WHERE = {
    ROLLOUTS: "under drawn schedules, the static dispatch and optimal schedules of test instances",
    EXCHANGED: f"where two instances exchange their input increments; `{ANY}` is a lower bound",
}


def _rollout_errors(rollouts: Mapping[str, pd.DataFrame]) -> list[Block]:
    """The tables of the surrogates' errors."""
    blocks: list[Block] = []
    for name, errors in rollouts.items():
        columns = tuple(Column(str(name), str(name)) for name in errors.columns)
        where = ERRORS_WHERE.get(
            name, f"on simulated trajectories held out from the identification of `{name}`"
        )
        caption = f"Errors of rollouts over the whole horizon {where}"
        blocks += folded(caption, Table(errors, columns))
    return blocks


def closing_blocks(everything: pd.DataFrame, made_by: pd.DataFrame, gallery: Gallery) -> list[Block]:
    """The problems, and what made the rows."""

    def listed(name: str) -> str:
        return "; ".join(sorted({str(value) for value in everything[name] if value})) or "–"

    masters = sorted({seed.split(" ")[0] for seed in everything["seed"] if seed})
    items = [
        f"Hosts of the rows: {listed('host')}.",
        f"Versions of ded-bench: {listed('version')}; solvers: {listed('solver_version')}.",
        f"Parallel workers: {listed('workers')}; one thread each.",
        f"Master seeds of the instances: {', '.join(masters) or '–'}.",
    ]
    here = "; ".join(f"{name} {value}" for name, value in environment().items())
    return [
        Heading("The problems"),
        *gallery.of("problem", "The instances' files are not at hand."),
        Heading("What made the rows"),
        *folded(
            "Hashes of the sources, models and policies that answers depend on", Table(made_by, PROVENANCE)
        ),
        Heading("Environment"),
        Items((*items, f"This report was written {now()} with: {here}.")),
    ]
