"""Figures over many instances and methods: data, labels and legends that hide nothing."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from ded_bench.analysis.summary import GROUP, in_own_table, title
from ded_bench.files.strict import parse_record
from ded_bench.surrogates.linear import linear_model
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.report.figures import summaries
from ded_bench.report.figures.histories import history_figure, moving_terms
from ded_bench.report.figures.labels import Label, place_labels
from ded_bench.report.figures.style import (
    colour,
    dashes,
    marker,
    new_figure,
    thin,
)
from ded_bench.report.figures.tradeoff import profile_figure, tradeoff_figure
from tests.report.drawing import check_layout, drawn, has_level, shows

PAPERS = pd.DataFrame(
    [("TO", "ded-ko", "DED-KO", 0.3, 18.8)], columns=["regime", "method", "name", "gap_percent", "seconds"]
)


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


def test_a_method_that_one_regime_timed_alone_is_named_once(tmp_path) -> None:
    points = pd.DataFrame(
        [
            ("NO", "ded", "default", "DED", 100, 1.0, 0.0, 5.0, True),
            ("TO", "ded", "default", "DED", 100, 1.0, 0.0, 5.0, False),
        ],
        columns=[*GROUP, "title", "n", "correct_rate", "gap_percent", "seconds", "alone"],
    )
    figure = tradeoff_figure(points, "DED", PAPERS[:0])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["DED *"]
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


def test_labels_keep_off_curves(tmp_path) -> None:
    """A word at a point just below a curve through the whole axes goes below its point."""
    with new_figure(4.0, 3.0) as figure:
        ax = figure.subplots()
        ax.plot([0.0, 1.0], [0.53, 0.53])
        ax.plot([0.5], [0.5], "o", markersize=4)
        ax.set_xlim(0, 1)
        ax.set_ylim(0, 1)
        place_labels(figure, ax, [Label("a long word", 0.5, 0.5, "k")])
    box = Text.get_window_extent(ax.texts[0], figure.canvas.get_renderer())  # type: ignore[attr-defined]
    assert box.y1 < ax.transData.transform((0.5, 0.53))[1]


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
