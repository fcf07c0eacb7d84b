"""What a figure shows, and whether it can be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from ded_bench.report.figures.style import (
    save_figure,
)


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
