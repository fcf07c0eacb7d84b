"""Figures show the data and the bounds, and are drawn without a warning whatever methods are called."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ded_bench.analysis.summary import GROUP, title
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.report.figures.panels import (
    FEW,
    Shown,
    balance_panel,
    busiest,
    frequency_panels,
    load_panel,
    power_panels,
    time_figure,
)
from ded_bench.report.figures.style import save_figure
from ded_bench.report.figures.tradeoff import tradeoff_figure

PAPERS = pd.DataFrame(
    [("TO", "ded-ko", "DED-KO", 0.3, 18.8)], columns=["regime", "method", "name", "gap_percent", "seconds"]
)
POINT = [*GROUP, "title", "n", "correct_rate", "gap_percent", "seconds", "alone"]


def shows(ax: Any, values: np.ndarray) -> bool:
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in ax.get_lines()]
    return any(len(line) == len(values) and np.allclose(line, values) for line in lines)


@pytest.mark.parametrize("name", ["9bus", "39bus", "140bus"])
def test_trajectories_in_panels(name: str, tmp_path: Path) -> None:
    """All generators of a small grid, those that move most of a large one, never higher than a page."""
    case = Case.load(SHIPPED_CASES / name)
    n_gen, n_load = len(case.generators), len(case.loads)
    t = np.linspace(0, 2, 21)
    waves = np.sin(np.outer(t, np.arange(1, n_gen + 1)) / 9)
    loads = np.outer(1 + t, np.linspace(-1, -2, n_load))
    shown = [
        Shown(method, title(method), place, t, scale * waves, 1e-3 * scale * waves, loads, waves[:, 0])
        for place, (method, scale) in enumerate((("ded-radau", 1.0), ("$\\frac{$", 0.5)))
    ]
    panels = [*power_panels(case, shown), load_panel(case, shown[0]), balance_panel(case, "TO", shown)]
    figure = time_figure("heading", panels, 2)
    chosen = busiest([waves], FEW)
    assert len(chosen) == min(n_gen, FEW)
    for ax, j in zip(figure.axes, chosen, strict=False):
        assert shows(ax, waves[:, j])
        assert shows(ax, 0.5 * waves[:, j])
        assert shows(ax, np.full(2, case.p_min[j]))
        assert case.generators[j] in ax.get_ylabel()
    frequencies = time_figure("heading", frequency_panels(case, "TO", shown, 4), 1)
    limit = 1e3 * case.regimes["TO"].omega_hz
    for ax, j in zip(frequencies.axes, busiest([waves], 4), strict=True):
        assert shows(ax, waves[:, j] / (2 * np.pi))  # mHz
        assert shows(ax, np.full(2, limit))
        assert shows(ax, np.full(2, -limit))
    for drawn in (figure, frequencies):
        assert drawn.get_size_inches()[1] <= 10
        save_figure(drawn, tmp_path / "figure.png")


def test_tradeoff_draws_a_point_per_line_hollow_if_infeasible(tmp_path: Path) -> None:
    points = pd.DataFrame(
        [
            ("NO", "ded", "default", "", "DED", 100, 1.0, 0.0, 5.0, True),
            ("NO", "ed", "every=1", "", "ED [every=1]", 100, 0.5, -0.02, 1e-3, False),
            ("TO", "mine$", "default", "", "mine$", 100, 1.0, 3.0, 1e-4, True),
        ],
        columns=POINT,
    )
    figure = tradeoff_figure(points, "DED", PAPERS)
    first, second = figure.axes
    places = [line.get_xydata().tolist() for line in first.get_lines()]
    assert [[5.0, 0.0]] in places
    hollow = [
        line for line in first.get_lines() if line.get_markerfacecolor() == "white" and len(line.get_xdata())
    ]
    assert [line.get_xydata().tolist() for line in hollow] == [[[1e-3, -0.02]]]
    assert [[18.8, 0.3]] in [line.get_xydata().tolist() for line in second.get_lines()]
    assert "every=1 *" in [text.get_text() for text in first.texts]
    for ax in figure.axes:  # words keep off the axes' own numbers
        for box in (word.get_window_extent() for word in ax.texts if word.get_text()):
            assert ax.bbox.x0 <= box.x0 <= box.x1 <= ax.bbox.x1
    save_figure(figure, tmp_path / "figure.png")
