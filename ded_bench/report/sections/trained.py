"""What was trained: policies, certificates."""

from __future__ import annotations

import pandas as pd

from ded_bench.analysis.lines import titled
from ded_bench.report.columns import CERTIFICATE, TRAINING
from ded_bench.report.page import Block, Heading, PageTable, Text
from ded_bench.report.sources import Draft, Sources, training_table


def tables(sources: Sources) -> dict[str, PageTable]:
    """How policies were trained."""
    return {"training": PageTable(training_table(sources.folder), TRAINING)}


def blocks(draft: Draft) -> list[Block]:
    """Trainings and certificates."""
    made: list[Block] = [Heading("Training of the policies")]
    frame = draft.tables["training"].frame
    if len(frame):
        filled = frame.map(lambda value: value not in ("", None)).any()
        made.append(PageTable(frame, tuple(column for column in TRAINING if filled[column.name])))
    else:
        made.append(Text("The folder holds no policy; `ded-bench train-dpc` trains one."))
    made += [*draft.pictures["training"], Heading("Certificate")]
    if not draft.sources.certificates:
        return [*made, Text("No certificate was made for these results; `ded-bench certify` makes one.")]
    certificates = titled(pd.DataFrame([{"model": ""} | c.model_dump() for c in draft.sources.certificates]))
    return [*made, PageTable(certificates, CERTIFICATE, "All that makes them up stands in certificate.json")]
