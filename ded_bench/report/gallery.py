"""The figures drawn from a results folder; what is missing becomes a note, never an error."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ded_bench.evaluate.ablation import main_rows
from ded_bench.evaluate.summary import (
    GROUP,
    REFERENCE,
    STUDY,
    groups,
    performance_profile,
    title,
    tradeoff,
)
from ded_bench.files.errors import InputError
from ded_bench.koopman.linear import linear_model
from ded_bench.koopman.model import Koopman
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import load_split
from ded_bench.problem.schedule import Schedule
from ded_bench.report.figures import summaries
from ded_bench.report.figures.frequencies import frequency_figure, koopman_figure
from ded_bench.report.figures.plan import Plan, plan
from ded_bench.report.figures.schedules import Worst, schedule_figure, worst_figure
from ded_bench.report.figures.style import DPI, Shown, plain, save_figure
from ded_bench.report.page import Block, Picture, Text
from ded_bench.run.pool import Call, Workers
from ded_bench.run.results import Key, Results
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import SimulationError, Trajectory, simulate

#: Worst instances are drawn for the page only, at a coarser resolution.
WORST_DPI = 110


@dataclass
class Gallery:
    """Pictures by topic, what they are drawn from, and what is missing."""

    case: Case
    results: Results
    instances: dict[str, Instance] = field(default_factory=dict)
    schedules: dict[Key, Schedule] = field(default_factory=dict)
    trajectories: dict[Key, Trajectory] = field(default_factory=dict)
    pictures: dict[str, list[Picture]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)

    def add(
        self, topic: str, name: str, caption: str, figure: Callable[..., Figure], *arguments: Any
    ) -> Call:
        """Hang a picture under a topic; returns the call that makes the figure and writes it."""
        formats, dpi = (("png",), WORST_DPI) if topic == "worst" else (("png", "pdf"), DPI)
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", name)
        stem = self.results.folder / "figures" / name
        self.files += [stem.parent / f"{name}.{form}" for form in formats]
        self.pictures.setdefault(topic, []).append(Picture(f"figures/{name}.png", caption))
        return paint, (stem, formats, dpi, figure, arguments)

    def of(self, topic: str, otherwise: str = "") -> list[Block]:
        """The pictures of a topic, or a sentence if there are none."""
        return list(self.pictures.get(topic, [])) or [Text(otherwise)] * bool(otherwise)

    def has(self, key: Key) -> bool:
        """Whether a run can be drawn: its instance is known and its schedule is in the folder."""
        return key.instance in self.instances and self.results.schedule_path(key).is_file()

    def posed(self, keys: Iterable[Key]) -> list[Instance]:
        """The instances of runs."""
        return [self.instances[key.instance] for key in keys]


def paint(
    stem: Path, formats: tuple[str, ...], dpi: int, figure: Callable[..., Figure], arguments: tuple[Any, ...]
) -> None:
    """Make a figure and write it; in whatever process this is called."""
    save_figure(figure(*arguments), stem, formats, dpi)


def draw(
    case: Case,
    results: Results,
    frame: pd.DataFrame,
    timing: pd.DataFrame,
    problems: Path,
    pool: Workers | None = None,
) -> Gallery:
    """Draw every figure that the folder has data for into `<results>/figures`.

    Args:
        frame: the rows that the report is about.
        timing: the summary of the timing table.
        problems: folder of the benchmark's instances.
        pool: processes that draw; this one does, if there are none.
    """
    gallery = Gallery(case, results)
    frame = frame[frame["regime"].isin(list(case.regimes))]
    _read_instances(gallery, problems)
    chosen = plan(frame, gallery.has)
    models = _models(gallery)
    before = (
        _draw_training(gallery),  # at once, while this process reads what the longest calls need
        _simulations(gallery, chosen),
        _draw_problem(gallery),
        _draw_tradeoff(gallery, frame, timing),
        _draw_eigenvalues(gallery, models),
    )
    for answer in _answers(pool, itertools.chain(*before)):
        _keep(gallery, answer)
    after = (
        _draw_schedules(gallery, chosen),
        _draw_tight(gallery, chosen, models),
        _draw_models(gallery, models),
        _draw_worst(gallery, chosen),
    )
    list(_answers(pool, itertools.chain(*after)))
    if not any(chosen.representative.values()):
        gallery.notes.append("No schedule of a scored row is in the folder, so no trajectory is drawn.")
    return gallery


def _read_instances(gallery: Gallery, problems: Path) -> None:
    """The instances of the benchmark, test instances first."""
    try:
        split = load_split(problems)
        for name in (*split.test, *split.train):
            path = problems / "instances" / f"{name}.json"
            gallery.instances[name] = Instance.load_file(path, gallery.case)[0]
    except InputError as error:
        gallery.notes.append(f"Some instances cannot be drawn: {error}")


def _read_schedules(gallery: Gallery, chosen: Plan) -> None:
    for key in filter(gallery.has, chosen.keys):
        instance = gallery.instances[key.instance]
        try:
            gallery.schedules[key] = gallery.results.schedule(key, gallery.case, instance)
        except InputError as error:
            gallery.notes.append(f"Not drawn: {error}")


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
    _read_schedules(gallery, chosen)
    for key in filter(gallery.schedules.__contains__, chosen.shown):
        yield simulated, (gallery.case, key, gallery.instances[key.instance], gallery.schedules[key])


def simulated(case: Case, key: Key, instance: Instance, schedule: Schedule) -> dict[Key, Trajectory] | str:
    """The trajectory of a run, or a note why there is none; in whatever process this is called."""
    try:
        return {key: simulate(case, instance, schedule)}
    except SimulationError as error:
        return f"Not drawn, since the simulation failed: {error}"


def _keep(gallery: Gallery, answer: object) -> None:
    """Keep what a simulation answers; painters answer nothing."""
    if isinstance(answer, dict):
        gallery.trajectories |= answer
    elif isinstance(answer, str):
        gallery.notes.append(answer)


def _models(gallery: Gallery) -> list[Koopman]:
    """The linearisation, and every model that the folder holds."""
    models = [linear_model(gallery.case)]
    for path in sorted((gallery.results.folder / "koopman").glob("*.safetensors")):
        try:
            models.append(Koopman.load(path, gallery.case))
        except InputError as error:
            gallery.notes.append(f"Left out: {error}")
    if len(models) == 1:
        gallery.notes.append(
            "The folder holds no Koopman model, so the linearisation stands in its figures; "
            "`ded-bench train-ko` identifies one."
        )
    return models


def _shown(gallery: Gallery, keys: Iterable[Key]) -> list[Shown]:
    return [
        Shown(key.method, key.settings, gallery.trajectories[key])
        for key in keys
        if key in gallery.trajectories
    ]


def _names(shown: list[Shown]) -> str:
    return " and ".join(title(s.method, s.settings) for s in reversed(shown))


def _draw_schedules(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    for regime, keys in chosen.representative.items():
        if shown := _shown(gallery, keys):
            caption = (
                f"{_names(shown)} on {keys[0].instance}, regime {regime} (the instance with the median gap): "
                "generator powers with their bounds, loads, slack power."
            )
            heading = f"{keys[0].instance}, {regime}"
            yield gallery.add(
                "paper", f"schedule_{regime}", caption, schedule_figure, gallery.case, heading, shown
            )


def _draw_tight(gallery: Gallery, chosen: Plan, models: list[Koopman]) -> Iterator[Call]:
    """Frequencies and Koopman against swing, in the tightest regime that was run."""
    case = gallery.case
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
    fitting = _fitting(gallery, models, key)
    if key in gallery.trajectories and fitting:
        model = next((m for m in fitting if m.kind == "koopman"), fitting[-1])
        run = gallery.trajectories[key]
        outputs = rollout(case, model, [gallery.instances[key.instance]], [run])[:, 0]
        caption = (
            f"Koopman model ({model.kind}) against the swing equations under the schedule of "
            f"{title(key.method, key.settings)} on {heading}."
        )
        drawn = (case, regime, heading, run, outputs, model.kind)
        yield gallery.add("paper", f"koopman_{regime}", caption, koopman_figure, *drawn)


def _fitting(gallery: Gallery, models: list[Koopman], key: Key) -> list[Koopman]:
    """The models made for the time step of a run."""
    return [m for m in models if abs(m.dt_s - gallery.instances[key.instance].dt_s) < 1e-12]


def rollout(case: Case, model: Koopman, instances: list[Instance], runs: list[Trajectory]) -> Array:
    """A model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    inputs = np.stack([np.hstack([run.p_gen, run.p_load]) for run in runs], axis=1)
    psi = model.rollout(model.initial(Network(case), instances), inputs)
    return np.asarray(psi[..., : len(case.generators) + 1])


def _draw_eigenvalues(gallery: Gallery, models: list[Koopman]) -> Iterator[Call]:
    caption = "Eigenvalues of K against the physical modes at the nominal point (crosses)."
    yield gallery.add(
        "koopman", "koopman_eigenvalues", caption, summaries.eigenvalue_figure, gallery.case, models
    )


def _draw_models(gallery: Gallery, models: list[Koopman]) -> Iterator[Call]:
    case = gallery.case
    if not gallery.trajectories:
        return
    first = next(iter(gallery.trajectories))
    t = gallery.trajectories[first].t
    keys = [key for key, run in gallery.trajectories.items() if np.array_equal(run.t, t)]
    runs = [gallery.trajectories[key] for key in keys]
    truth = np.stack([np.column_stack([run.omega, run.p_slack]) for run in runs], axis=1)
    fitting = _fitting(gallery, models, first)
    errors = {m.kind: rollout(case, m, gallery.posed(keys), runs) - truth for m in fitting}
    if errors:
        caption = (
            f"Error of Koopman rollouts against the swing equations over time, under {len(keys)} schedules: "
            "those of the paper's figures and the worst of each method."
        )
        yield gallery.add("koopman", "koopman_error", caption, summaries.rollout_figure, case, t, errors)


def _draw_worst(gallery: Gallery, chosen: Plan) -> Iterator[Call]:
    for (regime, method, settings), pairs in chosen.worst.items():
        is_reference = (method, settings) == REFERENCE
        columns = []
        for key, reason in pairs:
            if key not in gallery.trajectories:
                continue
            ded = None if is_reference else gallery.schedules.get(Key(key.instance, regime, *REFERENCE))
            powers = ded.at(gallery.trajectories[key].t) if ded else None
            columns.append(Worst(reason, Shown(method, settings, gallery.trajectories[key]), powers))
        if columns:
            heading = plain(f"{title(method, settings)}, {regime}")
            what = "violations" if is_reference else "gaps"
            dashed = "" if is_reference else "dashed: DED's powers; "
            caption = (
                f"{title(method, settings)}, {regime}: the instances with the largest {what}; "
                f"{dashed}dotted: bounds."
            )
            name = f"worst_{method}_{settings}_{regime}"
            yield gallery.add("worst", name, caption, worst_figure, gallery.case, regime, heading, columns)


def _draw_tradeoff(gallery: Gallery, frame: pd.DataFrame, timing: pd.DataFrame) -> Iterator[Call]:
    frame = main_rows(frame)
    points = tradeoff(frame, timing)
    if points["gap_percent"].notna().any():
        caption = (
            "Mean gap to DED against time per schedule; words name settings other than the default. Hollow: "
            "some schedules are infeasible; * timed under parallel load, not by `ded-bench bench`. The "
            "vertical scale is linear within ±0.01 %."
        )
        yield gallery.add("tradeoff", "tradeoff", caption, summaries.tradeoff_figure, points)
    times, objectives = (performance_profile(frame, column) for column in ("solve_s", "objective"))
    if len(times) or len(objectives):
        caption = (
            "Dolan–Moré performance profiles: share of the instances on which a method is within a factor of "
            "the fastest (top; times from the results table, under parallel load) or within a percentage of "
            "the cheapest schedule (bottom). Only feasible schedules count"
        )
        caption += without_curve(frame, objectives)
        yield gallery.add("profile", "profile", caption, summaries.profile_figure, times, objectives)


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
    """One figure per method; the short trainings of a study are left to its table."""
    histories: dict[str, dict[str, pd.DataFrame]] = {}
    for path in sorted((gallery.results.folder / "policies").glob("*.history.csv")):
        try:
            numbers = pd.read_csv(path).select_dtypes("number")
            if not {"seconds", "held out"} <= set(numbers) or not len(numbers):
                raise ValueError("columns seconds and held out are needed")
        except (OSError, ValueError) as error:
            gallery.notes.append(f"Left out: {path}: {str(error).splitlines()[0]}")
            continue
        name = path.name.removesuffix(".history.csv")
        if f"-{STUDY}" not in name:
            trained = [method for method in METHODS if name.startswith(f"{method}-")]
            histories.setdefault(max(trained, key=len, default="other"), {})[name] = numbers
    for method, curves in histories.items():
        caption = (
            f"Loss of each policy of {title(method)} over its training time; right: the loss's terms on "
            "held-out instances."
        )
        yield gallery.add("training", f"training_{method}", caption, summaries.history_figure, curves)


def _draw_problem(gallery: Gallery) -> Iterator[Call]:
    instances = list(gallery.instances.values())
    if not instances:
        return
    ranges = "the ranges of the sampler (dotted; the paper's Table III)"
    caption = f"Sampled parameters of the {len(instances)} instances against {ranges}."
    yield gallery.add("problem", "parameters", caption, summaries.parameters_figure, gallery.case, instances)
    caption = "Load forecasts of a sample of test instances."
    yield gallery.add("problem", "forecasts", caption, summaries.forecasts_figure, gallery.case, instances)
