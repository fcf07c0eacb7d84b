"""Which rows tables are about, and their lines: one for each regime, method, settings and surrogate.

A row's `model` is `name@fingerprint`; a line's is the name. Where a folder holds rows of several
fingerprints of one model or policy, the newest count.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import METHODS
from ded_bench.results.timing import model_name

#: What makes a line of a table.
GROUP = ["regime", "method", "settings", "model"]
HEAD = [*GROUP, "title"]


def usual_model(method: str) -> str:
    """The surrogate that a method plans with unless told otherwise; empty for those of others."""
    return METHODS[method].model if method in METHODS else ""


def is_usual(settings: str, model: str, method: str) -> bool:
    """Whether a line has the default settings, and no surrogate but the method's usual one."""
    return settings == DEFAULT and model in ("", usual_model(method))


def title(method: str, settings: str = DEFAULT, model: str = "") -> str:
    """A method's name as tables print it; settings and surrogate only where they are not the usual ones."""
    name = METHODS[method].title if method in METHODS else method
    more = [settings] * (settings != DEFAULT) + [model] * (model not in ("", usual_model(method)))
    return f"{name} [{', '.join(more)}]" if more else name


def titled(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with a column `title` of its lines."""
    keys = frame[GROUP[1:]].itertuples(index=False, name=None)
    return frame.assign(title=[title(*key) for key in keys])


def named(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows with `model` and `policy` as names; `made_with` keeps both with their fingerprints."""
    made_with = (frame["model"] + " " + frame["policy"]).str.strip()
    names = {name: [model_name(text) for text in frame[name]] for name in ("model", "policy")}
    return frame.assign(made_with=made_with, **names)


def newest(frame: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """The rows that count, and why others do not.

    Of each line only rows with the newest model and policy count; of these one for an instance, the newest
    of several time limits.

    Args:
        frame: rows with names (see `named`).

    Returns:
        Rows in their order, and a sentence for each line with older ones.
    """
    dated = frame.sort_values("date", kind="stable")
    dated = dated.assign(last=dated.groupby(GROUP)["made_with"].transform("last"))
    is_new = dated["made_with"] == dated["last"]
    notes = [
        f"{len(old)} rows of {title(*key)} {regime} are of an older model or policy and left out; "
        f"those of {old['last'].iloc[0]} count."
        for regime, key, old in groups(dated[~is_new])
    ]
    rows = dated[is_new].drop_duplicates([*GROUP, "instance"], keep="last").sort_index()
    return rows.drop(columns="last"), notes


def groups(frame: pd.DataFrame) -> Iterator[tuple[str, tuple[str, str, str], pd.DataFrame]]:
    """(regime, (method, settings, model), rows) of every line, in the order of tables.

    Methods stand as registered, others after them; a method's usual line first.
    """
    known = list(METHODS)
    parts: dict[tuple[str, ...], pd.DataFrame] = {
        tuple(map(str, key)): rows for key, rows in frame.groupby(GROUP, sort=False)
    }

    def place(key: tuple[str, ...]) -> tuple[object, ...]:
        regime, method, settings, model = key
        rank = known.index(method) if method in known else len(known)
        other = model not in ("", usual_model(method))
        return regime, rank, method, settings != DEFAULT, _natural(settings), other, model

    for key in sorted(parts, key=place):
        regime, method, settings, model = key
        yield regime, (method, settings, model), parts[key]


def _natural(text: str) -> tuple[tuple[str, float], ...]:
    """Sorting key that puts refine=25 before refine=100."""
    parts = re.split(r"(\d+)", text)
    return tuple(
        (word, float(number or 0)) for word, number in zip(parts[::2], [*parts[1::2], ""], strict=True)
    )


def judged_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that tables are about: on test instances if there are any, else all but those of validation.

    Methods are chosen on validation instances.
    """
    for chosen in (frame["split"] == "test", frame["split"] != "validation"):
        if chosen.any():
            return where(frame, chosen)
    return frame.iloc[:0]


def on_usual_model(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows on a method's usual surrogate, wherever it has rows with it under the same settings."""
    usual = [model in ("", usual_model(m)) for m, model in zip(frame["method"], frame["model"], strict=True)]
    marked = frame.assign(usual=np.array(usual, dtype=bool))
    has = marked.groupby(["method", "settings"])["usual"].transform("any")
    return frame[marked["usual"] | ~has.astype(bool)]


def main_lines(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows of one line of each method: default settings, on the surrogate that most grids have rows on.

    Where several have as many, the method's usual one counts, then the one with most feasible schedules.
    """
    ranks: dict[str, list[tuple[Any, ...]]] = {}
    for key, rows in frame.groupby(GROUP[1:], sort=False):
        method, settings, model = map(str, key)
        other = model not in ("", usual_model(method))
        feasible = int((rows["feasible"] == True).sum())  # noqa: E712  (empty is not True)
        rank = (settings != DEFAULT, -rows["case"].nunique(), other, -feasible, settings, model)
        ranks.setdefault(method, []).append(rank)
    best = {method: min(ranked)[-2:] for method, ranked in ranks.items()}
    keys = zip(frame["method"], frame["settings"], frame["model"], strict=True)
    return where(frame, (best[method] == (settings, model) for method, settings, model in keys))


def where(frame: pd.DataFrame, marks: Iterable[bool]) -> pd.DataFrame:
    """The marked rows, also of a frame that has none."""
    return frame[np.array(list(marks), dtype=bool)]


def line_table(rows: Iterable[dict[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """Rows as a frame that has its columns even when it has no rows."""
    return pd.DataFrame(list(rows), columns=list(columns))


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a frame."""
    return [{str(name): value for name, value in row.items()} for row in frame.to_dict("records")]


def head(regime: str, key: tuple[str, str, str]) -> dict[str, Any]:
    """The first cells of a line: see HEAD."""
    return dict(zip(HEAD, (regime, *key, title(*key)), strict=True))
