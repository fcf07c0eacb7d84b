"""Figures show the data, the bounds and units, and hide nothing behind a legend."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from ded_bench.evaluate.summary import GROUP, in_own_table, title
from ded_bench.files.strict import parse_record
from ded_bench.koopman.linear import linear_model
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.report.figures import summaries
from ded_bench.report.figures.frequencies import frequency_figure, koopman_figure
from ded_bench.report.figures.histories import history_figure, moving_terms
from ded_bench.report.figures.labels import Label, place_labels
from ded_bench.report.figures.schedules import Worst, schedule_figure, worst_figure
from ded_bench.report.figures.style import (
    RAD_TO_HZ,
    Shown,
    busiest,
    colour,
    dashes,
    envelope,
    marker,
    new_figure,
    save_figure,
    thin,
)
from ded_bench.report.figures.tradeoff import profile_figure, tradeoff_figure
from ded_bench.report.gallery import rollout
from ded_bench.truth.simulate import Trajectory, simulate

HORIZON = 2.0
PAPERS = pd.DataFrame(
    [("TO", "ded-ko", "DED-KO", 0.3, 18.8)], columns=["regime", "method", "name", "gap_percent", "seconds"]
)


@pytest.fixture(scope="module")
def instance(case: Case) -> Instance:
    return sample_instance(case, 5, 0).model_copy(update={"horizon_s": HORIZON})


@pytest.fixture(scope="module")
def shown(case: Case, instance: Instance) -> list[Shown]:
    """Two methods on one instance: one holds P_0, one ramps down."""
    start = instance.p_initial(case)
    ends = np.array([0.0, HORIZON])
    schedules = [Schedule(ends, np.stack([start, start - drop])) for drop in (0.0, 0.05)]
    runs = [simulate(case, instance, schedule) for schedule in schedules]
    return [Shown("ded", "default", runs[0]), Shown("ded-dpc-paper", "default", runs[1])]


def drawn(ax: Any) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata(), dtype=float) for line in ax.get_lines()]


def shows(ax: Any, values: np.ndarray) -> bool:
    return any(len(line) == len(values) and np.allclose(line, values) for line in drawn(ax))


def has_level(ax: Any, level: float) -> bool:
    return any(
        line.get_linestyle() == ":" and np.allclose(line.get_ydata(), level) for line in ax.get_lines()
    )


def check_layout(figure: Figure, tmp_path: Path) -> None:
    """Every panel has units or labels on both axes, and no legend covers a panel."""
    save_figure(figure, tmp_path / "figure", ("png",))
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    axes = [ax for ax in figure.axes if ax.get_visible() and ax.axison]
    assert axes
    boxes = [legend.get_window_extent(renderer) for legend in figure.legends]
    boxes += [ax.get_legend().get_window_extent(renderer) for ax in axes if ax.get_legend()]
    for box in boxes:
        assert figure.bbox.x0 - 1 <= box.x0
        assert box.x1 <= figure.bbox.x1 + 1
        for ax in axes:
            inside = Bbox.intersection(box, ax.get_window_extent(renderer))
            assert inside is None or inside.width * inside.height < 1.0
    assert all(ax.get_xlabel() for ax in axes[-1:])


def test_schedules_with_bounds_loads_and_slack(case, instance, shown, tmp_path) -> None:
    figure = schedule_figure(case, "heading", shown)
    axes = [ax for ax in figure.axes if ax.get_visible()]
    t = instance.grid
    for j in range(len(case.generators)):
        for s in shown:
            assert shows(axes[j], thin(t, s.trajectory.p_gen[:, j])[1])
        assert has_level(axes[j], case.p_min[j])
        assert has_level(axes[j], case.p_max[j])
    loads, slack = axes[len(case.generators) :]
    assert all(shows(loads, thin(t, instance.p_load(case)[:, j])[1]) for j in range(len(case.loads)))
    assert all(shows(slack, thin(t, s.trajectory.p_slack)[1]) for s in shown)
    assert all("(pu)" in ax.get_ylabel() for ax in axes)
    assert axes[-1].get_xlabel() == "time (s)"
    check_layout(figure, tmp_path)


@pytest.mark.parametrize("regime", ["NO", "TO"])
def test_frequencies_are_in_hertz_with_the_regimes_bounds(case, instance, shown, regime, tmp_path) -> None:
    figure = frequency_figure(case, regime, "heading", shown)
    limit = case.regimes[regime].omega_hz
    for j, ax in enumerate(figure.axes):
        assert has_level(ax, limit)
        assert has_level(ax, -limit)
        assert all(shows(ax, thin(instance.grid, s.trajectory.omega[:, j] * RAD_TO_HZ)[1]) for s in shown)
        assert "(Hz)" in ax.get_ylabel()
    check_layout(figure, tmp_path)


def test_koopman_beside_swing_and_their_difference(case, instance, shown, tmp_path) -> None:
    run = shown[1].trajectory
    outputs = rollout(case, linear_model(case), [instance], [run])[:, 0]
    figure = koopman_figure(case, "TO", "heading", run, outputs, "linear")
    n_gen = len(case.generators)
    for j, (left, right) in enumerate(np.reshape(figure.axes, (-1, 2))):
        scale = RAD_TO_HZ if j < n_gen else 1.0
        true = (run.omega[:, j] if j < n_gen else run.p_slack) * scale
        assert shows(left, thin(run.t, true)[1])
        assert shows(left, thin(run.t, outputs[:, j] * scale)[1])
        assert shows(right, thin(run.t, outputs[:, j] * scale - true)[1])
        assert ("(Hz)" if j < n_gen else "(pu)") in right.get_ylabel()
    check_layout(figure, tmp_path)


def test_rollout_starts_at_the_true_frequencies_and_stays_near(case, instance, shown) -> None:
    runs = [s.trajectory for s in shown]
    outputs = rollout(case, linear_model(case), [instance, instance], runs)
    for b, run in enumerate(runs):
        assert np.allclose(outputs[0, b, :-1], run.omega[0])
        assert np.abs(outputs[:, b, :-1] - run.omega).max() < 0.1 * np.abs(run.omega).max()


def test_worst_instances_side_by_side(case, instance, shown, tmp_path) -> None:
    columns = [Worst("first", shown[1], shown[0]), Worst("second", shown[0], None)]
    figure = worst_figure(case, "TO", "heading", columns)
    first = figure.axes[0]
    assert shows(first, thin(instance.grid, shown[0].trajectory.p_gen[:, 0])[1])  # DED's for comparison
    lower = figure.axes[2]
    assert shows(lower, thin(instance.grid, shown[0].trajectory.omega[:, 0] * RAD_TO_HZ)[1])
    assert [ax.get_title() for ax in figure.axes[:2]] == ["first", "second"]
    assert all(has_level(ax, case.regimes["TO"].omega_hz) for ax in figure.axes[2:])
    check_layout(figure, tmp_path)


def test_files_are_the_same_every_time(case, instance, shown, tmp_path) -> None:
    for name in ("one", "two"):
        save_figure(frequency_figure(case, "TO", "heading", shown), tmp_path / name)
    for form in ("png", "pdf"):
        assert (tmp_path / f"one.{form}").read_bytes() == (tmp_path / f"two.{form}").read_bytes()
    assert (tmp_path / "one.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert (tmp_path / "one.pdf").read_bytes()[:5] == b"%PDF-"


def test_methods_differ_in_colour_and_marker() -> None:
    names = list(METHODS)
    assert len({colour(name) for name in names}) == len(names)
    assert len({marker(name) for name in names}) == len(names)
    assert dashes("ded") == ()
    assert dashes("ded", 1) != ()
    for name in names:
        assert len({dashes(name, variant) for variant in range(7)}) == 7
    assert colour("stranger") == colour("stranger")


def test_tradeoff_draws_a_point_per_method_hollow_if_infeasible(tmp_path) -> None:
    points = pd.DataFrame(
        [
            ("NO", "ded", "default", "DED", 100, 1.0, 0.0, 5.0, True),
            ("NO", "ed", "1s", "ED [1s]", 100, 0.5, -0.02, 1e-3, False),
            ("TO", "mine", "default", "mine", 100, 1.0, 3.0, 1e-4, True),
        ],
        columns=[*GROUP, "title", "n", "correct_rate", "gap_percent", "seconds", "alone"],
    )
    figure = tradeoff_figure(points, "DED", PAPERS[:0])
    left, right = figure.axes  # one below the other
    markers = {float(line.get_xdata()[0]): line for line in left.get_lines() if line.get_marker() != "None"}
    assert set(markers) == {5.0, 1e-3}
    assert markers[1e-3].get_markerfacecolor() == "white"
    assert markers[5.0].get_markerfacecolor() == colour("ded")
    assert [float(line.get_ydata()[0]) for line in right.get_lines() if line.get_marker() != "None"] == [3.0]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["DED", "ED *", "mine", "hollow: some infeasible"]
    assert [text.get_text() for text in left.texts] == ["1s *"]
    check_layout(figure, tmp_path)


def test_the_papers_points_stand_in_the_tradeoff(tmp_path) -> None:
    points = pd.DataFrame(
        [("TO", "ded", "default", "DED", 100, 1.0, 0.0, 5.0, True)],
        columns=[*GROUP, "title", "n", "correct_rate", "gap_percent", "seconds", "alone"],
    )
    figure = tradeoff_figure(points, "DED", PAPERS)
    (ax,) = figure.axes
    places = [line.get_xydata()[0].tolist() for line in ax.get_lines() if line.get_marker() != "None"]
    assert [18.8, 0.3] in places
    assert [text.get_text() for text in ax.texts] == ["paper's DED-KO"]
    assert "grey: the paper's" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_labels_cover_neither_each_other_nor_points(tmp_path) -> None:
    """Ten words at points close to each other."""
    with new_figure(4.0, 3.0) as figure:
        ax = figure.subplots()
        points = [(float(x), 0.5 + 0.1 * np.sin(40 * x)) for x in np.linspace(0.4, 0.6, 10)]
        ax.plot(*np.transpose(points), "o", markersize=4)
        ax.set_xlim(0, 1)
        ax.set_ylim(0, 1)
        place_labels(figure, ax, [Label(f"word{i}", *point, "k") for i, point in enumerate(points)])
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    boxes = [Text.get_window_extent(note, renderer) for note in ax.texts]
    assert len(boxes) == 10
    common = [Bbox.intersection(a, b) for i, a in enumerate(boxes) for b in boxes[:i]]
    assert sum(box.width * box.height for box in common if box) == 0
    dots = ax.transData.transform(ax.get_lines()[0].get_xydata())
    assert not any(box.contains(*dot) for box in boxes for dot in dots)


def test_many_methods_and_settings_stay_readable(tmp_path) -> None:
    """Every method with every setting it has: one entry each in the legend, which covers nothing."""
    keys = [(name, settings) for name, method in METHODS.items() for settings in method.settings]
    keys = [key for key in keys if not in_own_table(key[1])]
    points = pd.DataFrame(
        [
            (regime, *key, title(*key), 100, 1.0, 0.01 * i, 10.0 ** (-i / 4), True)
            for regime in ("NO", "TO")
            for i, key in enumerate(keys)
        ],
        columns=[*GROUP, "title", "n", "correct_rate", "gap_percent", "seconds", "alone"],
    )
    figure = tradeoff_figure(points, "DED", PAPERS[:0])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [title(name) for name in METHODS]
    assert len(figure.axes[0].texts) == len([key for key in keys if key[1] != "default"])
    check_layout(figure, tmp_path)
    profile = points.assign(ratio=1.0 + points["seconds"], fraction=1.0)
    figure = profile_figure(profile, profile)
    assert len(figure.legends[0].get_texts()) == len(keys)
    styles = {(line.get_color(), str(line._dash_pattern)) for line in figure.axes[0].get_lines()}  # type: ignore[attr-defined]
    assert len(styles) == len(keys)
    check_layout(figure, tmp_path)


@pytest.mark.parametrize("name", ["$\\frac{$", "a $b$ c", "_hidden", "100 %"])
def test_names_of_methods_are_drawn_as_they_are(shown, case, tmp_path, name) -> None:
    """A stranger's method may be called anything; nothing of it is taken for mathematics."""
    other = Shown(name, "default", shown[1].trajectory)
    figure = frequency_figure(case, "TO", "heading", [shown[0], other])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[1].replace("\\$", "$").strip() == name
    check_layout(figure, tmp_path)


def test_profiles_end_at_the_share_of_instances_solved(tmp_path) -> None:
    columns = ["regime", "method", "settings", "title", "ratio", "fraction"]
    rows = [("TO", "ded", "default", "DED", 1.0, 0.5), ("TO", "ded", "default", "DED", 4.0, 1.0)]
    rows += [("TO", "ed", "1s", "ED", 1.0, 0.25)]
    profile = pd.DataFrame(rows, columns=columns)
    figure = profile_figure(profile, profile)
    times, objectives = figure.axes
    for ax, xs in ((times, [1.0, 1.0, 4.0, 8.0]), (objectives, [1e-4, 1e-4, 300.0, 600.0])):
        line = ax.get_lines()[0]
        assert line.get_xdata() == pytest.approx(xs)
        assert list(line.get_ydata()) == [0.0, 0.5, 1.0, 1.0]
        assert ax.get_lines()[1].get_ydata()[-1] == 0.25
    check_layout(figure, tmp_path)
    check_layout(profile_figure(profile, profile[:0]), tmp_path)


def test_training_history(tmp_path) -> None:
    history = pd.DataFrame(
        {"epoch": [1, 2], "seconds": [60.0, 120.0], "training": [9.0, 8.0], "held out": [7.0, 6.0]}
        | {"objective": [5.0, 4.0], "ramp up": [0.0, 1e-3], "ramp down": [0.0, 0.0]}
    )
    gaps = pd.DataFrame(
        {"seconds": [1.0, 2.0, 3.0], "training": [9.0, np.nan, 7.0], "held out": [np.nan] * 3}
    )  # taken now and then, and not at all
    figure = history_figure({"one": history, "two": history.drop(columns="training")})
    left, right = figure.axes[:2]
    assert drawn(left)[1].tolist() == [7.0, 6.0]
    assert left.get_lines()[0].get_xdata().tolist() == [1.0, 2.0]  # minutes
    assert drawn(right)[0].tolist() == [5.0, 4.0]
    assert [line.tolist() for line in drawn(figure.axes[2])] == [[7.0, 6.0]]
    assert moving_terms(history) == ["objective"]
    loss = history.assign(cost=history["held out"], still=[9.0, 8.0])
    assert moving_terms(loss) == ["objective"]  # neither the loss again nor a straight line
    (few,) = drawn(history_figure({"few": gaps}).axes[0])
    assert few.tolist() == [9.0, 7.0]
    check_layout(figure, tmp_path)


def test_sampled_parameters_against_the_ranges(case: Case, tmp_path) -> None:
    some = [sample_instance(case, 5, i) for i in range(40)]
    figure = summaries.parameters_figure(case, some)
    panels = figure.axes[:7]
    counts = [sum(patch.get_height() for patch in ax.patches) for ax in panels]
    n_load, n_gen = len(case.loads), len(case.generators)
    assert counts[:4] == [40 * n_load] * 4
    assert 0 < counts[4] <= 40 * n_gen
    assert counts[5:] == [40 * n_gen, 40 * (n_gen + 1)]
    for ax, limits in zip(panels[1:3], (case.sampling.start_s, case.sampling.duration_s), strict=True):
        assert [line.get_xdata()[0] for line in ax.get_lines()] == list(limits)
    check_layout(figure, tmp_path)


def test_perturbations_are_recovered(case: Case, quiet_instance) -> None:
    """P_0 made from known s_i by the paper's equation gives them back."""
    quiet = quiet_instance(
        case, cost={bus: 0.1 * (i + 1) for i, bus in enumerate((*case.generators, case.slack))}
    )
    optimum = merit_order(
        case, quiet.cost_gen(case), quiet.cost_slack(case), quiet.p_load(case, np.zeros(1))[0]
    )
    wanted = np.linspace(0.2, 0.9, len(case.generators))
    start = optimum - 0.5 * (optimum - case.p_nominal) * wanted
    data = json.loads(quiet.model_dump_json(by_alias=True))
    data["initial"]["power"] = dict(zip(case.generators, start.tolist(), strict=True))
    made = parse_record(Instance, json.dumps(data), "made")
    known = np.abs(optimum - case.p_nominal) > 1e-3
    assert known.any()
    assert summaries.perturbations(case, [made]) == pytest.approx(wanted[known])


def test_load_forecasts(case: Case, tmp_path) -> None:
    some = [sample_instance(case, 5, i) for i in range(6)]
    figure = summaries.forecasts_figure(case, some, count=4)
    for j, ax in enumerate(figure.axes):
        assert len(ax.get_lines()) == 4 + 1
        assert has_level(ax, case.load_nominal[j])
        for instance in some[:4]:
            assert shows(ax, thin(instance.grid, instance.p_load(case)[:, j])[1])
    check_layout(figure, tmp_path)


def test_rollout_errors_over_time(case: Case, tmp_path) -> None:
    t = np.linspace(0, 1, 11)
    error = np.zeros((11, 3, len(case.generators) + 1))
    error[1:, :, 0] = 2 * np.pi * np.array([1e-5, 1e-4, 1e-3])
    error[1:, :, -1] = -1e-2
    figure = summaries.rollout_figure(case, t, {"linear": error})
    left, right = figure.axes
    median, largest = drawn(left)
    assert median[1:] == pytest.approx(1e-4)
    assert largest[1:] == pytest.approx(1e-3)
    assert drawn(right)[0][1:] == pytest.approx(1e-2)
    check_layout(figure, tmp_path)


def test_eigenvalues_of_the_linearisation_are_the_physical_modes(case: Case, tmp_path) -> None:
    figure = summaries.eigenvalue_figure(case, [linear_model(case)])
    modes, rates = (
        np.sort_complex(np.round(np.array(line.get_xdata()) + 1j * np.array(line.get_ydata()), 6))
        for line in figure.axes[0].get_lines()[:2]
    )
    assert rates == pytest.approx(modes, abs=1e-5)
    check_layout(figure, tmp_path)


def test_the_curves_that_move_most_are_shown_in_their_order() -> None:
    t = np.linspace(0, 1, 11)
    curves = np.outer(t, [0.0, 3.0, 1.0, 2.0])
    assert busiest(curves, count=2) == [1, 3]
    assert busiest(curves, curves * [9.0, 1.0, 1.0, 1.0] + np.outer(t, [9.0, 0, 0, 0]), count=2) == [0, 1]
    assert busiest(curves) == [0, 1, 2, 3]
    times, least, largest = envelope(t, curves)
    assert (times, least, largest) == (pytest.approx(t), pytest.approx(0 * t), pytest.approx(3 * t))


@pytest.mark.parametrize("n_gen", [9, 47])
def test_many_generators_fit_a_page(n_gen: int, tmp_path) -> None:
    """Six powers, four frequencies under the span of all, and no figure higher than a page."""
    name = {9: "39bus", 47: "140bus"}[n_gen]
    case = Case.load(SHIPPED_CASES / name)
    t = np.linspace(0, 2, 21)
    waves = np.sin(np.outer(t, np.arange(1, n_gen + 1)) / 9)
    loads = np.outer(1 + t, np.linspace(-1, -2, len(case.loads)))
    run = Trajectory(t, waves, 1e-3 * waves, waves, loads, waves[:, 0], case)
    shown = [Shown("ded-radau", "default", run), Shown("ded-slp", "default", run)]
    outputs = np.column_stack([run.omega * 1.1, run.p_slack])
    figures = {
        "schedules": schedule_figure(case, "heading", shown),
        "frequencies": frequency_figure(case, "TO", "heading", shown),
        "koopman": koopman_figure(case, "TO", "heading", run, outputs, "linear"),
        "worst": worst_figure(case, "TO", "heading", [Worst("first", shown[1], shown[0])]),
        "forecasts": summaries.forecasts_figure(case, [sample_instance(case, 5, i) for i in range(2)]),
    }
    for figure in figures.values():
        assert figure.get_size_inches()[1] <= 10
        check_layout(figure, tmp_path)
    chosen = busiest(waves)
    axes = figures["schedules"].axes
    for ax, j in zip(axes, chosen, strict=False):
        assert shows(ax, waves[:, j])
        assert case.generators[j] in ax.get_ylabel()
    assert len(axes[len(chosen)].get_lines()) == len(case.loads)  # all of them, most in grey
    first = figures["frequencies"].axes[0]
    assert len(first.collections) == 2
    assert len(figures["frequencies"].axes) == 1 + 4


def test_thin_keeps_the_ends_of_short_curves() -> None:
    t = np.arange(6001.0)
    kept, values = thin(t, 2 * t)
    assert len(kept) <= 1501
    assert (values == 2 * kept).all()
    assert kept[0] == 0
    assert kept[-1] == 6000
    assert len(thin(t[:100], t[:100])[0]) == 100
