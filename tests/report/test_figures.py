"""Figures of single instances show the data, the bounds and units, and hide nothing behind a legend."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.surrogates.linear import linear_model
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.report.figures import summaries
from ded_bench.report.figures.frequencies import frequency_figure, koopman_figure
from ded_bench.report.figures.schedules import Worst, schedule_figure, worst_figure
from ded_bench.report.figures.style import (
    RAD_TO_HZ,
    Shown,
    busiest,
    envelope,
    save_figure,
    thin,
)
from ded_bench.report.gallery import rollout
from ded_bench.plants.simulate import Trajectory, simulate
from tests.report.drawing import check_layout, has_level, shows

HORIZON = 2.0


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


@pytest.mark.parametrize("name", ["$\\frac{$", "a $b$ c", "_hidden", "100 %"])
def test_names_of_methods_are_drawn_as_they_are(shown, case, tmp_path, name) -> None:
    """A stranger's method may be called anything; nothing of it is taken for mathematics."""
    other = Shown(name, "default", shown[1].trajectory)
    figure = frequency_figure(case, "TO", "heading", [shown[0], other])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[1].replace("\\$", "$").strip() == name
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
