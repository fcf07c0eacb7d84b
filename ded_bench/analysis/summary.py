"""Summaries of the results table: gaps, violations, rates, worst instances, performance profiles.

Pure functions of `Results.frame()` and of the timing table. What a failure costs is decided here:
a row without a score counts in `failures` and enters no mean; one that is not feasible never
counts as solved in a performance profile.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from ded_bench.methods.registry import METHODS
from ded_bench.plants.score import FEASIBLE_HZ, FEASIBLE_PU
from ded_bench.problem.case import Array
from ded_bench.solvers.status import Status

GROUP = ["regime", "method", "settings"]
HEAD = [*GROUP, "title"]
#: What a solver's claim must be to count as a success; the verdict of the scorer is another column.
SUCCESS = (Status.OPTIMAL, Status.FEASIBLE, Status.POLICY)
#: Split of the instances that choices are made on.
VALIDATION = "validation"
#: Settings whose name starts so are short trainings, to be compared with each other only.
STUDY = "study"
#: Settings whose name starts so solve full DED from another starting point.
START = "start-"
#: Settings of this name, or whose name ends so, plan on the AC network; the lossless one is not theirs.
AC = "ac"
#: Shift of the shifted geometric mean, s: times far below it count as equal.
TIME_SHIFT_S = 0.01
VIOLATIONS = ("freq_violation_hz", "ramp_violation", "bound_violation", "initial_violation")
#: What each of them is called.
LIMITS = dict(zip(VIOLATIONS, ("frequency", "ramp", "bounds", "initial power"), strict=True))
#: Gaps up to this are rounding, %: none of them is among the worst.
SMALLEST_GAP = 1e-3
#: The scorer's limits on each of them for `feasible` (see `truth.score`).
FEASIBLE = dict(zip(VIOLATIONS, (FEASIBLE_HZ, *[FEASIBLE_PU] * 3), strict=True))


def title(method: str, settings: str = "default") -> str:
    """A method's name as the tables print it; settings other than the default are named."""
    name = METHODS[method].title if method in METHODS else method
    return name if settings == "default" else f"{name} [{settings.removeprefix('default-')}]"


def is_study(slug: str) -> bool:
    """Whether settings are those of an ablation study."""
    return slug == STUDY or slug.startswith(f"{STUDY}-")


def in_own_table(slug: str) -> bool:
    """Whether rows with these settings stand in a table of their own, and in no other."""
    return is_study(slug) or slug.startswith(START) or slug == AC or slug.endswith(f"-{AC}")


def judged_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that most tables are about: `benchmark_rows` without those that have a table of their own."""
    return benchmark_rows(frame[~frame["settings"].map(in_own_table).astype(bool)])


def benchmark_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows on test instances if there are any, else all but those on validation instances."""
    frame = scoring_rows(frame)
    test = frame[frame["split"] == "test"]
    return test if len(test) else frame


def validation_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows that choices are made on: nothing else is read from them."""
    chosen: pd.DataFrame = frame[frame["split"] == VALIDATION]
    return chosen


def scoring_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """All rows but those of validation instances, on which methods were chosen."""
    chosen: pd.DataFrame = frame[frame["split"] != VALIDATION]
    return chosen


def coverage(overall: pd.DataFrame, overview: pd.DataFrame) -> pd.DataFrame:
    """Rows of a summary of everything whose methods have more rows than the summary of the judged rows."""
    judged = overview.set_index(GROUP)["rows"]
    counted = judged.reindex(pd.MultiIndex.from_frame(overall[GROUP]), fill_value=0).to_numpy()
    separate = overall["settings"].map(in_own_table).to_numpy(dtype=bool)
    more: pd.DataFrame = overall[(overall["rows"].to_numpy() > counted) & ~separate]
    return more.reset_index(drop=True)


def gaps(frame: pd.DataFrame, objectives: pd.Series[float]) -> pd.DataFrame:
    """Signed gap of every row to a reference, both re-simulated.

    Args:
        objectives: the reference's, by (instance, regime); see `evaluate.reference`.

    Returns:
        The frame with two more columns: `reference`, the reference's objective on the same instance and
        regime, and `gap_percent` = 100 (J / J_ref - 1); missing where either has no score, or where
        J_ref is not positive.
    """
    wanted = pd.MultiIndex.from_frame(frame[["instance", "regime"]])
    ours = objectives.reindex(wanted).to_numpy(dtype=float) if len(frame) else np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        gap = 100.0 * (frame["objective"].to_numpy(dtype=float) / ours - 1.0)
    known = (ours > 0) & np.isfinite(gap)
    return frame.assign(reference=ours, gap_percent=np.where(known, gap, np.nan))


def groups(frame: pd.DataFrame) -> Iterator[tuple[str, str, str, pd.DataFrame]]:
    """(regime, method, settings, rows) in the order of the tables: as registered, others after."""
    known = list(METHODS)
    parts = {(str(r), str(m), str(s)): rows for (r, m, s), rows in frame.groupby(GROUP, sort=False)}

    def place(key: tuple[str, ...]) -> tuple[object, ...]:
        regime, method, settings = key
        rank = known.index(method) if method in known else len(known)
        return regime, rank, method, settings != "default", natural(settings)

    for regime, method, settings in sorted(parts, key=place):
        yield regime, method, settings, parts[regime, method, settings]


def natural(text: str) -> tuple[tuple[str, int], ...]:
    """Sorting key that puts steps25 before steps100."""
    parts = re.split(r"(\d+)", text)
    return tuple(
        (word, int(number or 0)) for word, number in zip(parts[::2], [*parts[1::2], ""], strict=True)
    )


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Gaps, violations and rates per (regime, method, settings), of rows with their gaps.

    `n` rows have a gap, `failures` have no schedule or no score, `unpaired` have a score but no reference
    to compare with. `success_rate` is what solvers claim, `correct_rate` and
    `strict_rate` what the scorer found (`feasible`, `feasible_strict`); all three are shares of all rows.
    """
    rows = [
        dict(zip(HEAD, (regime, method, settings, title(method, settings)), strict=True)) | statistics(group)
        for regime, method, settings, group in groups(frame)
    ]
    return table(rows, [*HEAD, *statistics(frame[:0])])


def statistics(group: pd.DataFrame) -> dict[str, object]:
    """Counts, rates and spreads of rows with their gaps (see `summary`); missing where there are no rows."""
    paired = group.dropna(subset=["gap_percent"])
    failures = int(group["objective"].isna().sum())
    found: dict[str, object] = {
        "rows": len(group),
        "n": len(paired),
        "failures": failures,
        "unpaired": len(group) - failures - len(paired),
        "success_rate": float(group["status"].isin([str(s) for s in SUCCESS]).mean()),
        "correct_rate": float((group["feasible"] == True).mean()),  # noqa: E712  (empty is not True)
        "strict_rate": float((group["feasible_strict"] == True).mean()),  # noqa: E712
    }
    found |= _spread("gap_percent", paired["gap_percent"])
    found["cost_ratio"] = _ratio(paired["objective"].sum(), paired["reference"].sum())
    for name in VIOLATIONS:
        found |= _spread(name, group[name].dropna())
    return found


def table_times(frame: pd.DataFrame) -> pd.DataFrame:
    """Build, set-up and solve times of the results table, quartiles each, s.

    These were taken while `workers` processes shared the machine: they compare methods by orders
    of magnitude, nothing finer.
    """
    rows = []
    for regime, method, settings, group in groups(frame):
        row: dict[str, object] = {
            "regime": regime,
            "method": method,
            "settings": settings,
            "title": title(method, settings),
            "n": int(group["solve_s"].notna().sum()),
            "workers": " ".join(map(str, sorted(set(group["workers"])))),
        }
        for name in ("build_s", "setup_s", "solve_s"):
            row |= quartiles(name, group[name].dropna().to_numpy(dtype=float))
        row["solve_s_shifted_geometric_mean"] = shifted_geometric_mean(group["solve_s"].dropna().to_numpy())
        rows.append(row)
    return table(rows, TIME_COLUMNS)


def claims(frame: pd.DataFrame) -> pd.DataFrame:
    """What solvers claimed against what the scorer found, as counts per status."""
    rows = []
    for regime, method, settings, group in groups(frame):
        for status in [str(s) for s in Status if str(s) in set(group["status"])]:
            part = group[group["status"] == status]
            rows.append(
                {
                    "regime": regime,
                    "method": method,
                    "settings": settings,
                    "title": title(method, settings),
                    "status": status,
                    "meaning": Status(status).sentence,
                    "rows": len(part),
                    "feasible": int((part["feasible"] == True).sum()),  # noqa: E712
                    "feasible_strict": int((part["feasible_strict"] == True).sum()),  # noqa: E712
                    "infeasible": int((part["feasible"] == False).sum()),  # noqa: E712
                    "not_scored": int(part["feasible"].isna().sum()),
                }
            )
    return table(rows, CLAIM_COLUMNS)


def worst(frame: pd.DataFrame, count: int = 3) -> pd.DataFrame:
    """The worst instances of each method: largest gaps, and largest violations, of rows with their gaps.

    `excess` is the largest violation in units of the scorer's tolerance, `broken` the limit that it breaks.
    Rows within tolerance are not listed among the violations, nor gaps below zero or below SMALLEST_GAP.
    """
    scored = frame.dropna(subset=["objective"])
    scored = scored.assign(excess=excess(scored), broken=broken(scored))
    rows = []
    for regime, method, settings, group in groups(scored):
        by_gap = group[group["gap_percent"] > SMALLEST_GAP]
        by_violation = group[group["excess"] > 1]
        for reason, part, column in (
            ("gap", by_gap, "gap_percent"),
            ("violation", by_violation, "excess"),
        ):
            ranked = part.sort_values([column, "instance"], ascending=[False, True])
            for _, row in ranked.head(count).iterrows():
                kept = {name: row[name] for name in ("instance", "gap_percent", *EXCESSES)}
                head = {"regime": regime, "method": method, "settings": settings, "worst_by": reason}
                rows.append(head | {"title": title(method, settings)} | kept)
    return table(rows, WORST_COLUMNS)


def excess(frame: pd.DataFrame) -> Array:
    """Largest violation of each row in units of the scorer's tolerance, shape (n_rows,)."""
    scaled = [frame[name].to_numpy(dtype=float) / limit for name, limit in FEASIBLE.items()]
    return np.max(scaled, axis=0) if len(frame) else np.zeros(0)


def broken(frame: pd.DataFrame) -> list[str]:
    """Which limit each row breaks most, measured in the scorer's tolerances; empty if it is within all."""
    scaled = {name: frame[name].to_numpy(dtype=float) / limit for name, limit in FEASIBLE.items()}
    largest = [max(scaled, key=lambda name: scaled[name][i]) for i in range(len(frame))]
    return [LIMITS[name] if scaled[name][i] > 1 else "" for i, name in enumerate(largest)]


def performance_profile(frame: pd.DataFrame, column: str) -> pd.DataFrame:
    """Dolan-Moré profile of one column per regime.

    The ratio of a row is its value over the best of all methods on the same instance. Only rows that
    the scorer calls feasible take part; any other counts as never solved.

    Args:
        column: `solve_s` or `objective`.

    Returns:
        Columns regime, method, settings, title, ratio, fraction: `fraction` of the instances that a
        method was asked have a ratio up to `ratio`; one step per row.
    """
    usable = frame[(frame["feasible"] == True) & (frame[column] > 0)]  # noqa: E712
    best = usable.groupby(["instance", "regime"])[column].min()
    asked = frame.groupby(GROUP)["instance"].nunique()
    rows = []
    for regime, method, settings, group in groups(usable):
        lowest = best.reindex(pd.MultiIndex.from_frame(group[["instance", "regime"]])).to_numpy()
        ratios = np.sort(group[column].to_numpy(dtype=float) / lowest)
        for i, ratio in enumerate(ratios, start=1):
            rows.append(
                {
                    "regime": regime,
                    "method": method,
                    "settings": settings,
                    "title": title(method, settings),
                    "ratio": float(ratio),
                    "fraction": i / int(asked[regime, method, settings]),
                }
            )
    return table(rows, [*GROUP, "title", "ratio", "fraction"])


def timed_rows(frame: pd.DataFrame, calls: pd.DataFrame) -> pd.DataFrame:
    """The rows that were timed alone on a machine, with the median of those times as their `solve_s`.

    Args:
        calls: columns instance, regime, method, settings and solve_s (s, missing where a call failed).
    """
    names = ["instance", *GROUP]
    seconds = calls.groupby(names)["solve_s"].median()
    found = seconds.reindex(pd.MultiIndex.from_frame(frame[names])).to_numpy(dtype=float)
    timed: pd.DataFrame = frame.assign(solve_s=found)[np.isfinite(found)]
    return timed


def tradeoff(frame: pd.DataFrame, timing: pd.DataFrame) -> pd.DataFrame:
    """Mean gap against time per schedule, of rows with their gaps: one point per (regime, method, settings).

    `seconds` is the median of the timing table where it has the method (`alone` is true), else that
    of the results table, taken under parallel load.
    """
    loaded = table_times(frame).set_index(GROUP)["solve_s"]
    alone = timing.dropna(subset=["solve_s"]).set_index(GROUP)["solve_s"]
    rows = []
    for row in summary(frame).to_dict("records"):
        key = tuple(row[name] for name in GROUP)
        measured = key in alone.index
        point: dict[str, object] = {name: row[name] for name in (*HEAD, "n", "correct_rate")}
        point |= {
            "gap_percent": row["gap_percent_mean"],
            "seconds": float(alone[key] if measured else loaded[key]),
            "alone": measured,
        }
        rows.append(point)
    return table(rows, [*HEAD, "n", "correct_rate", "gap_percent", "seconds", "alone"])


def shifted_geometric_mean(values: Array, shift: float = TIME_SHIFT_S) -> float:
    """exp(mean(log(values + shift))) - shift; missing if there are no values."""
    if not len(values):
        return float("nan")
    return float(np.exp(np.log(np.asarray(values, dtype=float) + shift).mean()) - shift)


def quartiles(name: str, values: Array) -> dict[str, float]:
    """Median and quartiles as `name`, `name_q1`, `name_q3`; missing if there are no values."""
    q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75]) if len(values) else [np.nan] * 3
    return {name: float(median), f"{name}_q1": float(q1), f"{name}_q3": float(q3)}


def _spread(name: str, values: pd.Series[float]) -> dict[str, float]:
    numbers = values.to_numpy(dtype=float)
    if not len(numbers):
        return dict.fromkeys((f"{name}_{part}" for part in SPREAD), float("nan"))
    found = (numbers.mean(), np.median(numbers), np.quantile(numbers, 0.95), numbers.max())
    return {f"{name}_{part}": float(value) for part, value in zip(SPREAD, found, strict=True)}


def _ratio(above: float, below: float) -> float:
    return above / below if below > 0 else float("nan")


def table(rows: list[dict[str, object]], columns: Sequence[str]) -> pd.DataFrame:
    """Rows as a frame that has its columns even when it has no rows."""
    return pd.DataFrame(rows, columns=list(columns))


SPREAD = ("mean", "median", "p95", "max")
TIME_COLUMNS = [
    *HEAD,
    *("n", "workers"),
    *(f"{name}{part}" for name in ("build_s", "setup_s", "solve_s") for part in ("", "_q1", "_q3")),
    "solve_s_shifted_geometric_mean",
]
CLAIM_COLUMNS = [
    *HEAD,
    *("status", "meaning", "rows", "feasible", "feasible_strict", "infeasible", "not_scored"),
]
EXCESSES = (*VIOLATIONS, "excess", "broken")
WORST_COLUMNS = [*HEAD, "worst_by", "instance", "gap_percent", *EXCESSES]
