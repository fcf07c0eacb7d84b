"""The figures drawn from a results folder; what cannot be drawn becomes a note, never an error."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ded_bench.analysis.summary import (
    GROUP,
    STUDY,
    groups,
    performance_profile,
    timed_rows,
    title,
    tradeoff,
)
from ded_bench.evaluate.ablation import main_rows
from ded_bench.files.errors import InputError
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.simulate import simulate
from ded_bench.problem.trajectory import Trajectory
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.report.figures import summaries
from ded_bench.report.figures.frequencies import frequency_figure, koopman_figure
from ded_bench.report.figures.histories import history_figure
from ded_bench.report.figures.plan import Plan, plan
from ded_bench.report.figures.schedules import Worst, schedule_figure, worst_figure
from ded_bench.report.figures.style import DPI, FEW, Shown, plain, save_figure
from ded_bench.report.figures.tradeoff import profile_figure, tradeoff_figure
from ded_bench.report.page import Block, Picture, Text
from ded_bench.report.sources import Sources
from ded_bench.results.rows import Key
from ded_bench.run.pool import Call, Workers
from ded_bench.surrogates.koopman import Koopman

#: Static dispatch is looked at this often, s.
MOVEMENT_S = 1.0
#: Worst instances are drawn for the page only, at a coarser resolution.
WORST_DPI = 110


@dataclass
class Gallery:
    """Pictures by topic, the trajectories that they show, and what could not be drawn."""

    sources: Sources
    trajectories: dict[Key, Trajectory] = field(default_factory=dict)
    pictures: dict[str, list[Picture]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    def add(
        self, topic: str, name: str, caption: str, figure: Callable[..., Figure], *arguments: Any
    ) -> Call:
        """Add a picture to a topic; returns the call that makes the figure and writes it."""
        formats, dpi = (("png",), WORST_DPI) if topic == "worst" else (("png", "pdf"), DPI)
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", name)
        stem = self.sources.results.folder / "figures" / name
        self.files += [stem.parent / f"{name}.{form}" for form in formats]
        picture = Picture(f"figures/{name}.png", caption, wide=topic == "worst")
        self.pictures.setdefault(topic, []).append(picture)
        return paint, (stem, formats, dpi, figure, arguments)

    def of(self, topic: str, otherwise: str = "") -> list[Block]:
        """The pictures of a topic, or a sentence if there are none."""
        return list(self.pictures.get(topic, [])) or [Text(otherwise)] * bool(otherwise)

    def has(self, key: Key) -> bool:
        """Whether a run can be drawn: its instance is known and its schedule is in the folder."""
        known = key.instance in self.sources.instances
        return known and self.sources.results.schedule_path(key).is_file()

    def movement(self, name: str) -> float:
        """How far the static dispatch of an instance moves its generators: mean share of their ranges."""
        case, instance = self.sources.case, self.sources.instances[name]
        load = instance.p_load(case, np.arange(0.0, instance.horizon_s, MOVEMENT_S))
        optimum = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), load)
        powers = np.vstack([instance.p_initial(case), optimum])
        return float(np.mean(np.ptp(powers, axis=0) / (case.p_max - case.p_min)))


def paint(
    stem: Path, formats: tuple[str, ...], dpi: int, figure: Callable[..., Figure], arguments: tuple[Any, ...]
) -> None:
    """Make a figure and write it; in whatever process this is called."""
    save_figure(figure(*arguments), stem, formats, dpi)


def draw(
    sources: Sources,
    pool: Workers | None = None,
    more: Sequence[Callable[[Gallery], Iterator[Call]]] = (),
) -> Gallery:
    """Draw every figure that there is data for into `<results>/figures`.

    Args:
        more: what yields further calls (see `sections.Section`).
        pool: processes that draw; this one does, if there are none.
    """
    gallery = Gallery(sources)
    frame = sources.judged[sources.judged["regime"].isin(list(sources.case.regimes))]
    chosen = plan(frame, sources.reference.run, gallery.has, gallery.movement)
    before = (
        _simulations(gallery, chosen),
        _draw_training(gallery),
        _draw_problem(gallery),
        _draw_tradeoff(gallery, frame),
        _draw_eigenvalues(gallery),
        *(calls(gallery) for calls in more),
    )
    for answer in _answers(pool, itertools.chain(*before)):
        if isinstance(answer, dict):
            gallery.trajectories |= answer
        elif isinstance(answer, str):
            gallery.notes.append(answer)
    after = (
        _draw_schedules(gallery, chosen),
        _draw_tight(gallery, chosen),
        _draw_models(gallery),
        _draw_worst(gallery, chosen),
    )
    for _ in _answers(pool, itertools.chain(*after)):
        pass
    if not any(chosen.representative.values()):
        gallery.notes.append("No schedule of a scored row is in the folder, so no trajectory is drawn.")
    return gallery


def _answers(pool: Workers | None, calls: Iterable[Call]) -> Iterator[object]:
    """Answers of calls as they come; an error is raised."""
    if pool is None:
        yield from (function(*arguments) for function, arguments in calls)
        return
    for _, answer in pool.imap(calls, itertools.repeat(None)):
        if isinstance(answer, Exception):
            raise answer
        yield answer


def _simulations(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    """What the figures show, simulated."""
    case, results = gallery.sources.case, gallery.sources.results
    for key in filter(gallery.has, chosen.keys):
        instance = gallery.sources.instances[key.instance]
        try:
            schedule = results.schedule(key, case, instance)
        except InputError as error:
            gallery.notes.append(f"Not drawn: {error}")
            continue
        yield simulated, (case, key, instance, schedule)


def simulated(case: Case, key: Key, instance: Instance, schedule: Schedule) -> dict[Key, Trajectory] | str:
    """The trajectory of a run, or a note why there is none; in whatever process this is called."""
    try:
        return {key: simulate(case, instance, schedule)}
    except SimulationError as error:
        return f"Not drawn, since the simulation failed: {error}"


def _shown(gallery: Gallery, keys: Iterable[Key]) -> list[Shown]:
    return [
        Shown(key.method, key.settings, gallery.trajectories[key])
        for key in keys
        if key in gallery.trajectories
    ]


def _few(case: Case) -> str:
    """What figures of many generators leave out."""
    if len(case.generators) <= FEW:
        return ""
    return (
        f" Of {len(case.generators)} generators and {len(case.loads)} loads, those that move most are shown."
    )


def _names(shown: list[Shown]) -> str:
    return " and ".join(title(s.method, s.settings) for s in reversed(shown))


def _draw_schedules(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    for regime, keys in chosen.representative.items():
        if shown := _shown(gallery, keys):
            caption = (
                f"{_names(shown)} on {keys[0].instance}, regime {regime}: generator powers with bounds, "
                "loads, slack power. Of the instances whose schedules are kept, the third with gaps nearest "
                "to the median was taken; of these, the one whose static dispatch moves the generators most."
                f"{_few(gallery.sources.case)}"
            )
            heading = f"{keys[0].instance}, {regime}"
            yield gallery.add(
                "paper", f"schedule_{regime}", caption, schedule_figure, gallery.sources.case, heading, shown
            )


def _draw_tight(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    """Frequencies and Koopman against swing, in the tightest regime that was run."""
    case = gallery.sources.case
    tight = sorted(case.regimes, key=lambda name: case.regimes[name].omega_hz)
    drawable = [r for r in tight if _shown(gallery, chosen.representative.get(r, []))]
    if not drawable:
        return
    regime = drawable[0]
    key = chosen.representative[regime][-1]
    shown = _shown(gallery, chosen.representative[regime])
    heading = f"{key.instance}, {regime}"
    caption = f"Generator frequencies under {_names(shown)} on {heading}; dotted: the bounds of the regime."
    yield gallery.add(
        "paper", f"frequencies_{regime}", caption, frequency_figure, case, regime, heading, shown
    )
    fitting = _fitting(gallery, key)
    if key in gallery.trajectories and fitting:
        model = next((m for m in fitting if m.kind == "koopman"), fitting[-1])
        run = gallery.trajectories[key]
        outputs = rollout(case, model, [gallery.sources.instances[key.instance]], [run])[:, 0]
        caption = (
            f"Koopman model ({model.kind}) against the swing equations under the schedule of "
            f"{title(key.method, key.settings)} on {heading}."
        )
        drawn = (case, regime, heading, run, outputs, model.kind)
        yield gallery.add("paper", f"koopman_{regime}", caption, koopman_figure, *drawn)


def _fitting(gallery: Gallery, key: Key) -> list[Koopman]:
    """The models made for the time step of a run."""
    return [
        m
        for m in gallery.sources.models
        if abs(m.dt_s - gallery.sources.instances[key.instance].dt_s) < 1e-12
    ]


def rollout(case: Case, model: Koopman, instances: list[Instance], runs: list[Trajectory]) -> Array:
    """A model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    inputs = np.stack([np.hstack([run.p_gen, run.p_load]) for run in runs], axis=1)
    psi = model.rollout(model.initial(Network(case), instances), inputs)
    return np.asarray(psi[..., : len(case.generators) + 1])


def _draw_eigenvalues(gallery: Gallery) -> Iterator[Call]:
    caption = "Eigenvalues of K as rates, against the physical modes at the nominal point (crosses)."
    drawn = (summaries.eigenvalue_figure, gallery.sources.case, gallery.sources.models)
    yield gallery.add("koopman", "koopman_eigenvalues", caption, *drawn)


def _draw_models(gallery: Gallery) -> Iterator[Call]:
    case = gallery.sources.case
    if not gallery.trajectories:
        return
    first = next(iter(gallery.trajectories))
    t = gallery.trajectories[first].t
    keys = [key for key, run in gallery.trajectories.items() if np.array_equal(run.t, t)]
    runs = [gallery.trajectories[key] for key in keys]
    truth = np.stack([np.column_stack([run.omega, run.p_slack]) for run in runs], axis=1)
    instances = [gallery.sources.instances[key.instance] for key in keys]
    errors = {m.kind: rollout(case, m, instances, runs) - truth for m in _fitting(gallery, first)}
    if errors:
        caption = (
            f"Error of Koopman rollouts against the swing equations over time, under {len(keys)} schedules: "
            "those of the paper's figures and the worst of each method."
        )
        yield gallery.add("koopman", "koopman_error", caption, summaries.rollout_figure, case, t, errors)


def _draw_worst(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    reference = gallery.sources.reference
    for (regime, method, settings), pairs in chosen.worst.items():
        is_reference = (method, settings) == reference.run
        columns = []
        for key, reason in pairs:
            if key in gallery.trajectories:
                other = Key(key.instance, regime, *reference.run)
                compared = [] if is_reference else _shown(gallery, [other])
                shown = Shown(method, settings, gallery.trajectories[key])
                columns.append(Worst(reason, shown, compared[0] if compared else None))
        if columns:
            heading = plain(f"{title(method, settings)}, {regime}")
            what = "violations" if is_reference else "gaps"
            dashed = "" if is_reference else f"dashed: {reference.title}; "
            caption = (
                f"{title(method, settings)}, {regime}: the instances with the largest {what} among those "
                f"whose schedules are in the folder; {dashed}dotted: bounds."
            )
            name = f"worst_{method}_{settings}_{regime}"
            drawn = (gallery.sources.case, regime, heading, columns)
            yield gallery.add("worst", name, caption, worst_figure, *drawn)


def _draw_tradeoff(gallery: Gallery, frame: pd.DataFrame) -> Iterator[Call]:
    frame = main_rows(frame)
    points = tradeoff(frame, gallery.sources.timing)
    reference = gallery.sources.reference.title
    papers = _papers_points(gallery.sources)
    if points["gap_percent"].notna().any():
        caption = (
            f"Mean gap to {reference} against time per schedule; words name settings other than the "
            "default. Hollow: some schedules are infeasible; * timed under parallel load, not by "
            "`ded-bench bench`. The vertical scale is linear within ±0.01 %."
        )
        caption += " Grey: the paper's numbers, from its machine and its instances." * bool(len(papers))
        yield gallery.add("tradeoff", "tradeoff", caption, tradeoff_figure, points, reference, papers)
    usual = frame[frame["settings"] == "default"]
    times = performance_profile(timed_rows(usual, gallery.sources.calls), "solve_s")
    objectives = performance_profile(usual, "objective")
    if len(times) or len(objectives):
        caption = (
            "Dolan–Moré performance profiles of the methods with default settings: share of the instances "
            "that a method was asked on which it is within a factor of the fastest (top; the instances and "
            "times of `ded-bench bench`) or within a percentage of the cheapest schedule (bottom). Only "
            "feasible schedules count"
        )
        caption += without_curve(usual, objectives)
        yield gallery.add("profile", "profile", caption, profile_figure, times, objectives)


def _papers_points(sources: Sources) -> pd.DataFrame:
    """The paper's gaps and times; that of its reference is zero."""
    rows = []
    if paper := sources.paper:
        for regime, methods in paper.regimes.items():
            for name, row in methods.items():
                rows.append((regime, paper.methods[name][0], name, row.increase_percent or 0.0, row.solve_s))
    return pd.DataFrame(rows, columns=["regime", "method", "name", "gap_percent", "seconds"])


def without_curve(frame: pd.DataFrame, profile: pd.DataFrame) -> str:
    """The end of the profiles' caption: methods that never gave a feasible schedule."""
    drawn = set(profile[GROUP].itertuples(index=False, name=None))
    absent = [
        f"{title(method, settings)} in {regime}"
        for regime, method, settings, _ in groups(frame)
        if (regime, method, settings) not in drawn
    ]
    return f"; {', '.join(absent)} had none and no curve." if absent else "."


def _draw_training(gallery: Gallery) -> Iterator[Call]:
    """One figure per method, and one of its other settings; a study's trainings are left to its table."""
    curves: dict[tuple[str, str], dict[str, pd.DataFrame]] = {}
    for history in gallery.sources.histories:
        if f"-{STUDY}" not in history.name:
            usual = history.name.endswith(tuple(f"-{regime}" for regime in gallery.sources.case.regimes))
            kind = "" if usual else "_settings"
            curves.setdefault((history.method, kind), {})[history.name] = history.table
    for (method, kind), tables in curves.items():
        trained = title(method) if method else "unknown methods"
        trained += ", other settings," * bool(kind)
        caption = (
            f"Loss of each policy of {trained} over its training time; "
            "right: the terms of the loss, without those that hardly change."
        )
        name = f"training_{method or 'other'}{kind}"
        yield gallery.add(f"training{kind}", name, caption, history_figure, tables)


def _draw_problem(gallery: Gallery) -> Iterator[Call]:
    case, instances = gallery.sources.case, list(gallery.sources.instances.values())
    if not instances:
        return
    ranges = "the ranges of the sampler (dotted; the paper's Table III)"
    caption = f"Sampled parameters of the {len(instances)} instances against {ranges}."
    yield gallery.add("problem", "parameters", caption, summaries.parameters_figure, case, instances)
    caption = f"Load forecasts of a sample of test instances.{_few(case)}"
    yield gallery.add("problem", "forecasts", caption, summaries.forecasts_figure, case, instances)
