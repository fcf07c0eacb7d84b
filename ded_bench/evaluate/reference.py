"""The reference of a case: which method gaps are measured against, and its objectives.

Where a case carries a paper's numbers, it is the method that the paper measures against; elsewhere an
accurate one, whose claims the scorer confirms. Objectives come from the rows of a results folder; where it
lacks some, from the table that lies beside the case's instances.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ded_bench.evaluate.paper_numbers import read_paper
from ded_bench.evaluate.summary import title
from ded_bench.files.table import Table, cell, plain_name
from ded_bench.problem.case import SHIPPED_CASES
from ded_bench.problem.sampling import load_manifest

if TYPE_CHECKING:
    import pandas as pd

#: References of cases without a paper's numbers, the first that has objectives.
ACCURATE = ("ded-radau", "ded-slp")
#: Settings of every reference.
DEFAULT = "default"


@dataclass(frozen=True)
class ReferenceRow:
    """A re-simulated objective of a reference method with default settings; `version` is the problems'."""

    instance: str = cell(check=plain_name)
    regime: str = cell(check=plain_name)
    method: str = cell(check=plain_name)
    objective: float = cell(lowest=0)
    version: str = cell()


REFERENCE_ROWS = Table(ReferenceRow)


@dataclass(frozen=True, eq=False)
class Reference:
    """What gaps are measured against.

    Attributes:
        method: its name; the settings are the default ones.
        objectives: by (instance, regime).
        shipped: how many of them come from the table beside the case, not from rows.
    """

    method: str
    objectives: pd.Series[float]
    shipped: int = 0

    @property
    def run(self) -> tuple[str, str]:
        """Method and settings."""
        return self.method, DEFAULT

    @property
    def title(self) -> str:
        """The reference as tables name it."""
        return title(*self.run)


def shipped_table(problems: Path) -> Path:
    """Where the reference objectives of a case lie: beside its instances."""
    return problems / "reference.csv"


def read_shipped(problems: Path) -> list[ReferenceRow]:
    """The reference objectives beside a case's instances, none if there is no table; InputError if wrong."""
    path = shipped_table(problems)
    return REFERENCE_ROWS.read(path) if path.is_file() else []


def reference_objectives(case_id: str, rows: pd.DataFrame, problems: Path | None = None) -> Reference:
    """Choose the reference of a case, and collect its objectives.

    A shipped objective is used only for instances whose rows are of the same problem version.

    Args:
        rows: of a results folder (see `run.results.Results.frame`).
        problems: folder of the case's instances and of the paper's numbers; None: the shipped one.

    Raises:
        InputError: the paper's numbers, the manifest or the table beside the case are wrong.
    """
    folder = problems or SHIPPED_CASES / case_id
    paper = read_paper(folder)
    candidates = paper.references if paper else ACCURATE
    shipped = _shipped(folder, rows)
    for method in candidates:
        is_reference = (rows["method"] == method) & (rows["settings"] == DEFAULT)
        own = rows[is_reference].dropna(subset=["objective"]).set_index(["instance", "regime"])["objective"]
        own = own[~own.index.duplicated()]
        known = shipped[shipped["method"] == method].set_index(["instance", "regime"])["objective"]
        more = known[~known.index.isin(own.index)]
        objectives = own.reindex(own.index.append(more.index))
        objectives.update(more)
        if len(objectives):
            return Reference(method, objectives.astype(float), len(more))
    return Reference(candidates[0], rows[:0].set_index(["instance", "regime"])["objective"].astype(float))


def _shipped(folder: Path, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows beside the case that are about the very instances of these results."""
    found = REFERENCE_ROWS.frame(read_shipped(folder))
    manifest = load_manifest(folder) if len(found) else None
    if manifest is None:
        return found[:0]
    ours = set(rows.loc[rows["problems_version"] == manifest.version, "instance"])
    return found[(found["version"] == manifest.version) & found["instance"].isin(ours)]
