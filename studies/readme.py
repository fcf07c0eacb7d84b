"""Fill the tables of README.md from the reference runs: `python studies/readme.py`.

Each table stands between `<!-- NAME -->` and `<!-- end -->`, and is made of the rows of the reference runs,
`results/<case>-reference/`, in the tight regime TO unless a column says otherwise.
"""

import functools
import re
from pathlib import Path

import pandas as pd

from ded_bench.analysis.online_summary import practice_lines
from ded_bench.analysis.reference import result_lines
from ded_bench.analysis.summary import GROUP
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.scenario import QUALITIES
from ded_bench.report.sources import Sources, read_sources

REPOSITORY = Path(__file__).resolve().parents[1]
GRIDS = ("9bus", "two-area", "39bus", "68bus", "140bus")
ISLANDS = ("two-area-agc", "39bus-agc")
#: Heading and seconds of a time budget.
BUDGETS = {"1 ms": 1e-3, "10 ms": 1e-2, "1 s": 1.0, "offline": float("inf")}
#: A method is of use if it keeps every limit on so many instances.
KEPT = 0.95
#: Instances that a method must have been run on.
ENOUGH = 10


@functools.cache
def run(case: str) -> Sources:
    """The reference run of a grid."""
    folder = REPOSITORY / "results" / f"{case}-reference"
    return read_sources(Case.load(SHIPPED_CASES / case), folder)


def markdown(heads: list[str], rows: list[list[str]]) -> str:
    """A pipe table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def paper() -> str:
    """The paper's Tables V and VI side by side, each number of ours before the paper's."""
    sources = run("9bus")
    both = result_lines(sources.shown, sources.timing, sources.paper, sources.reference.method)
    both = both[both["paper_solve_s"].notna() & (both["settings"] == "default")]
    names = ("increase_percent", "solve_s", "freq_violation_hz", "ramp_violation")
    rows = [
        [line["regime"], line["title"], *(number(line[p + name]) for name in names for p in ("", "paper_"))]
        for _, line in both.iterrows()
    ]
    heads = [
        head
        for name in ("% over DED", "median time (s)", "frequency (Hz)", "ramp (pu)")
        for head in (name, "paper's")
    ]
    return markdown(["Regime", "Method", *heads], rows)


def methods() -> str:
    """Of each grid and time budget the cheapest method that keeps every limit on nearly all instances.

    Where set-up is a part of every answer, as the first of two steps of `ded-rti`, it counts.
    """
    rows = []
    for case in GRIDS:
        setup = run(case).timing.set_index(GROUP)["setup_s"].rename("setup_s")
        found = run(case).outcome.join(setup, on=GROUP)
        found["seconds"] += found["setup_s"].fillna(0.0)
        useful = found[(found["regime"] == "TO") & found["alone"]]
        useful = useful[(useful["correct_rate"] >= KEPT) & (useful["rows"] >= ENOUGH)]
        cells = []
        for seconds in BUDGETS.values():
            able = useful[useful["seconds"] <= seconds].sort_values(["gap_percent", "seconds"])
            best = able[:1].to_dict("records")
            cells += [f"{one['title']} ({one['gap_percent']:+.2g} %, {one['n']})" for one in best] or ["–"]
        rows.append([case, *cells])
    return markdown(["Grid", *BUDGETS], rows)


def practice() -> str:
    """Today's practice and other plans on islands, in the longest scenarios, loads as announced."""
    rows = []
    for case in ISLANDS:
        lines = practice_lines(run(case).practice)
        lines = lines[(lines["regime"] == "TO") & (lines["forecast"] == QUALITIES[0])]
        lines = lines[(lines["minutes"] == lines["minutes"].max()) & (lines["settings"] != "every=300")]
        for line in lines.sort_values("mean_peak_mhz", ascending=False).to_dict("records"):
            places = {"mean_peak_mhz": 0, "swing_peak_mhz": 1, "agc_travel_pu": 1, "cps1": 0}
            numbers = (f"{line[name]:.{digits}f}" for name, digits in places.items())
            scenarios = f"{line['n']} of {line['n'] + line['failures']}"
            cost = f"{line['over_practice_percent']:+.2f}"
            rows.append([case, line["title"], f"{line['period_s']:g}", scenarios, *numbers, cost])
    heads = ["Grid", "plans", "every (s)", "hours", "peak of the mean (mHz)", "largest swing (mHz)"]
    return markdown([*heads, "AGC travel (pu)", "CPS1 (%)", "cost over practice (%)"], rows)


def number(value: float) -> str:
    """Three digits; a dash for what is missing."""
    return "–" if pd.isna(value) else f"{value:.3g}"


def filled(text: str) -> str:
    """A page whose tables are made anew."""
    for make in (methods, practice, paper):
        marks = rf"(<!-- {make.__name__} -->\n).*?(<!-- end -->)"
        made = make()
        text, count = re.subn(marks, lambda m, made=made: f"{m[1]}{made}{m[2]}", text, flags=re.S)
        if count != 1:
            raise SystemExit(f"README.md: no place for the table {make.__name__}")
    return text


if __name__ == "__main__":
    page = REPOSITORY / "README.md"
    page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
