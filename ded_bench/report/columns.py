"""Every column that pages print, declared once: name, heading, unit, format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ded_bench.analysis.summary import HEAD


@dataclass(frozen=True)
class Column:
    """One column of a printed table.

    Attributes:
        name: in the frame and in the CSV file.
        text: what stands above it, without the unit.
        unit: printed after the text, in brackets.
        form: format of its floats.
    """

    name: str
    text: str
    unit: str = ""
    form: str = ".3g"

    @property
    def heading(self) -> str:
        """What stands above the column."""
        return f"{self.text} ({self.unit})" if self.unit else self.text

    def cell(self, value: Any) -> str:
        """The printed value; a missing number is a dash."""
        if pd.isna(value):
            return "–"
        if isinstance(value, float):
            return format(value, self.form).replace("%", " %")
        return str(value)


def tabulate(columns: Sequence[Column], lines: pd.DataFrame) -> pd.DataFrame:
    """What each line is about, then the columns; nothing else."""
    return lines[list(dict.fromkeys((*HEAD, *(column.name for column in columns))))]


REGIME, TITLE, CASE = Column("regime", "Regime"), Column("title", "Method"), Column("case", "Grid")
ROWS, N, FAILURES = Column("rows", "rows"), Column("n", "n"), Column("failures", "failures")
DATE, INSTANCES = Column("date", "date"), Column("instances", "instances")
_HEAD = (REGIME, TITLE)

#: The paper's tables, of `reference.result_lines`.
TABLE_V = (
    *_HEAD,
    Column("increase_percent", "% increase in obj. over DED"),
    Column("paper_increase_percent", "paper's %", form="g"),
    Column("solve_s", "Sol. time", "s"),
    Column("paper_solve_s", "paper's time", "s", "g"),
    N,
    FAILURES,
    Column("against_paper_increase", "increase against the paper"),
    Column("against_paper_time", "time against the paper"),
)
TABLE_VI = (
    *_HEAD,
    Column("freq_violation_hz", "freq. const. viol.", "Hz"),
    Column("paper_freq_violation_hz", "paper's", "Hz", "g"),
    Column("ramp_violation", "ramp const. viol.", "pu"),
    Column("paper_ramp_violation", "paper's", "pu", "g"),
    N,
    FAILURES,
    Column("against_paper_frequency", "frequency against the paper"),
    Column("against_paper_ramp", "ramp against the paper"),
)

#: What became of the rows of every line, of `summary.outcome`.
OUTCOME = (
    *_HEAD,
    Column("rows", "n"),
    Column("solved", "solved"),
    Column("feasible", "feasible"),
    Column("gap_percent", "mean gap", "%"),
    Column("n", "gaps"),
    Column("largest", "largest violation"),
    Column("seconds", "median time", "s"),
)
#: Beside it, of islands.
ISLAND = MEAN_PEAK, MEAN_RMS, SWING_PEAK, AGC_TRAVEL = (
    Column("mean_peak_mhz", "peak of the mean frequency", "mHz", ".2f"),
    Column("mean_rms_mhz", "its rms", "mHz", ".2f"),
    Column("swing_peak_mhz", "largest swing", "mHz", ".2f"),
    Column("agc_travel_pu", "AGC travel", "pu", ".2f"),
)
#: Of `summary.summary`, whose file has the spreads of violations, too.
DETAIL = (
    *(*_HEAD, ROWS, N, FAILURES, Column("unpaired", "without reference")),
    Column("gap_percent_mean", "mean"),
    Column("gap_percent_median", "median"),
    Column("gap_percent_p95", "95 %"),
    Column("gap_percent_max", "max"),
    Column("cost_ratio", "ratio of summed costs", form=".6f"),
    Column("success_rate", "success (claimed)", form=".1%"),
    Column("correct_rate", "feasible (verified)", form=".1%"),
    Column("strict_rate", "strictly feasible (verified)", form=".1%"),
)
#: Beside them, where full machine models or ANDES have judged schedules.
OTHER_RATES = (
    Column("validated_rate", "feasible (validated)", form=".1%"),
    Column("carried", "carried"),
    Column("confirmed_rate", "confirmed by ANDES", form=".1%"),
    Column("refereed", "answered"),
)
TIMING = (
    *(*_HEAD, INSTANCES, Column("repeats", "repeats")),
    Column("time_s_q1", "time 25 %"),
    Column("time_s", "time median"),
    Column("time_s_q3", "time 75 %"),
    Column("solve_s", "solve median"),
    Column("setup_s", "set-up median"),
    Column("build_s", "build median"),
    FAILURES,
    Column("peak_memory_mib", "peak memory", "MiB"),
    *(Column("load_average", "load"), DATE, Column("error", "error")),
)
TRAINING = (
    Column("name", "policy or model"),
    Column("seconds", "training", "s"),
    *(Column("epochs", "epochs"), INSTANCES, Column("trajectories", "trajectories")),
    Column("held_out", "held out"),
    Column("held_out_loss", "held-out loss", form=".6g"),
    Column("training_loss", "training loss", form=".6g"),
    *(Column("parameters", "parameters"), Column("model", "surrogate"), Column("seed", "seed")),
    *(Column("device", "device"), Column("problem", "problem")),
)
CERTIFICATE = (
    *_HEAD,
    Column("count", "instances"),
    Column("successes", "successes"),
    Column("meets_limits", "meet every limit"),
    Column("near_reference", "within the gap"),
    Column("clopper_pearson", "Clopper–Pearson", form=".2%"),
    Column("hoeffding", "Hoeffding", form=".2%"),
    DATE,
)

#: The closed loop: methods at their own latency.
ONLINE = (
    *_HEAD,
    Column("period_s", "every", "s", "g"),
    Column("latency_s", "latency", "s", ".2g"),
    N,
    FAILURES,
    Column("increase_percent_mean", "cost over hindsight", "%", ".4f"),
    Column("increase_percent_max", "largest", "%", ".4f"),
    Column("over_static_percent_mean", "over ED every second", "%", ".4f"),
    Column("max_excess_mhz_mean", "largest excess, mean", "mHz", ".4f"),
    Column("max_excess_mhz_max", "largest", "mHz", ".4f"),
    Column("static_excess_mhz_mean", "ED every second there, mean", "mHz", ".4f"),
    Column("unforeseen_mhz_mean", "moved by unforeseen loads, mean", "mHz", ".4f"),
    Column("share_outside", "time outside", form=".2%"),
    Column("slack_travel_pu", "slack travel", "pu", ".2f"),
    Column("late", "plans late", form=".1%"),
    Column("failed", "failed", form=".1%"),
    Column("infeasible", "infeasible", form=".1%"),
)
#: The closed loop of an island beside today's practice, of `online_summary.practice_lines`.
PRACTICE = (
    *_HEAD,
    Column("forecast", "forecast"),
    Column("minutes", "minutes", form="g"),
    Column("period_s", "plans every", "s", "g"),
    Column("latency_s", "latency", "s", ".2g"),
    *(MEAN_PEAK, Column("peak_ratio", "practice's over it", form=".2f"), MEAN_RMS, SWING_PEAK),
    *(AGC_TRAVEL, Column("travel_ratio", "practice's over it", form=".2f")),
    Column("cps1", "CPS1", "%", ".1f"),
    Column("over_practice_percent", "cost over practice", "%", ".3f"),
    Column("increase_percent", "cost over hindsight", "%", ".3f"),
    N,
    FAILURES,
)
#: Over several grids.
GRIDS = (
    CASE,
    Column("buses", "buses"),
    Column("generators", "generators"),
    Column("loads", "loads"),
    Column("tests", "test instances"),
    Column("judged", "instances with rows"),
    Column("modes_hz", "modes", "Hz"),
    Column("damping", "least damping", form=".1%"),
    Column("tight_hz", "deviation that the tightest regime allows", "Hz"),
    Column("knots", "knots"),
    Column("reference", "gaps are to"),
)
