"""What latency costs, from a results folder whose methods were swept over latencies (`make online`).

    python studies/latency.py --results results/9bus

One line per regime, method and latency, a column of cost and of excess for each kind of forecast; `present`
are plans from the present state. Means over the same scenarios.
"""

import argparse
from pathlib import Path

import pandas as pd

from ded_bench.analysis.summary import GROUP, named
from ded_bench.results.online_results import ONLINE, OnlineResults

#: A method with so many latencies at announced forecasts was swept.
SWEPT = 3
MEASURES = {"increase_percent": 1.0, "max_excess_hz": 1e3}


def swept(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows of methods that were swept, of scenarios that were operated in all of their lines.

    What was operated on fewer than half as many scenarios as another latency that was asked for is left out.
    Of several periods between plans, the one with most latencies counts.
    """
    parts = [frame[:0]]
    for _, every in frame[frame["warm"].astype(bool)].groupby(GROUP, sort=False):
        period = every.groupby("period_s")["latency_s"].nunique().idxmax()
        rows = every[every["period_s"] == period]
        if rows.loc[rows["kind"] == "announced", "latency_s"].nunique() < SWEPT:
            continue
        counts = rows.groupby(["latency_s", "kind"])["scenario"].transform("nunique")
        asked = rows["latency_source"] == "given"
        kept = rows[2 * counts >= (counts[asked] if asked.any() else counts).max()]
        lines = kept.groupby(["latency_s", "kind"]).ngroups
        once = kept.drop_duplicates(["latency_s", "kind", "scenario"])["scenario"].value_counts()
        parts.append(kept[kept["scenario"].map(once == lines).astype(bool)])
    return pd.concat(parts)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, required=True)
    frame = named(ONLINE.frame(OnlineResults(parser.parse_args().results).table.rows.values()))
    predicted, announced = frame["predicted"].astype(bool), frame["forecast"] == "announced"
    frame = frame.assign(kind=frame["forecast"].where(predicted, "present"))[predicted | announced]
    rows = swept(frame.dropna(subset=["objective"]))
    values = rows.assign(**{name: scale * rows[name] for name, scale in MEASURES.items()})
    wide = values.pivot_table(index=[*GROUP, "latency_s"], columns="kind", values=list(MEASURES), sort=False)
    print(wide.sort_index().to_string(float_format="%.4f"))


if __name__ == "__main__":
    main()
