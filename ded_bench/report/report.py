"""The report of a results folder: tables and figures → Markdown, one HTML page, LaTeX, CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from ded_bench.evaluate.ablation import (
    SAME,
    STARTED,
    ablation_table,
    main_rows,
    model_table,
    starts_table,
    training_table,
)
from ded_bench.evaluate.certificate import Certificate
from ded_bench.evaluate.summary import (
    TIME_SHIFT_S,
    claims,
    coverage,
    groups,
    scoring_rows,
    summary,
    table_times,
    title,
    worst,
)
from ded_bench.files.strict import write_atomically
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Case
from ded_bench.report.columns import (
    ABLATION,
    CERTIFICATE,
    CLAIMS,
    COVERAGE,
    GAPS,
    LOADED_TIMES,
    MODELS,
    PROVENANCE,
    RATES,
    STARTS,
    TABLE_V,
    TABLE_VI,
    TIMING,
    TRAINING,
    VIOLATIONS,
    WORST,
    Column,
    tabulate,
)
from ded_bench.report.figures.plan import first_settings
from ded_bench.report.gallery import Gallery, draw
from ded_bench.report.notes import EXPLANATION, data_notes, named
from ded_bench.report.page import (
    Block,
    Heading,
    Items,
    Table,
    Text,
    Warnings,
    render_html,
    render_markdown,
)
from ded_bench.report.paper import Line, paper_lines
from ded_bench.report.provenance import provenance, provenance_notes
from ded_bench.report.render import to_latex, to_markdown
from ded_bench.report.sections import SECTIONS
from ded_bench.report.sources import Sources, read_sources
from ded_bench.run.environment import environment, now
from ded_bench.run.pool import Workers


def write_report(case: Case, folder: Path, problems: Path, pool: Workers | None = None) -> list[Path]:
    """Write tables, figures and the report of a results folder into it.

    Whatever is missing (times, policies, a method, all rows) is said in the report.

    Args:
        folder: the results folder.
        problems: folder of the case's instances, split and manifest.
        pool: processes that draw the figures; this one does, if there are none.

    Returns:
        The files written.

    Raises:
        InputError: a table of the folder is there, but wrong.
    """
    sources = read_sources(case, folder, problems)
    lines = paper_lines(main_rows(sources.judged), sources.timing, sources.paper, sources.reference.run)
    frames = _frames(sources, lines)
    gallery = draw(sources, pool, [section.draw for section in SECTIONS])
    captions = _captions(sources)
    own = {name: table for section in SECTIONS for name, table in section.tables(gallery).items()}
    files = _write_tables(
        sources.results.folder / "tables",
        frames | {name: table.frame for name, table in own.items()},
        PRINTED | {name: table.columns for name, table in own.items()},
        captions,
    )
    notes = [
        *data_notes(sources, frames["summary"]),
        *provenance_notes(sources.judged, sources.timing),
        *sources.notes,
        *gallery.notes,
    ]
    blocks = [
        *_opening(sources, frames["summary"], notes),
        *_results(frames, captions, gallery),
        *_details(sources, frames, gallery),
        *_training(sources, frames, gallery),
        *(block for section in SECTIONS for block in section.blocks(gallery)),
        *_closing(sources.rows, frames["provenance"], gallery),
    ]
    write_atomically(folder / "report.md", render_markdown(blocks))
    write_atomically(folder / "report.html", render_html(blocks, folder))
    return [*files, *gallery.files, folder / "report.md", folder / "report.html"]


def _frames(sources: Sources, lines: Sequence[Line]) -> dict[str, pd.DataFrame]:
    """All tables by the name of their file."""
    frame, everything, folder = sources.judged, sources.rows, sources.results.folder
    overview, overall = summary(frame), summary(scoring_rows(everything))
    frames = {
        "table_v": tabulate(TABLE_V, lines),
        "table_vi": tabulate(TABLE_VI, lines),
        "summary": overview,
        "provenance": provenance(frame, sources.timing),
        "claims": claims(frame),
        "times_under_load": table_times(frame),
        "worst": worst(frame),
        "training": training_table(folder, [c.name for c in TRAINING[1:-1]]),
        "models": model_table(overview),
        "ablation": ablation_table(everything, folder),
        "starts": starts_table(scoring_rows(everything)),
    }
    return frames | {"coverage": coverage(overall, overview)}


def rows_caption(frame: pd.DataFrame, everything: pd.DataFrame) -> str:
    """Which rows the tables are about, in words."""
    if not len(frame):
        return "no rows yet"
    instances = frame["instance"].nunique()
    if (frame["split"] == "test").all():
        left = len(everything) - len(frame)
        return f"{instances} test instances" + (f"; {left} other rows left out" if left else "")
    return f"all {instances} instances, none of them of the test split"


def _write_tables(
    tables: Path,
    frames: dict[str, pd.DataFrame],
    printed: dict[str, Sequence[Column]],
    captions: dict[str, str],
) -> list[Path]:
    """CSV with every digit of all frames; Markdown of the same; LaTeX of the paper's two tables."""
    files = []
    for name, frame in frames.items():
        columns = printed.get(name) or [Column(c, c) for c in frame.columns]
        outputs = {f"{name}.csv": frame.to_csv(index=False), f"{name}.md": to_markdown(frame, columns)}
        if name in captions:
            caption = captions[name].split(": ", 1)[1].replace("`", "")
            outputs[f"{name}.tex"] = to_latex(frame, columns, caption, f"tab:{name}")
        for file, text in outputs.items():
            write_atomically(tables / file, text)
            files.append(tables / file)
    return files


PRINTED: dict[str, Sequence[Column]] = {
    "table_v": TABLE_V,
    "table_vi": TABLE_VI,
    "provenance": PROVENANCE,
    "claims": CLAIMS,
    "times_under_load": LOADED_TIMES,
    "worst": WORST,
    "training": TRAINING,
    "models": MODELS,
    "ablation": ABLATION,
    "starts": STARTS,
    "coverage": COVERAGE,
}


def _captions(sources: Sources) -> dict[str, str]:
    """What stands above the paper's two tables."""
    rows_from, timing = rows_caption(sources.judged, sources.rows), sources.timing
    if len(timing):
        counts = sorted(set(timing["instances"]))
        timed = f"times: median on {'/'.join(map(str, counts))} instances, alone on {timing['host'].iloc[-1]}"
    else:
        timed = "times: not taken yet, run `ded-bench bench`"
    return {
        "table_v": f"Table V: Average Solution Time and Change in Objective ({rows_from}; {timed})",
        "table_vi": f"Table VI: Average maximum constraint violation ({rows_from})",
    }


def _opening(sources: Sources, overview: pd.DataFrame, notes: Sequence[str]) -> list[Block]:
    case, everything = sources.case, sources.rows
    counts = everything["split"].value_counts().to_dict()
    parts = ", ".join(f"{count} on {_split_name(str(name))} instances" for name, count in counts.items())
    names = ", ".join(dict.fromkeys(overview["title"])) or "none yet"
    dates = [date for date in everything["date"] if date]
    items = [
        f"Case `{case.id}`: {len(case.buses)} buses, {len(case.generators)} generators besides the slack "
        f"bus, {len(case.loads)} loads.",
        f"Methods: {names}.",
        "Regimes: "
        + "; ".join(f"{r}, |ω| ≤ {limit.omega_hz:g} Hz" for r, limit in case.regimes.items())
        + ".",
        f"Rows: {len(everything)}" + (f" ({parts})." if parts else "."),
        f"Problem version: {', '.join(map(named, sorted(set(everything['problems_version'])))) or '–'}.",
        f"Rows made: {min(dates)} to {max(dates)}." if dates else "Rows made: –.",
    ]
    blocks: list[Block] = [
        Heading(f"Dynamics-aware economic dispatch on {case.id}", 1),
        Warnings(tuple(notes)),
        Heading("What was run"),
        Items(tuple(items)),
    ]
    return blocks


def _split_name(split: str) -> str:
    return {"train": "training", "none": "other"}.get(split, split)


def _results(frames: dict[str, pd.DataFrame], captions: dict[str, str], gallery: Gallery) -> list[Block]:
    return [
        Heading("The paper's result tables"),
        Table(frames["table_v"], TABLE_V, captions["table_v"]),
        Table(frames["table_vi"], TABLE_VI, captions["table_vi"]),
        Heading("How to read them", 3),
        Items(EXPLANATION),
        Heading("The paper's result figures"),
        *gallery.of("paper", "No trajectory can be drawn yet."),
    ]


def _details(sources: Sources, frames: dict[str, pd.DataFrame], gallery: Gallery) -> list[Block]:
    rows_from = rows_caption(sources.judged, sources.rows)
    blocks: list[Block] = [
        Heading("Each method in detail"),
        Table(frames["summary"], GAPS, f"Gap to {sources.reference.title}, % ({rows_from})"),
        Table(frames["summary"], RATES, "Claimed and verified: shares of all rows"),
        Table(frames["claims"], CLAIMS, "Solver status against the scorer's verdict, rows"),
        Table(frames["summary"], VIOLATIONS, "Largest violation of each schedule"),
    ]
    if len(frames["coverage"]):
        caption = "Methods that were run on training instances too: all their rows"
        blocks.append(Table(frames["coverage"], COVERAGE, caption))
    if len(frames["starts"]):
        caption = (
            f"{title(*STARTED)} from other starting points: the optimum that its solver claims against "
            f"that from the cold start (the same: within {SAME:g} of its objective)"
        )
        blocks.append(Table(frames["starts"], STARTS, caption))
    blocks += _times(sources.timing, frames)
    blocks += [
        Heading("Gap against time"),
        *gallery.of("tradeoff", "No gap yet: it needs rows of the reference and of another method."),
        *gallery.of("profile"),
        Heading("Worst instances"),
        Table(
            first_settings(frames["worst"]),
            WORST,
            "The three largest gaps and violations of each method, default settings (all: tables/worst.csv)",
        ),
        *gallery.of("worst"),
    ]
    return blocks


def _times(timing: pd.DataFrame, frames: dict[str, pd.DataFrame]) -> list[Block]:
    blocks: list[Block] = [Heading("Times")]
    if len(timing):
        ordered = pd.concat([rows for *_, rows in groups(timing)])
        named = ordered.assign(
            title=[title(m, s) for m, s in zip(ordered["method"], ordered["settings"], strict=True)]
        )
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        blocks.append(Table(named, TIMING, caption))
    else:
        blocks.append(Text("No method was timed alone yet; run `ded-bench bench`."))
    blocks += [
        Table(
            frames["times_under_load"],
            LOADED_TIMES,
            "Under parallel load, from the results table: comparable by orders of magnitude only, s",
        ),
        Text(
            f"The shifted geometric mean is exp(mean(log(t + {TIME_SHIFT_S:g} s))) − {TIME_SHIFT_S:g} s: it "
            f"counts ratios of times, not seconds, and times far below {TIME_SHIFT_S:g} s as equal."
        ),
    ]
    return blocks


def _training(sources: Sources, frames: dict[str, pd.DataFrame], gallery: Gallery) -> list[Block]:
    blocks: list[Block] = [Heading("Koopman models"), *_rollout_errors(sources.rollouts)]
    if len(frames["models"]):
        caption = "What the Koopman model contributes: the same method and settings on several models"
        blocks.append(Table(frames["models"], MODELS, caption))
    blocks += gallery.of("koopman")
    blocks.append(Heading("Training of the policies"))
    if len(frames["training"]):
        blocks.append(Table(frames["training"], TRAINING))
    else:
        blocks.append(Text("The folder holds no policy; `ded-bench train-dpc` trains one."))
    if len(frames["ablation"]):
        names = ", ".join(dict.fromkeys(title(method) for method in frames["ablation"]["method"]))
        caption = f"Ablation of {names}: short trainings, each with one thing changed; validation instances"
        blocks.append(Table(frames["ablation"], ABLATION, caption))
    blocks += gallery.of("training")
    blocks.append(Heading("Certificate"))
    blocks += _certificates(sources.certificates)
    return blocks


def _certificates(certificates: Sequence[Certificate]) -> list[Block]:
    if not certificates:
        return [Text("No certificate was made for these results; `ded-bench certify` makes one.")]
    rows = [c.model_dump() | {"title": title(c.method, c.settings)} for c in certificates]
    return [Items(tuple(c.sentence for c in certificates)), Table(pd.DataFrame(rows), CERTIFICATE)]


def _rollout_errors(rollouts: Mapping[str, pd.DataFrame]) -> list[Block]:
    """The tables of the Koopman models' errors."""
    blocks: list[Block] = []
    for name, errors in rollouts.items():
        columns = tuple(Column(str(name), str(name)) for name in errors.columns)
        where = (
            f"under the schedules of {title(name)}, test instances"
            if name in METHODS
            else f"on simulated trajectories held out from the identification of `{name}`"
        )
        caption = f"Errors of rollouts over the whole horizon {where}"
        blocks.append(Table(errors, columns, caption))
    return blocks


def _closing(everything: pd.DataFrame, made_by: pd.DataFrame, gallery: Gallery) -> list[Block]:
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
        Table(made_by, PROVENANCE, "Hashes of the sources, models and policies that answers depend on"),
        Heading("Environment"),
        Items((*items, f"This report was written {now()} with: {here}.")),
    ]
