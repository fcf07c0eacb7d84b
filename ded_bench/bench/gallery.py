"""The figures drawn from a results folder; what is missing becomes a note, never an error."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ded_bench.bench import charts
from ded_bench.bench.figures import (
    DPI,
    Shown,
    Worst,
    frequency_figure,
    koopman_figure,
    plain,
    save_figure,
    schedule_figure,
    worst_figure,
)
from ded_bench.bench.metrics import (
    GROUP,
    REFERENCE,
    STUDY,
    groups,
    performance_profile,
    title,
    tradeoff,
)
from ded_bench.bench.page import Block, Picture, Text
from ded_bench.bench.pool import Call, Workers
from ded_bench.bench.results import Key, Results
from ded_bench.bench.selection import Plan, plan
from ded_bench.bench.studies import main_rows
from ded_bench.koopman.model import Koopman
from ded_bench.koopman.physics import linear_model
from ded_bench.methods import METHODS
from ded_bench.problem.case import Array, Case
from ded_bench.problem.errors import InputError
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import load_split
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.simulate import SimulationError, Trajectory, simulate_many
from ded_bench.truth.swing import Network

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
    pending: list[Call] = field(default_factory=list)

    def add(
        self, topic: str, name: str, caption: str, figure: Callable[..., Figure], *arguments: Any
    ) -> None:
        """Hang a picture under a topic; `paint` makes the figure by this call and writes it."""
        formats, dpi = (("png",), WORST_DPI) if topic == "worst" else (("png", "pdf"), DPI)
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", name)
        stem = self.results.folder / "figures" / name
        self.pending.append((paint, (stem, formats, dpi, figure, arguments)))
        self.files += [stem.parent / f"{name}.{form}" for form in formats]
        self.pictures.setdefault(topic, []).append(Picture(f"figures/{name}.png", caption))

    def take_pending(self) -> list[Call]:
        """The calls that draw what was added since this was last asked."""
        pending, self.pending = self.pending, []
        return pending

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
    case: Case, results: Results, frame: pd.DataFrame, timing: pd.DataFrame, problems: Path, workers: int = 1
) -> Gallery:
    """Draw every figure that the folder has data for into `<results>/figures`.

    Args:
        frame: the rows that the report is about.
        timing: the timing rows of one host.
        problems: folder of the benchmark's instances.
        workers: processes that draw; with one, this one does.
    """
    gallery = Gallery(case, results)
    frame = frame[frame["regime"].isin(list(case.regimes))]
    _read_instances(gallery, problems)
    chosen = plan(frame, gallery.has)
    _read_schedules(gallery, chosen)
    models = _models(gallery)
    _draw_tradeoff(gallery, frame, timing)
    _draw_training(gallery)
    _draw_problem(gallery)
    _draw_eigenvalues(gallery, models)
    with Workers(workers) if workers > 1 else nullcontext() as pool:
        simulations = _simulations(gallery, chosen)
        calls: list[Call] = [(simulate_many, arguments) for arguments in simulations.values()]
        for keys, runs in _answers(pool, [*calls, *gallery.take_pending()], [*simulations]):
            _keep(gallery, keys, runs)
        _draw_schedules(gallery, chosen)
        _draw_tight(gallery, chosen, models)
        _draw_worst(gallery, chosen)
        _draw_models(gallery, models)
        list(_answers(pool, gallery.take_pending(), []))
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


def _answers(
    pool: Workers | None, calls: list[Call], labels: list[tuple[Key, ...]]
) -> Iterator[tuple[tuple[Key, ...], object]]:
    """Answers, or SimulationErrors, of the first calls, which have labels; any other error is raised."""
    names: list[tuple[Key, ...]] = [*labels, *[()] * (len(calls) - len(labels))]
    found = zip(names, map(_called, calls), strict=True) if pool is None else pool.imap(calls, names)
    for name, answer in found:
        if isinstance(answer, Exception) and not isinstance(answer, SimulationError):
            raise answer
        if name:
            yield name, answer


def _called(call: Call) -> object:
    function, arguments = call
    try:
        return function(*arguments)
    except SimulationError as error:
        return error


def _simulations(gallery: Gallery, chosen: Plan) -> dict[tuple[Key, ...], tuple[Any, ...]]:
    """Arguments of `simulate_many` by what it simulates: side by side, which costs little more than one."""
    grids: dict[tuple[int, float], list[Key]] = {}
    for key in filter(gallery.schedules.__contains__, chosen.shown):
        instance = gallery.instances[key.instance]
        grids.setdefault((instance.steps, instance.dt_s), []).append(key)
    return {
        tuple(keys): (gallery.case, gallery.posed(keys), [gallery.schedules[key] for key in keys])
        for keys in grids.values()
    }


def _keep(gallery: Gallery, keys: tuple[Key, ...], runs: object) -> None:
    if isinstance(runs, list):
        gallery.trajectories |= dict(zip(keys, runs, strict=True))
    else:
        gallery.notes.append(f"Not drawn, since the simulation failed: {runs}")


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


def _draw_schedules(gallery: Gallery, chosen: Plan) -> None:
    for regime, keys in chosen.representative.items():
        if shown := _shown(gallery, keys):
            caption = (
                f"{_names(shown)} on {keys[0].instance}, regime {regime} (the instance with the median gap): "
                "generator powers with their bounds, loads, slack power."
            )
            heading = f"{keys[0].instance}, {regime}"
            gallery.add("paper", f"schedule_{regime}", caption, schedule_figure, gallery.case, heading, shown)


def _draw_tight(gallery: Gallery, chosen: Plan, models: list[Koopman]) -> None:
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
    gallery.add("paper", f"frequencies_{regime}", caption, frequency_figure, case, regime, heading, shown)
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
        gallery.add("paper", f"koopman_{regime}", caption, koopman_figure, *drawn)


def _fitting(gallery: Gallery, models: list[Koopman], key: Key) -> list[Koopman]:
    """The models made for the time step of a run."""
    return [m for m in models if abs(m.dt_s - gallery.instances[key.instance].dt_s) < 1e-12]


def rollout(case: Case, model: Koopman, instances: list[Instance], runs: list[Trajectory]) -> Array:
    """A model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    inputs = np.stack([np.hstack([run.p_gen, run.p_load]) for run in runs], axis=1)
    psi = model.rollout(model.initial(Network(case), instances), inputs)
    return np.asarray(psi[..., : len(case.generators) + 1])


def _draw_eigenvalues(gallery: Gallery, models: list[Koopman]) -> None:
    caption = "Eigenvalues of K against the physical modes at the nominal point (crosses)."
    gallery.add("koopman", "koopman_eigenvalues", caption, charts.eigenvalue_figure, gallery.case, models)


def _draw_models(gallery: Gallery, models: list[Koopman]) -> None:
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
        gallery.add("koopman", "koopman_error", caption, charts.rollout_figure, case, t, errors)


def _draw_worst(gallery: Gallery, chosen: Plan) -> None:
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
            gallery.add("worst", name, caption, worst_figure, gallery.case, regime, heading, columns)


def _draw_tradeoff(gallery: Gallery, frame: pd.DataFrame, timing: pd.DataFrame) -> None:
    frame = main_rows(frame)
    points = tradeoff(frame, timing)
    if points["gap_percent"].notna().any():
        caption = (
            "Mean gap to DED against time per schedule; words name settings other than the default. Hollow: "
            "some schedules are infeasible; * timed under parallel load, not by `ded-bench bench`. The "
            "vertical scale is linear within ±0.01 %."
        )
        gallery.add("tradeoff", "tradeoff", caption, charts.tradeoff_figure, points)
    times, objectives = (performance_profile(frame, column) for column in ("solve_s", "objective"))
    if len(times) or len(objectives):
        caption = (
            "Dolan–Moré performance profiles: share of the instances on which a method is within a factor of "
            "the fastest (top; times from the results table, under parallel load) or within a percentage of "
            "the cheapest schedule (bottom). Only feasible schedules count"
        )
        caption += without_curve(frame, objectives)
        gallery.add("profile", "profile", caption, charts.profile_figure, times, objectives)


def without_curve(frame: pd.DataFrame, profile: pd.DataFrame) -> str:
    """The end of the profiles' caption: methods that never gave a feasible schedule."""
    drawn = set(profile[GROUP].itertuples(index=False, name=None))
    absent = [
        f"{title(method, settings)} in {regime}"
        for regime, method, settings, _ in groups(frame)
        if (regime, method, settings) not in drawn
    ]
    return f"; {', '.join(absent)} had none and no curve." if absent else "."


def _draw_training(gallery: Gallery) -> None:
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
        gallery.add("training", f"training_{method}", caption, charts.history_figure, curves)


def _draw_problem(gallery: Gallery) -> None:
    instances = list(gallery.instances.values())
    if not instances:
        return
    ranges = "the ranges of the sampler (dotted; the paper's Table III)"
    caption = f"Sampled parameters of the {len(instances)} instances against {ranges}."
    gallery.add("problem", "parameters", caption, charts.parameters_figure, gallery.case, instances)
    caption = "Load forecasts of a sample of test instances."
    gallery.add("problem", "forecasts", caption, charts.forecasts_figure, gallery.case, instances)
