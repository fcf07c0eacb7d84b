"""The report of a results folder: tables and figures → Markdown, one HTML page, LaTeX, CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from ded_bench.analysis.summary import claims, coverage, scoring_rows, summary, table_times, worst
from ded_bench.evaluate.ablation import ablation_table, main_rows, model_table, starts_table, training_table
from ded_bench.files.strict import write_atomically
from ded_bench.problem.case import Case
from ded_bench.report.columns import (
    ABLATION,
    CLAIMS,
    COVERAGE,
    LOADED_TIMES,
    MODELS,
    PROVENANCE,
    STARTS,
    TABLE_V,
    TABLE_VI,
    TRAINING,
    WORST,
    Column,
    tabulate,
)
from ded_bench.report.details import closing_blocks, method_blocks, rows_caption, training_blocks
from ded_bench.report.gallery import draw
from ded_bench.report.notes import alarms, data_notes
from ded_bench.report.opening import opening_blocks, result_blocks, result_columns
from ded_bench.report.page import render_html, render_markdown
from ded_bench.report.paper import Line, paper_lines
from ded_bench.report.provenance import provenance, provenance_notes
from ded_bench.report.render import to_latex, to_markdown
from ded_bench.report.sections import SECTIONS
from ded_bench.report.sources import Sources, read_sources
from ded_bench.run.pool import Workers


def write_report(case: Case, folder: Path, problems: Path, pool: Workers | None = None) -> list[Path]:
    """Write tables, figures and the report of a results folder into it.

    Whatever is missing (times, policies, a method) is said in the report.

    Args:
        folder: the results folder.
        problems: folder of the case's instances, split and manifest.
        pool: processes that draw the figures; this one does, if there are none.

    Returns:
        The files written.

    Raises:
        InputError: the folder holds no results of this case, or a table in it is wrong.
    """
    sources = read_sources(case, folder, problems)
    run = sources.reference.run
    # beside the paper's numbers our model stands alone; elsewhere its rivals are what the tables are about
    rows = main_rows(sources.judged) if sources.paper else sources.judged
    lines = paper_lines(rows, sources.timing, sources.paper, run)
    five, six = result_columns(sources, TABLE_V, TABLE_VI)
    printed = PRINTED | {"table_v": five, "table_vi": six}
    frames = _frames(sources, lines, printed)
    gallery = draw(sources, pool, [section.draw for section in SECTIONS])
    captions = _captions(sources)
    own = {name: table for section in SECTIONS for name, table in section.tables(gallery).items()}
    files = _write_tables(
        sources.results.folder / "tables",
        frames | {name: table.frame for name, table in own.items()},
        printed | {name: table.columns for name, table in own.items()},
        captions,
    )
    notes = [
        *data_notes(sources, frames["summary"]),
        *provenance_notes(sources.judged, sources.timing),
        *sources.notes,
        *gallery.notes,
    ]
    blocks = [
        *opening_blocks(sources, lines, gallery, notes, alarms(sources)),
        *result_blocks(sources, frames, printed, captions, gallery),
        *method_blocks(sources, frames, gallery),
        *training_blocks(sources, frames, gallery),
        *(block for section in SECTIONS for block in section.blocks(gallery)),
        *closing_blocks(sources.rows, frames["provenance"], gallery),
    ]
    write_atomically(folder / "report.md", render_markdown(blocks))
    write_atomically(folder / "report.html", render_html(blocks, folder))
    return [*files, *gallery.files, folder / "report.md", folder / "report.html"]


def _frames(
    sources: Sources, lines: Sequence[Line], printed: Mapping[str, Sequence[Column]]
) -> dict[str, pd.DataFrame]:
    """All tables by the name of their file."""
    frame, everything, folder = sources.judged, sources.rows, sources.results.folder
    overview, overall = summary(frame), summary(scoring_rows(everything))
    frames = {
        "table_v": tabulate(printed["table_v"], lines),
        "table_vi": tabulate(printed["table_vi"], lines),
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


def _write_tables(
    tables: Path,
    frames: Mapping[str, pd.DataFrame],
    printed: Mapping[str, Sequence[Column]],
    captions: Mapping[str, str],
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


PRINTED: dict[str, tuple[Column, ...]] = {
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
