"""The report of a results folder: tables and figures → Markdown, one HTML page, LaTeX, CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ded_bench.evaluate.ablation import (
    ROLLOUTS,
    SAME,
    ablation_table,
    main_rows,
    model_table,
    starts_table,
    training_table,
)
from ded_bench.evaluate.certificate import read_certificates
from ded_bench.evaluate.summary import (
    TIME_SHIFT_S,
    claims,
    coverage,
    groups,
    judged_rows,
    scoring_rows,
    summary,
    table_times,
    title,
    validation_rows,
    worst,
)
from ded_bench.evaluate.timing import read_timing, timing_summary
from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.problem.case import Case
from ded_bench.report.columns import (
    ABLATION,
    CERTIFICATE,
    CLAIMS,
    COVERAGE,
    GAPS,
    LOADED_TIMES,
    MODELS,
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
from ded_bench.report.paper import Line, paper_lines, read_paper
from ded_bench.report.render import to_latex, to_markdown
from ded_bench.run.environment import environment, now
from ded_bench.run.pool import Workers
from ded_bench.run.results import Results


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
        InputError: results.csv or timing.csv is wrong.
    """
    results = Results(folder)
    everything = results.frame()
    everything = everything[everything["case"].isin([case.id, ""])].reset_index(drop=True)
    frame = judged_rows(everything)
    timings = timing_summary(read_timing(folder / "timing.csv"))
    timing = timings[timings["case"] == case.id]
    paper = read_paper(problems, case)
    ours = paper if paper and paper.case_fingerprint == case.fingerprint else None
    lines = paper_lines(main_rows(frame), timing, ours)
    frames = _frames(folder, frame, everything, lines)
    gallery = draw(case, results, frame, timing, problems, pool)
    rows_from = rows_caption(frame, everything)
    files = _write_tables(folder, frames, rows_from, timing)
    notes = data_notes(frame, everything, frames["summary"], timings, timing, case, problems)
    if paper and not ours:
        notes.append("The paper's numbers are about another version of the case and left out.")
    blocks = [
        *_opening(case, everything, frames["summary"], [*notes, *gallery.notes]),
        *_results(frames, rows_from, timing, gallery),
        *_details(frames, rows_from, timing, gallery),
        *_training(frames, folder, gallery),
        *_closing(everything, gallery),
    ]
    write_atomically(folder / "report.md", render_markdown(blocks))
    write_atomically(folder / "report.html", render_html(blocks, folder))
    return [*files, *gallery.files, folder / "report.md", folder / "report.html"]


def _frames(
    folder: Path, frame: pd.DataFrame, everything: pd.DataFrame, lines: Sequence[Line]
) -> dict[str, pd.DataFrame]:
    """All tables by the name of their file."""
    overview, overall = summary(frame), summary(scoring_rows(everything))
    frames = {
        "table_v": tabulate(TABLE_V, lines),
        "table_vi": tabulate(TABLE_VI, lines),
        "summary": overview,
        "claims": claims(frame),
        "times_under_load": table_times(frame),
        "worst": worst(frame),
        "training": training_table(folder, [c.name for c in TRAINING[1:-1]]),
        "models": model_table(overview),
        "ablation": ablation_table(summary(validation_rows(everything)), folder),
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
    folder: Path, frames: dict[str, pd.DataFrame], rows_from: str, timing: pd.DataFrame
) -> list[Path]:
    """CSV with every digit of all frames; Markdown of the same; LaTeX of the paper's two tables."""
    tables = folder / "tables"
    files = []
    for name, frame in frames.items():
        columns = PRINTED.get(name) or [Column(c, c) for c in frame.columns]
        outputs = {f"{name}.csv": frame.to_csv(index=False), f"{name}.md": to_markdown(frame, columns)}
        if name in ("table_v", "table_vi"):
            caption = _captions(rows_from, timing)[name].split(": ", 1)[1].replace("`", "")
            outputs[f"{name}.tex"] = to_latex(frame, columns, caption, f"tab:{name}")
        for file, text in outputs.items():
            write_atomically(tables / file, text)
            files.append(tables / file)
    return files


PRINTED: dict[str, Sequence[Column]] = {
    "table_v": TABLE_V,
    "table_vi": TABLE_VI,
    "claims": CLAIMS,
    "times_under_load": LOADED_TIMES,
    "worst": WORST,
    "training": TRAINING,
    "models": MODELS,
    "ablation": ABLATION,
    "starts": STARTS,
    "coverage": COVERAGE,
}


def _captions(rows_from: str, timing: pd.DataFrame) -> dict[str, str]:
    if len(timing):
        counts = sorted(set(timing["instances"]))
        timed = f"times: median on {'/'.join(map(str, counts))} instances, alone on {timing['host'].iloc[-1]}"
    else:
        timed = "times: not taken yet, run `ded-bench bench`"
    return {
        "table_v": f"Table V: Average Solution Time and Change in Objective ({rows_from}; {timed})",
        "table_vi": f"Table VI: Average maximum constraint violation ({rows_from})",
    }


def _opening(
    case: Case, everything: pd.DataFrame, overview: pd.DataFrame, notes: Sequence[str]
) -> list[Block]:
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


def _results(
    frames: dict[str, pd.DataFrame], rows_from: str, timing: pd.DataFrame, gallery: Gallery
) -> list[Block]:
    captions = _captions(rows_from, timing)
    return [
        Heading("The paper's result tables"),
        Table(frames["table_v"], TABLE_V, captions["table_v"]),
        Table(frames["table_vi"], TABLE_VI, captions["table_vi"]),
        Heading("How to read them", 3),
        Items(EXPLANATION),
        Heading("The paper's result figures"),
        *gallery.of("paper", "No trajectory can be drawn yet."),
    ]


def _details(
    frames: dict[str, pd.DataFrame], rows_from: str, timing: pd.DataFrame, gallery: Gallery
) -> list[Block]:
    blocks: list[Block] = [
        Heading("Each method in detail"),
        Table(frames["summary"], GAPS, f"Gap to DED, % ({rows_from})"),
        Table(frames["summary"], RATES, "Claimed and verified: shares of all rows"),
        Table(frames["claims"], CLAIMS, "Solver status against the scorer's verdict, rows"),
        Table(frames["summary"], VIOLATIONS, "Largest violation of each schedule"),
    ]
    if len(frames["coverage"]):
        caption = "Methods that were run on training instances too: all their rows"
        blocks.append(Table(frames["coverage"], COVERAGE, caption))
    if len(frames["starts"]):
        caption = (
            "Full DED from other starting points: the optimum that IPOPT claims against that from the cold "
            f"start (the same: within {SAME:g} of its objective)"
        )
        blocks.append(Table(frames["starts"], STARTS, caption))
    blocks += [Heading("Times")]
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
        Heading("Gap against time"),
        *gallery.of("tradeoff", "No gap yet: it needs rows of DED and of another method."),
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


def _training(frames: dict[str, pd.DataFrame], folder: Path, gallery: Gallery) -> list[Block]:
    blocks: list[Block] = [Heading("Koopman models"), *_rollout_errors(folder)]
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
        caption = "Ablation of `ded-dpc`: short trainings, each with one thing changed"
        blocks.append(Table(frames["ablation"], ABLATION, caption))
    blocks += gallery.of("training")
    blocks.append(Heading("Certificate"))
    blocks += _certificates(folder)
    return blocks


def _certificates(folder: Path) -> list[Block]:
    try:
        certificates = read_certificates(folder)
    except InputError as error:
        return [Warnings((f"The certificate cannot be read: {error}",))]
    if not certificates:
        return [Text("No certificate was made for these results; `ded-bench certify` makes one.")]
    rows = [c.model_dump() | {"title": title(c.method, c.settings)} for c in certificates]
    return [Items(tuple(c.sentence for c in certificates)), Table(pd.DataFrame(rows), CERTIFICATE)]


def _rollout_errors(folder: Path) -> list[Block]:
    """Tables that `train-ko` leaves beside the models; one that cannot be read is no table."""
    blocks: list[Block] = []
    for path in sorted((folder / "koopman").glob("*.errors.csv")):
        try:
            errors = pd.read_csv(path)
        except (OSError, ValueError):
            continue
        columns = tuple(Column(str(name), str(name)) for name in errors.columns)
        where = (
            "under the schedules of full DED, test instances"
            if path.name == ROLLOUTS
            else f"on simulated trajectories held out from the identification of `{path.name.split('.')[0]}`"
        )
        caption = f"Errors of rollouts over the whole horizon {where}"
        blocks.append(Table(errors, columns, caption))
    return blocks


def _closing(everything: pd.DataFrame, gallery: Gallery) -> list[Block]:
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
        Heading("Environment"),
        Items((*items, f"This report was written {now()} with: {here}.")),
    ]
