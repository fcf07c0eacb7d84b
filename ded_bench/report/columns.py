"""Every column that the report prints, declared once: name, heading, unit, format, source of its value.

A column with a `value` computes it from what a line of its table is about; any other names a column of the
frame that the table prints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pandas as pd

from ded_bench.analysis.summary import HEAD
from ded_bench.report.paper import Line


@dataclass(frozen=True)
class Column:
    """One column of a printed table.

    Attributes:
        name: in the frame and in the CSV file.
        text: what stands above it, without the unit.
        unit: printed after the text, in brackets.
        form: format of its floats.
        value: computes a cell from a line of Tables V and VI.
    """

    name: str
    text: str
    unit: str = ""
    form: str = ".3g"
    value: Callable[[Line], object] | None = None

    @property
    def heading(self) -> str:
        """What stands above the column."""
        return f"{self.text} ({self.unit})" if self.unit else self.text

    def cell(self, value: object) -> str:
        """The printed value; a missing number is a dash."""
        if value is None or (isinstance(value, float) and math.isnan(value)) or value is pd.NA:
            return "–"
        if isinstance(value, float):
            text = format(value, self.form)
            return text.replace("%", " %")
        return str(value)


def tabulate(columns: Sequence[Column], lines: Sequence[Line]) -> pd.DataFrame:
    """The frame of Table V or VI: what each line is about, then every column that has a `value`."""
    computed = {column.name: column.value for column in columns if column.value}
    rows = [
        [getattr(line, name) for name in HEAD] + [value(line) for value in computed.values()]
        for line in lines
    ]
    return pd.DataFrame(rows, columns=[*HEAD, *computed])


_HEAD = (Column("regime", "Regime"), Column("title", "Method"))
_FREQUENCY = (
    Column("freq_violation_hz_mean", "frequency mean", "Hz"),
    Column("freq_violation_hz_max", "frequency max", "Hz"),
)
_SPREAD = (("mean", "mean"), ("median", "median"), ("p95", "95 %"), ("max", "max"))


def _papers(name: str, text: str, unit: str = "") -> Column:
    """A number of the paper, printed as it prints it."""
    return Column(f"paper_{name}", text, unit, "g", value=lambda line: line.papers(name))


def _statistic(name: str, text: str | None = None, unit: str = "", of: str = "") -> Column:
    return Column(name, text or name, unit, value=lambda line: line.statistics[of or name])


def _verdict(what: str, name: str) -> Column:
    """How the mean of a violation stands against the paper's."""
    return Column(
        f"against_paper_{what}",
        f"{what} against the paper",
        value=lambda line: line.verdict(line.statistics[f"{name}_mean"], name, line.statistics["failures"]),
    )


TABLE_V = (
    *_HEAD,
    Column("increase_percent", "% increase in obj. over DED", value=lambda line: line.increase_percent),
    _papers("increase_percent", "paper's %"),
    Column("solve_s", "Sol. time", "s", value=lambda line: line.timing.get("solve_s", math.nan)),
    _papers("solve_s", "paper's time", "s"),
    _statistic("n"),
    _statistic("failures"),
    Column(
        "against_paper_increase",
        "objective against the paper",
        value=lambda line: line.verdict(
            line.increase_percent, "increase_percent", line.statistics["failures"]
        ),
    ),
    Column(
        "against_paper_time",
        "time against the paper",
        value=lambda line: line.verdict(
            line.timing.get("solve_s", math.nan), "solve_s", line.timing.get("failures", 0)
        ),
    ),
)
TABLE_VI = (
    *_HEAD,
    _statistic("freq_violation_hz", "freq. const. viol.", "Hz", of="freq_violation_hz_mean"),
    _papers("freq_violation_hz", "paper's", "Hz"),
    _statistic("ramp_violation", "ramp const. viol.", "pu", of="ramp_violation_mean"),
    _papers("ramp_violation", "paper's", "pu"),
    Column("n", "n", value=lambda line: line.statistics["rows"] - line.statistics["failures"]),
    _statistic("failures"),
    _verdict("frequency", "freq_violation_hz"),
    _verdict("ramp", "ramp_violation"),
)
#: Shorter headings for the first screen.
_SHORT = {
    "increase_percent": "% over DED",
    "solve_s": "time",
    "freq_violation_hz": "frequency",
    "ramp_violation": "ramp",
    "failures": "failed",
} | dict.fromkeys(
    ("paper_increase_percent", "paper_solve_s", "paper_freq_violation_hz", "paper_ramp_violation"), "paper's"
)
#: Columns of both tables on the first screen.
FRONT_V, FRONT_VI = (
    tuple(replace(c, text=_SHORT.get(c.name, c.text)) for c in table if not c.name.startswith("against_"))
    for table in (TABLE_V, TABLE_VI)
)


def without_paper(columns: Sequence[Column], reference: str) -> tuple[Column, ...]:
    """Columns of Table V or VI where there is no paper to stand beside; `reference` is what gaps are to."""
    kept = [column for column in columns if "paper" not in column.name]
    return tuple(
        replace(c, text=c.text.replace("DED", reference)) if c.name == "increase_percent" else c for c in kept
    )


GAPS = (
    *_HEAD,
    Column("rows", "rows"),
    Column("n", "n"),
    Column("failures", "failures"),
    Column("unpaired", "without reference"),
    *(Column(f"gap_percent_{part}", heading) for part, heading in _SPREAD),
    Column("cost_ratio", "ratio of summed costs", form=".6f"),
)
RATES = (
    *_HEAD,
    Column("rows", "rows"),
    Column("success_rate", "success (claimed)", form=".1%"),
    Column("correct_rate", "feasible (verified)", form=".1%"),
    Column("strict_rate", "strictly feasible (verified)", form=".1%"),
)
COVERAGE = (
    *RATES,
    Column("failures", "failures"),
    Column("gap_percent_mean", "gap mean", "%"),
    Column("gap_percent_max", "gap max", "%"),
    *_FREQUENCY,
)
VIOLATIONS = (
    *_HEAD,
    *(Column(f"freq_violation_hz_{part}", f"frequency {heading}", "Hz") for part, heading in _SPREAD),
    Column("ramp_violation_mean", "ramp mean", "pu"),
    Column("ramp_violation_max", "ramp max"),
    Column("bound_violation_mean", "bounds mean", "pu"),
    Column("bound_violation_max", "bounds max"),
    Column("initial_violation_mean", "initial mean", "pu"),
    Column("initial_violation_max", "initial max"),
)
PROVENANCE = (
    *_HEAD,
    Column("rows", "rows"),
    Column("code", "code"),
    Column("score_code", "code of the scores"),
    Column("timed_code", "code of the times"),
    Column("model", "Koopman model"),
    Column("policy", "policy"),
    Column("solver_version", "solver"),
)
CLAIMS = (
    *_HEAD,
    Column("status", "status"),
    Column("meaning", "which means"),
    Column("rows", "rows"),
    Column("feasible", "feasible"),
    Column("feasible_strict", "strictly"),
    Column("infeasible", "infeasible"),
    Column("not_scored", "not scored"),
)
_PARTS = (("solve_s", "solve"), ("setup_s", "set-up"), ("build_s", "build"))
_QUARTILES = tuple(
    Column(f"{name}{part}", f"{heading}{mark}")
    for name, heading in _PARTS
    for part, mark in (("_q1", " 25 %"), ("", " median"), ("_q3", " 75 %"))
)
TIMING = (
    *_HEAD,
    Column("instances", "instances"),
    Column("repeats", "repeats"),
    *_QUARTILES,
    Column("first_build_s", "first build"),
    Column("first_setup_s", "first set-up"),
    Column("failures", "failures"),
    Column("peak_memory_mib", "peak memory", "MiB"),
    Column("load_average", "load"),
    Column("date", "date"),
    Column("error", "error"),
)
FRONT_TIMING = tuple(
    column
    for column in TIMING
    if column.name.startswith("solve_s")
    or column.name in ("regime", "title", "instances", "repeats", "setup_s", "build_s", "peak_memory_mib")
)
LOADED_TIMES = (
    *_HEAD,
    Column("n", "n"),
    Column("workers", "workers"),
    *_QUARTILES,
    Column("solve_s_shifted_geometric_mean", "solve, shifted geometric mean"),
)
WORST = (
    *_HEAD,
    Column("worst_by", "by"),
    Column("instance", "instance"),
    Column("gap_percent", "gap", "%"),
    Column("freq_violation_hz", "frequency", "Hz"),
    Column("ramp_violation", "ramp", "pu"),
    Column("bound_violation", "bounds", "pu"),
    Column("initial_violation", "initial", "pu"),
    Column("broken", "limit broken"),
    Column("excess", "× tolerance"),
)
STARTS = (
    Column("regime", "Regime"),
    Column("start", "starting point"),
    Column("n", "n"),
    Column("same", "the same optimum"),
    Column("lowest_percent", "lowest change", "%"),
    Column("highest_percent", "highest change", "%"),
    Column("iterations", "iterations, median"),
    Column("iterations_cold", "of the cold start"),
)
TRAINING = (
    Column("policy", "Policy"),
    Column("seconds", "seconds"),
    Column("epochs", "epochs"),
    Column("instances", "instances"),
    Column("held_out", "held out"),
    Column("held_out_loss", "held-out loss", form=".6g"),
    Column("training_loss", "training loss", form=".6g"),
    Column("parameters", "parameters"),
    Column("model", "Koopman model"),
    Column("seed", "seed"),
    Column("device", "device"),
    Column("torch", "torch"),
    Column("code", "code"),
    Column("problem", "problem"),
)
MODELS = (
    Column("regime", "Regime"),
    Column("title", "Method"),
    Column("model", "Koopman model"),
    Column("n", "n"),
    Column("failures", "failures"),
    *(Column(f"gap_percent_{part}", f"gap {heading}", "%") for part, heading in _SPREAD),
    *_FREQUENCY,
)
ABLATION = (
    Column("regime", "Regime"),
    Column("change", "what differs"),
    Column("n", "n"),
    *(Column(f"gap_percent_{part}", f"gap {heading}", "%") for part, heading in _SPREAD if part != "median"),
    *_FREQUENCY,
    Column("seconds", "training", "s"),
    Column("epochs", "epochs"),
    Column("steps", "steps"),
    Column("instances", "instances"),
    Column("parameters", "parameters"),
)
CERTIFICATE = (
    *_HEAD,
    Column("count", "instances"),
    Column("successes", "successes"),
    Column("meets_limits", "meet every limit"),
    Column("near_reference", "within the gap"),
    Column("clopper_pearson", "Clopper–Pearson", form=".2%"),
    Column("hoeffding", "Hoeffding", form=".2%"),
    Column("tolerance_hz", "tolerance", "Hz"),
    Column("tolerance_pu", "tolerance", "pu"),
    Column("gap_percent", "gap", "%"),
    Column("reference", "gap over"),
    Column("delta", "δ"),
    Column("seed", "master seed"),
    Column("artifacts", "case, policy and models"),
    Column("host", "host"),
    Column("date", "date"),
)
#: What was certified, and how surely; the rest tells how.
FRONT_CERTIFICATE = CERTIFICATE[: [column.name for column in CERTIFICATE].index("tolerance_hz")]
