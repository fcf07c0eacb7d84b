"""The reference of a case: which method gaps are measured against, and its objectives.

Where a case carries a paper's numbers, it is the method that the paper measures against; elsewhere an
accurate one, whose claims the scorer confirms; where nobody ran it, the best feasible schedule. Objectives
come from the rows of a results folder; where it lacks some, from the reference run that ships with the case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from ded_bench.analysis.lines import title
from ded_bench.analysis.paper_numbers import Paper
from ded_bench.methods.options import DEFAULT
from ded_bench.results.objectives import OBJECTIVES, Objective

#: References of cases without a paper's numbers, the first that has objectives.
ACCURATE = ("ded-radau", "ded-slp")
#: What stands for a method where none of these has objectives: the best feasible row of each instance counts.
BEST = ""


@dataclass(frozen=True, eq=False)
class Reference:
    """What gaps are measured against.

    Attributes:
        method: its name, or BEST; the settings are the default ones.
        objectives: by (instance, regime).
        shipped: how many of them come from the case's reference run, not from rows.
        wanted: the method to run where BEST stands in for one.
    """

    method: str
    objectives: pd.Series[float]
    shipped: int = 0
    wanted: str = ""

    @property
    def title(self) -> str:
        """The reference as tables name it."""
        return title(self.method) if self.method else "the best feasible schedule"


def choose_reference(rows: pd.DataFrame, paper: Paper | None, shipped: Sequence[Objective] = ()) -> Reference:
    """Choose the reference of a case, and collect its objectives.

    A shipped objective is used only for instances whose rows are of the same problem version.

    Args:
        rows: of one case in a results folder (see `Results.frame`).
        paper: the paper's numbers about the case.
        shipped: objectives of the case's reference run.
    """
    candidates = paper.references if paper else ACCURATE
    best = _by_instance(rows[rows["feasible"] == True].sort_values("objective"))  # noqa: E712
    ours = set(zip(rows["instance"], rows["problems_version"], strict=True))
    usable = OBJECTIVES.frame([o for o in shipped if (o.instance, o.problems_version) in ours])
    for method in candidates:
        is_reference = (rows["method"] == method) & (rows["settings"] == DEFAULT)
        own = _by_instance(rows[is_reference].dropna(subset=["objective"]))
        objectives = own.combine_first(_by_instance(usable[usable["method"] == method]))
        if len(objectives):
            return Reference(method, objectives, len(objectives) - len(own))
    return Reference(BEST if len(best) else candidates[0], best, 0, candidates[-1])


def _by_instance(rows: pd.DataFrame) -> pd.Series[float]:
    found = rows.set_index(["instance", "regime"])["objective"].astype(float)
    return found[~found.index.duplicated()]
