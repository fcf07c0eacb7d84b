"""Which rows tables are about, their lines, and summaries of them: gaps, violations, rates, times, findings.

A line is one regime, method, settings and surrogate. A row's `model` is `name@fingerprint`; a line's is the
name. Where a folder holds rows of several fingerprints of one model or policy, the newest count.

All are pure functions of `Results.frame()` and of the timing table. What a failure costs is decided here: a
row without a score counts in `failures` and enters no mean.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import METHODS
from ded_bench.plants.score import FEASIBLE_HZ, FEASIBLE_PU, ISLAND_HZ
from ded_bench.results.rows import Key
from ded_bench.results.timing import model_name
from ded_bench.solvers.status import Status

#: What makes a line of a table.
GROUP = ["regime", "method", "settings", "model"]
HEAD = [*GROUP, "title"]


def usual_model(method: str) -> str:
    """The surrogate that a method plans with unless told otherwise; empty for those of others."""
    return METHODS[method].model if method in METHODS else ""


def title(method: str, settings: str = DEFAULT, model: str = "") -> str:
    """A method's name as tables print it; settings and surrogate only where they are not the usual ones."""
    name = METHODS[method].title if method in METHODS else method
    more = [settings] * (settings != DEFAULT) + [model] * (model not in ("", usual_model(method)))
    return f"{name} [{', '.join(more)}]" if more else name


def titled(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with a column `title` of its lines."""
    return frame.assign(title=[title(*key) for key in frame[GROUP[1:]].itertuples(index=False, name=None)])


def named(frame: pd.DataFrame) -> pd.DataFrame:
    """Rows with `model` and `policy` as names; `made_with` has both with fingerprints, `made` the version."""
    made_with = (frame["model"] + " " + frame["policy"]).str.strip()
    made = made_with + " " + frame.get("method_version", pd.Series(0, frame.index)).astype(str)
    names = {name: [model_name(text) for text in frame[name]] for name in ("model", "policy")}
    return frame.assign(made_with=made_with, made=made, **names)


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
    is_new = dated["made"] == dated.groupby(GROUP)["made"].transform("last")
    notes = [
        f"{len(old)} rows of {title(*key)} {regime} are of an older model, policy or version and left out; "
        f"those of {old['last'].iloc[0] or 'the newest version'} count."
        for regime, key, old in groups(dated[~is_new])
    ]
    rows = dated[is_new].drop_duplicates([*GROUP, "instance"], keep="last").sort_index()
    return rows.drop(columns="last"), notes


def groups(frame: pd.DataFrame) -> Iterator[tuple[str, tuple[str, str, str], pd.DataFrame]]:
    """(regime, (method, settings, model), rows) of every line, in the order of tables.

    Methods stand as registered, others after them; a method's usual line first.
    """
    known = list(METHODS)

    def place(part: tuple[Any, pd.DataFrame]) -> tuple[object, ...]:
        regime, method, settings, model = part[0]
        rank = known.index(method) if method in known else len(known)
        other = model not in ("", usual_model(method))
        # refine=25 before refine=100: words and numbers in turn
        natural = [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", settings))]
        return regime, rank, method, settings != DEFAULT, natural, other, model

    parts: list[tuple[Any, pd.DataFrame]] = sorted(frame.groupby(GROUP, sort=False), key=place)
    for (regime, method, settings, model), rows in parts:
        yield regime, (method, settings, model), rows


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
    has = marked.groupby(["regime", "method", "settings"])["usual"].transform("any")
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


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a frame."""
    return [{str(name): value for name, value in row.items()} for row in frame.to_dict("records")]


def head(regime: str, key: tuple[str, str, str]) -> dict[str, Any]:
    """The first cells of a line: see HEAD."""
    return dict(zip(HEAD, (regime, *key, title(*key)), strict=True))


#: What a solver's claim must be to count as a success; the verdict of the scorer is another column.
SUCCESS = [str(status) for status in (Status.OPTIMAL, Status.FEASIBLE, Status.POLICY)]
VIOLATIONS = ("freq_violation_hz", "ramp_violation", "bound_violation", "initial_violation")
#: What each of them is called.
LIMITS = dict(zip(VIOLATIONS, ("frequency", "ramp", "bounds", "initial power"), strict=True))
#: The scorer's limits on each of them for `feasible`; islands' frequencies have ISLAND_HZ.
FEASIBLE = dict(zip(VIOLATIONS, (FEASIBLE_HZ, *[FEASIBLE_PU] * 3), strict=True))
#: Means over rows of islands: column of the rows, and its unit in theirs.
ISLAND = {
    "mean_peak_mhz": ("mean_freq_max_hz", 1e3),
    "mean_rms_mhz": ("mean_freq_rms_hz", 1e3),
    "swing_peak_mhz": ("swing_max_hz", 1e3),
    "agc_travel_pu": ("agc_travel_pu", 1.0),
}
#: Who judges kept schedules beside the scorer: full machine models, and ANDES.
OTHER_JUDGES = ("validated", "confirmed")
SPREAD = ("mean", "median", "p95", "max")


def judged_elsewhere(
    frame: pd.DataFrame, judgements: Mapping[str, Mapping[Key, bool | None]]
) -> pd.DataFrame:
    """Rows with a column for each of OTHER_JUDGES.

    Args:
        frame: rows of a results table; `key` is each one's there.
        judgements: by judge and key; None where a schedule was given and could not be judged.

    Returns:
        The frame with judgements, empty texts where there are none.
    """
    columns = {name: [judgements[name].get(key, "") for key in frame["key"]] for name in OTHER_JUDGES}
    return frame.assign(**{name: pd.Series(c, frame.index, dtype=object) for name, c in columns.items()})


def gaps(frame: pd.DataFrame, objectives: pd.Series[float]) -> pd.DataFrame:
    """Signed gap of every row to a reference, both re-simulated.

    Args:
        frame: rows of a results table.
        objectives: the reference's, by (instance, regime); see `analysis.reference`.

    Returns:
        The frame with two more columns: `reference`, the reference's objective on the same instance and
        regime, and `gap_percent` = 100 (J / J_ref - 1); missing where either has no score, or where
        J_ref is not positive.
    """
    wanted = pd.MultiIndex.from_frame(frame[["instance", "regime"]])
    theirs = objectives.reindex(wanted).to_numpy(dtype=float) if len(frame) else np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        gap = 100.0 * (frame["objective"].to_numpy(dtype=float) / theirs - 1.0)
    known = (theirs > 0) & np.isfinite(gap)
    return frame.assign(reference=theirs, gap_percent=np.where(known, gap, np.nan))


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Gaps, violations and rates of every line, of rows with their gaps.

    `n` rows have a gap, `failures` have no schedule or no score, `unpaired` have a score but no reference
    to compare with. `success_rate` is what solvers claim, `correct_rate` and
    `strict_rate` what the scorer found (`feasible`, `feasible_strict`); all three are shares of all rows.
    `validated_rate` and `confirmed_rate` are shares of the `validated_n` and `confirmed_n` rows that another
    judge could judge, of `validated_asked` and `confirmed_asked` whose schedules it was given.
    """
    rows = [head(regime, key) | statistics(group) for regime, key, group in groups(frame)]
    return pd.DataFrame(rows, columns=[*HEAD, *statistics(frame[:0])])


def statistics(group: pd.DataFrame) -> dict[str, Any]:
    """Counts, rates and spreads of rows with their gaps (see `summary`); missing where there are no rows."""
    paired = group.dropna(subset=["gap_percent"])
    failures = int(group["objective"].isna().sum())
    cost, theirs = float(paired["objective"].sum()), float(paired["reference"].sum())
    found: dict[str, Any] = {
        "rows": len(group),
        "n": len(paired),
        "failures": failures,
        "unpaired": len(group) - failures - len(paired),
        "success_rate": float(group["status"].isin(SUCCESS).mean()),
        "correct_rate": float((group["feasible"] == True).mean()),  # noqa: E712  (empty is not True)
        "strict_rate": float((group["feasible_strict"] == True).mean()),  # noqa: E712
    }
    found |= _spread("gap_percent", paired["gap_percent"])
    found["cost_ratio"] = cost / theirs if theirs > 0 else np.nan
    for name in VIOLATIONS:
        found |= _spread(name, group[name])
    for name in OTHER_JUDGES:
        asked = [judgement for judgement in group.get(name, ()) if judgement != ""]
        said = [judgement for judgement in asked if judgement is not None]
        found |= {f"{name}_asked": len(asked), f"{name}_n": len(said)}
        found[f"{name}_rate"] = float(np.mean(said)) if said else np.nan
    return found


def _spread(name: str, values: pd.Series[float]) -> dict[str, float]:
    numbers = values.astype(float)
    found: list[Any] = [numbers.mean(), numbers.median(), numbers.quantile(0.95), numbers.max()]
    return {f"{name}_{part}": float(value) for part, value in zip(SPREAD, found, strict=True)}


def largest_violation(rows: pd.DataFrame) -> str:
    """The largest violation of some rows in units of its tolerance, in words: how far beyond which limit."""
    scored = rows.dropna(subset=["objective"])
    if not len(scored):
        return "–"
    units = scored[list(FEASIBLE)].astype(float) / pd.Series(FEASIBLE)
    units["freq_violation_hz"] *= np.where(scored["excess_mean_hz"].notna(), FEASIBLE_HZ / ISLAND_HZ, 1.0)
    shares = units.fillna(-1.0).max()
    name = str(shares.idxmax())
    if shares[name] <= 1:
        return "none"
    return f"{scored[name].max():.2g} {'Hz' if name == VIOLATIONS[0] else 'pu'} ({LIMITS[name]})"


def outcome(frame: pd.DataFrame, timing: pd.DataFrame | None = None) -> pd.DataFrame:
    """What became of every line's rows, of rows with their gaps: who solved what, gaps, violations, times.

    Of `rows`, `solved` have a score and `feasible` keep every limit; `largest` is the largest violation.
    `seconds` is the median of the timing table where it has the line (`alone` is true), else that
    of the results table, taken under parallel load. Islands have means of what their rows say of frequencies
    (mHz) and AGC (pu).
    """
    taken = frame.assign(time_s=frame["build_s"].fillna(0.0) + frame["solve_s"])
    loaded = taken.groupby(GROUP)["time_s"].median()
    alone = (loaded if timing is None else timing.set_index(GROUP)["time_s"]).dropna()
    found = summary(frame)
    found["solved"] = found["rows"] - found["failures"]
    found["feasible"] = (found["correct_rate"] * found["rows"]).round().fillna(0).astype(int)
    found["largest"] = [largest_violation(group) for *_, group in groups(frame)]
    keys = pd.MultiIndex.from_frame(found[GROUP])
    measured = keys.isin(alone.index)
    seconds: Any = np.where(measured, alone.reindex(keys), loaded.reindex(keys)) if len(found) else []
    found = found.assign(gap_percent=found["gap_percent_mean"], seconds=seconds, alone=measured)
    counts = ("n", "rows", "solved", "feasible", "correct_rate")
    for name, (column, scale) in ISLAND.items():
        found[name] = [scale * group[column].mean() for *_, group in groups(frame)]
    return found[[*HEAD, *counts, "gap_percent", "largest", "seconds", "alone", *ISLAND]]


def own_first(found: pd.DataFrame) -> pd.DataFrame:
    """Lines of a table in their order, but methods that are not the suite's before all others."""
    is_ours = found["method"].isin(list(METHODS))
    return pd.concat([found[~is_ours], found[is_ours]])


def findings(found: pd.DataFrame, reference: str) -> Iterator[str]:
    """Sentences about the methods that were run, for each regime.

    Args:
        found: see `summary.outcome`.
        reference: title of what gaps are to.
    """
    for regime, lines in found.groupby("regime", sort=False):
        is_whole = lines["rows"] == lines["rows"].max()  # few instances prove little
        kept = records(lines[is_whole & (lines["feasible"] == lines["rows"]) & lines["seconds"].notna()])
        said = [f"{len(kept)} of {len(lines)} methods and settings keep every limit on every instance"]
        if kept:
            fastest = min(kept, key=lambda row: row["seconds"])
            said.append(f"the fastest of these is {_cost(fastest, reference)}")
            cheapest = min(kept, key=lambda row: np.nan_to_num(row["gap_percent"], nan=np.inf))
            said += [f"the cheapest {_cost(cheapest, reference)}"] * (cheapest is not fastest)
        yield f"**{regime}:** {'; '.join(said)}."
    for row in records(own_first(found)):
        name = f"{row['title']} {row['regime']}"
        if row["solved"] < row["rows"]:
            yield f"**{name}** failed on {row['rows'] - row['solved']} of {row['rows']} instances."
        if row["method"] not in METHODS and row["solved"]:
            kept_on = f"it keeps every limit on {row['feasible']} of {row['rows']} instances"
            yield f"**{name}:** {_cost(row, reference)}; {kept_on}; largest violation: {row['largest']}."
    broken = [
        f"{row['title']} {row['regime']} by {row['largest']}"
        for row in records(found)
        if row["feasible"] < row["solved"] and row["method"] in METHODS and row["settings"] == "default"
    ]
    if broken:
        yield f"Limits are broken, on some instance, by up to: {', '.join(broken)}."


def _cost(row: dict[str, Any], reference: str) -> str:
    """A method, its gap and its time."""
    gap = "no gap" if np.isnan(row["gap_percent"]) else f"{row['gap_percent']:+.3g} % over {reference}"
    taken = "not timed" if np.isnan(row["seconds"]) else f"{row['seconds']:.2g} s"
    return f"{row['title']} ({gap}, {taken})"
