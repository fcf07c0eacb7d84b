"""Which code, models and policies made the rows and times of a report, and where they differ within it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

import pandas as pd

from ded_bench.analysis.summary import GROUP, HEAD, groups, title
from ded_bench.methods.registry import METHODS
from ded_bench.plants import score as scorer
from ded_bench.run.code import code_of

#: Columns of the results table that say what made a row.
MADE_BY = ("code", "score_code", "model", "policy", "solver_version")
#: And in words, where one of them differs among rows that should share it.
WORDS = {"model": "Koopman models", "policy": "policies", "solver_version": "versions of the solver"}


def provenance(frame: pd.DataFrame, timing: pd.DataFrame) -> pd.DataFrame:
    """What made the rows and the times of each (regime, method, settings).

    Where there are several values, each stands with its number of rows.

    Args:
        timing: one row per (regime, method, settings), with its code.
    """
    timed = timing.set_index(GROUP)["code"]
    rows = []
    for regime, method, settings, group in groups(frame):
        names = [regime, method, settings, title(method, settings), len(group)]
        rows.append(
            [*names, *(_listed(group[name]) for name in MADE_BY), timed.get((regime, method, settings))]
        )
    return pd.DataFrame(rows, columns=[*HEAD, "rows", *MADE_BY, "timed_code"])


def provenance_notes(frame: pd.DataFrame, timing: pd.DataFrame) -> list[str]:
    """Where rows of one table come from different code, models or policies, in sentences.

    Args:
        frame: the rows that the tables are about.
        timing: see `provenance`.
    """
    made = frame[frame["objective"].notna()]
    notes = list(_code_notes(made))
    for name, what in WORDS.items():
        mixed = [
            f"{title(method, settings)} {regime} ({_listed(rows[name])})"
            for regime, method, settings, rows in groups(made)
            if rows[name].nunique() > 1
        ]
        if mixed:
            notes.append(f"Rows of one method come from different {what}: {'; '.join(mixed)}.")
    both = timing.merge(
        made.groupby(GROUP)[["code", "model", "policy"]].first(), on=GROUP, suffixes=("", "_rows")
    )
    for name in ("code", "model", "policy"):
        other = both[both[name].map(_plain) != both[f"{name}_rows"].map(_plain)]
        if len(other):
            names = ", ".join(
                f"{title(str(row.method), str(row.settings))} {row.regime}" for row in other.itertuples()
            )
            notes.append(f"Times were taken with another {name} than the rows were made with: {names}.")
    return notes


def _code_notes(made: pd.DataFrame) -> Iterator[str]:
    unknown = made[(made["code"] == "") | (made["score_code"] == "")]
    if len(unknown):
        yield f"{len(unknown)} rows do not say which code made them: {_titles(unknown['method'])}."
    # Settings that another module answers have a code of their own.
    module = pd.Series(
        [_module(*of) for of in zip(made["method"], made["settings"], strict=True)], made.index
    )
    mixed = [
        f"{title(str(method))} ({_listed(codes)})"
        for (method, _), codes in made["code"].groupby([made["method"], module], sort=False)
        if codes.nunique() > 1
    ]
    if mixed:
        yield f"Rows of one method come from different code: {'; '.join(mixed)}."
    if made["score_code"].nunique() > 1:
        yield (
            f"Rows were scored by different code ({_listed(made['score_code'])}); "
            "`ded-bench score --results DIR --update` scores the kept schedules anew."
        )
    known = made[(module != "") & (made["code"] != "")]
    other = known[known["code"] != module[known.index].map(code_of)]
    if len(other):
        yield f"Rows come from other code than what is installed here: {_titles(other['method'])}."
    scored = made[made["score_code"] != ""]
    if len(scored) and (scored["score_code"] != code_of(scorer.__name__)).any():
        yield "Rows were scored by other code than what is installed here."


def _module(method: str, settings: str) -> str:
    """Which of our modules answers; nothing for the methods of others."""
    return METHODS[method].module_of(settings) if method in METHODS else ""


def _listed(values: Iterable[str]) -> str:
    """Distinct values, the most frequent first; with their numbers, if there are several."""
    counts = Counter(_plain(value) or "unknown" for value in values)
    if len(counts) == 1:
        return next(iter(counts)).replace("unknown", "")
    return ", ".join(f"{value} × {count}" for value, count in counts.most_common())


def _plain(text: str) -> str:
    """A model or policy as tables print it: its name, then its fingerprint."""
    return text.replace("@", " ")


def _titles(methods: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(title(str(method)) for method in methods))
