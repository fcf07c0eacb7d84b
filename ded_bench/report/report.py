"""The report of a results folder: its rows → tables as CSV, figures as PNG, one page as Markdown and HTML.

First come findings, the trade-off and the methods that were run; then the paper's tables, and the schedules;
then methods in detail, times, trainings, the closed loop, provenance. Every section is a function of what was
read, and of pictures by topic (see FIGURES).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from ded_bench.analysis.online_summary import own_latency, practice_lines
from ded_bench.analysis.reference import Paper, result_lines
from ded_bench.analysis.summary import findings, groups, own_first, records, summary, title, titled
from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import METHODS
from ded_bench.plants.score import FEASIBLE_HZ, FEASIBLE_PU, ISLAND_HZ, STRICT_HZ, STRICT_PU
from ded_bench.problem.case import Case
from ded_bench.report import columns
from ded_bench.report.figures import panels, tradeoff
from ded_bench.report.page import Block, PageTable, Picture, bullets, folded, usual_first, write_page
from ded_bench.report.sources import Sources, read_sources, trainings
from ded_bench.results.timing import model_name
from ded_bench.run.environment import environment, now

#: The topic under which a section shows a figure, and what draws and saves it.
FIGURES: Mapping[str, Callable[[Sources], Iterator[Picture]]] = {
    "tradeoff": tradeoff.draw,
    "schedules": panels.draw_schedules,
    "online": panels.draw_scenario,
}
#: How the tables are to be read.
EXPLANATION = (
    "**Objective and violations are re-simulated**: every schedule is simulated on the plant of "
    "the case, whatever its solver claimed. The increase is the mean of the signed 100·(J / J_ref − 1) over "
    "the `n` instances where both have a score; violations are means of each instance's maximum over time "
    "and generators.",
    "**Failures** are rows without a schedule or a score. They enter no mean, and a method with failures is "
    "never ahead of the paper.",
    "**Against the paper**: ahead if our number is lower than the paper's, behind if it is higher. The "
    "paper's times are from another machine, and its instances are other draws from the same ranges.",
    "**DED's optima are local**: the problem is not convex, so a method may come out below zero; DED also "
    "breaks the tight frequency bound slightly, since backward Euler is not exact.",
    "**Success** is what a method claims, **feasible** what the scorer found: frequency within "
    f"{FEASIBLE_HZ:g} Hz (islands: {ISLAND_HZ:g} Hz), power limits within {FEASIBLE_PU:g} pu (strictly: "
    f"{STRICT_HZ:g} Hz and {STRICT_PU:g} pu).",
    "**The ratio of summed costs** is ΣJ / ΣJ_ref over the same `n` instances: costly ones weigh more in it.",
    "**Names** in brackets are options and surrogates that differ from a method's usual ones.",
)
#: How the closed loop is to be read.
CLOSED_LOOP = (
    "Every scenario is operated for its whole length: every period, or when the last plan is due if that is "
    "later, a method gets the measured state and a forecast, and its plan takes effect after its latency, "
    "the median time of `timing.csv`. Cost is that of the true trajectory over the optimum of the "
    "whole scenario with true loads (hindsight), which keeps the bound: who exceeds it may cost less.",
    "Largest excess: of any generator at any time over the bound, the mean over scenarios. Time outside: "
    "share of grid points with some generator more than 1e-6 Hz beyond the bound. Slack travel: Σ|ΔP_s|.",
    "Moved by unforeseen loads: how far loads that no plan in force knew of move the frequency of some "
    "generator, the largest of a scenario. A plan can have room for twice the bound at most.",
    "Late: no answer within the limit of the clock. Failed: an answer without a schedule; the last plan goes "
    "on. Infeasible: by the method's own word no schedule meets every limit, and the one of least excess is "
    "followed.",
)
OTHERS = (
    "Validated on full machine models with exciters, stabilisers and governors, losses and loads of constant "
    "power; confirmed by ANDES on the same: shares of those schedules that these can carry to the "
    "end, of all that were kept"
)


def write_report(case: Case, folder: Path, tell: Callable[[str], None] = lambda _: None) -> list[Path]:
    """Write tables, figures and the report of a results folder into it; nothing is solved.

    Whatever is missing (times, policies, a method) is said in the report.

    Args:
        case: whose rows count.
        folder: the results folder.
        tell: called with each finding, a sentence.

    Returns:
        The files written.

    Raises:
        InputError: the folder holds no results of this case, or a table in it is wrong.
    """
    sources = read_sources(case, folder)
    for sentence in findings(sources.outcome, sources.reference.title):
        tell(sentence.replace("**", ""))
    pictures = {topic: list(draw(sources)) for topic, draw in FIGURES.items()}
    sections = opening, each_method, solve_times, trained, closed_loop, made_by
    return write_page([b for section in sections for b in section(sources, pictures)], folder, "report")


def opening(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """The first screen, and all methods folded away."""
    case, reference = sources.case, sources.reference
    regimes = "; ".join(f"{name} {limit.sentence}" for name, limit in case.regimes.items())
    slack = "on an island, all scheduled" if case.slack is None else "besides the slack bus"
    what = (
        f"{case.n_bus} buses, {len(case.generators)} generators {slack}, "
        f"{len(case.loads)} loads; {rows_caption(sources)}. Regimes: {regimes}. "
        f"Every objective and violation is re-simulated on {idealisation(case)}; "
        f"gaps are to {reference.title}."
    )
    papers = _paper_tables(sources, sources.paper) if sources.paper else []
    found = own_first(sources.outcome)
    said = [*findings(found, reference.title), *_against_paper([table.frame for table in papers])]
    said += [f"**Certificate** of {title(c.method, c.settings)}: {c.sentence}" for c in sources.certificates]
    usual = (found["settings"] == DEFAULT) | ~found["method"].isin(list(METHODS))
    printed = columns.OUTCOME if case.slack else (*columns.OUTCOME, *columns.ISLAND)
    notes = (*_problems(sources), *sources.notes)
    return [
        f"# Dynamics-aware economic dispatch on {case.id}",
        what,
        *(f"> **Note:** {text}" for text in alarms(sources)),
        bullets(said),
        *pictures["tradeoff"],
        *usual_first(PageTable(found, printed, _methods_caption(sources), "methods"), usual),
        *_in_operation(sources),
        *(pictures["online"] if case.slack is None else ()),
        *(block for table in papers for block in _beside_paper(table)),
        *folded("What is missing or mixed", *[bullets(notes)] * bool(notes)),
        *folded("How to read the tables", bullets(EXPLANATION)),
        "## Schedules and frequencies",
        *(p for topic, drawn in pictures.items() if topic not in ("tradeoff", "online") for p in drawn),
    ]


def idealisation(case: Case) -> str:
    """What a case's own plant is, in words."""
    if case.plant_name == "lossless":
        return "a lossless network with classical machines and an infinite slack"
    what = "full machine models" if case.plant_name == "detailed" else f"the plant {case.plant_name}"
    return f"{what}, {'an island' if case.slack is None else 'with an infinite slack'}"


def _in_operation(sources: Sources) -> Iterator[PageTable]:
    """What plans do to an island in operation, beside today's practice, where rows have it."""
    if sources.case.slack is None and len(sources.practice):
        lines = practice_lines(sources.practice).sort_values(
            ["regime", "forecast", "minutes"], kind="stable", ascending=[True, False, True]
        )
        caption = (
            "In operation beside today's practice (ED every 60 s, AGC for the rest): means over n scenarios; "
            "ratios and costs beside practice over those where it was operated, too"
        )
        yield PageTable(columns.tabulate(columns.PRACTICE, lines), columns.PRACTICE, caption, "practice")


def _methods_caption(sources: Sources) -> str:
    timing, timed = sources.timing, "of this run under load: `ded-bench bench` takes better ones"
    if len(timing):
        counts = "/".join(map(str, sorted(set(timing["instances"]))))
        timed = f"medians, alone on {timing['host'].iloc[-1]} (instances: {counts})"
        loaded = sources.outcome.loc[~sources.outcome["alone"], "title"].unique()
        timed += f", but of {', '.join(loaded)} under load" if len(loaded) else ""
    return f"The methods that were run ({rows_caption(sources)}; times: {timed})"


def _paper_tables(sources: Sources, paper: Paper) -> list[PageTable]:
    """Tables V and VI; violations are means over all that has a score."""
    lines = result_lines(sources.shown, sources.timing, paper, sources.reference.method)
    scored = lines.assign(n=lines["rows"] - lines["failures"])
    rows = rows_caption(sources)
    five = f"Table V: Average Solution Time and Change in Objective ({rows})"
    six = f"Table VI: Average maximum constraint violation ({rows})"
    return [
        PageTable(columns.tabulate(columns.TABLE_V, lines), columns.TABLE_V, five, "table_v"),
        PageTable(columns.tabulate(columns.TABLE_VI, scored), columns.TABLE_VI, six, "table_vi"),
    ]


def _beside_paper(table: PageTable) -> list[Block]:
    """A table of the paper's: its rows that were run in sight; folded away where it has none of them."""
    papers = table.frame.filter(regex="^paper_").notna().any(axis=1) & (table.frame["n"] > 0)
    return usual_first(table, papers) if papers.any() else folded(table.caption, table)


def _against_paper(tables: Sequence[pd.DataFrame]) -> Iterator[str]:
    """How many cells of the paper's tables are ahead of its numbers."""
    if not tables:
        return
    marks = pd.concat([table.filter(like="against_paper") for table in tables], axis=1)
    counts = marks.stack().value_counts()
    if total := int(counts.drop("", errors="ignore").sum()):
        rows = records(tables[0][(marks == "behind").any(axis=1)])
        behind = dict.fromkeys(f"{row['title']} {row['regime']}" for row in rows)
        yield (
            f"**Against the paper:** {counts.get('ahead', 0)} of {total} cells of both tables are ahead of "
            f"its numbers, {counts.get('equal', 0)} equal; behind: {', '.join(behind) or 'none'}."
        )


def rows_caption(sources: Sources) -> str:
    """Which rows the tables are about, in words."""
    frame = sources.judged
    if not len(frame):
        return "no rows yet"
    instances = frame["instance"].nunique()
    if (frame["split"] == "test").all():
        left = len(sources.rows) - len(frame)
        return f"{instances} test instances" + (f"; {left} other rows left out" if left else "")
    return f"all {instances} instances, none of them of the test split"


def alarms(sources: Sources) -> list[str]:
    """Why a report has nothing to compare; empty if it has."""
    case, judged, reference = sources.case, sources.judged, sources.reference
    method = reference.method or reference.wanted
    solve = f"ded-bench solve --case {case.place} --method {method} --regime {','.join(case.regimes)}"
    if not len(sources.rows):
        return [f"No rows yet: `{solve}` makes some."]
    if not len(judged):
        return ["All rows are of validation instances, which serve choices: no table is about them."]
    if not judged["objective"].notna().any():
        return ["No row has a score: every method failed, or nothing was scored yet (see the column error)."]
    if judged["gap_percent"].notna().any():
        missing = f"Nobody ran {title(method)}: gaps are to the best feasible schedule of each instance"
        return [] if reference.method else [f"{missing}. `{solve}` makes rows of the usual reference."]
    return [f"No gap can be given: no row keeps every limit, and nobody ran {title(method)}. `{solve}` does."]


def _problems(sources: Sources) -> Iterator[str]:
    """Rows that are not of one problem, of this case or of today's methods; objectives from elsewhere."""
    rows, judged = sources.rows, sources.judged
    versions = set(rows["problems_version"])
    named = ", ".join(version or "(none given)" for version in sorted(versions))
    if len(versions) > 1:
        yield f"Rows of different problem versions are not comparable: {named}."
    elif sources.problems_version and versions - {sources.problems_version}:
        yield f"Rows are of problem version {named}, but the files are {sources.problems_version}."
    if strange := sorted(set(judged["regime"]) - set(sources.case.regimes)):
        yield f"Rows of regimes that the case does not know are not drawn: {', '.join(strange)}."
    reference = sources.reference
    if reference.shipped:
        yield (
            f"{reference.shipped} objectives of {reference.title} are those of the reference run that ships "
            "with the case, since it was not run on these instances here."
        )
    made = judged[judged["objective"].notna()]
    today = {str(name): METHODS[str(name)].version for name in set(made["method"]) & set(METHODS)}
    by_method = zip(made["method"], made["method_version"], strict=True)
    if old := sorted({method for method, version in by_method if version != today.get(method, version)}):
        names = ", ".join(title(method) for method in old)
        yield f"Rows come from other versions of their methods than those installed here: {names}."


def each_method(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away."""
    overview = summary(sources.judged)
    usual = overview["settings"] == DEFAULT
    others = columns.OTHER_RATES if overview[["validated_asked", "confirmed_asked"]].to_numpy().any() else ()
    for name, judge in (("carried", "validated"), ("refereed", "confirmed")) if others else ():
        counts = overview[f"{judge}_n"].astype(str) + " of " + overview[f"{judge}_asked"].astype(str)
        overview = overview.assign(**{name: counts})
    caption = (
        f"Gap to {sources.reference.title}, % ({rows_caption(sources)}); claimed, and verified on "
        f"{idealisation(sources.case)}: shares of all rows" + f". {OTHERS}" * bool(others)
    )
    table = PageTable(overview, (*columns.DETAIL, *others), caption, "summary")
    return ["## Each method in detail", *usual_first(table, usual)]


def solve_times(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Default settings in sight, all others folded away."""
    made: list[Block] = ["No method was timed alone yet; run `ded-bench bench`."]
    if len(sources.timing):
        timing = titled(pd.concat([rows for *_, rows in groups(sources.timing)]))
        caption = f"Alone on {timing['host'].iloc[-1]}, one thread, warmed up: median and quartiles, s"
        made = usual_first(PageTable(timing, columns.TIMING, caption), timing["settings"] == DEFAULT)
    return ["## Times", *made]


def trained(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """How policies and models were trained, and certificates."""
    folders = sources.results.paths.policies, sources.results.paths.koopman
    frame = trainings(path for folder in folders for path in sorted(folder.glob("*.safetensors")))
    made: list[Block] = ["## Training"]
    if len(frame):
        filled = frame.map(lambda value: value not in ("", None)).any()
        known = tuple(column for column in columns.TRAINING if filled[column.name])
        made.append(PageTable(frame, known, "", "training"))
    else:
        made.append("The folder holds no policy or model; `ded-bench train-dpc` and `train-ko` make some.")
    made.append("## Certificate")
    if not sources.certificates:
        return [*made, "No certificate was made for these results; `ded-bench certify` makes one."]
    told = [c.model_dump() | {"model": model_name(c.model)} for c in sources.certificates]
    caption = "All that makes them up stands in certificate.json"
    return [*made, PageTable(titled(pd.DataFrame(told)), columns.CERTIFICATE, caption)]


def closed_loop(sources: Sources, pictures: Mapping[str, list[Picture]]) -> list[Block]:
    """Nothing without rows."""
    own = own_latency(sources.online)
    if not len(own):
        return []
    caption = "Methods in the closed loop at their own latency, forecasts as announced"
    explained = folded("How to read the closed loop", bullets(CLOSED_LOOP))
    table = PageTable(own, columns.ONLINE, caption, "online_methods")
    pictured = pictures["online"] if sources.case.slack else ()  # of an island it stands beside practice
    return ["## The closed loop", table, *explained, *pictured]


def made_by(sources: Sources, _: Mapping[str, list[Picture]]) -> list[Block]:
    """Machines, versions, models and policies."""
    rows = sources.rows

    def distinct(name: str) -> str:
        return "; ".join(sorted({str(value) for value in rows[name] if value})) or "–"

    masters = sorted({seed.split(" ")[0] for seed in rows["seed"] if seed})
    counts = rows["split"].replace({"train": "training", "none": "other"}).value_counts()
    dates = sorted(date for date in rows["date"] if date) or ["–"]
    items = (
        f"Rows: {', '.join(f'{count} on {name} instances' for name, count in counts.items()) or 'none'}.",
        f"Rows made: {dates[0]} to {dates[-1]}; problem version: {distinct('problems_version')}.",
        f"Hosts of the rows: {distinct('host')}; parallel workers: {distinct('workers')}, one thread each.",
        f"Versions of ded-bench: {distinct('version')}; commits: {distinct('commit')}; "
        f"solvers: {distinct('solver_version')}.",
        f"Surrogates and policies: {distinct('made_with')}.",
        f"Master seeds of the instances: {', '.join(masters) or '–'}.",
        f"This report was written {now()} with: {environment()}.",
    )
    return ["## What made the rows", bullets(items)]
