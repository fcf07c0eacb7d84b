"""Real-time iterations with reserve: the setting `reserve` of `ded-ko-knots`."""

from __future__ import annotations

import functools

import numpy as np

from ded_bench.methods.ded_rti import RealTimeSolver, SoftProgram
from ded_bench.methods.knot_program import Limit, Prediction
from ded_bench.methods.knots import knot_weights
from ded_bench.methods.reserve import Reserve
from ded_bench.plants.time_varying import Indices
from ded_bench.solvers.linear_program import FormAnswer, FreeForm

#: Steady speed that a ramp may leave, as a part of the bound: a ramp that begins at once swings a machine to
#: twice its steady speed. This and the price were chosen on scenarios drawn for it (docs/online.md).
LIMIT = 0.5
#: What a shortage as large as that costs, in pu of generation at the mean cost of all machines.
PRICE = 1.0
#: Knots so far ahead keep reserve, s: plans are made anew long before.
AHEAD_S = 20.0


class ReserveProgram(SoftProgram):
    """The program of real-time iterations, with responses to unannounced ramps."""

    def __init__(self, program: SoftProgram, reserve: Reserve) -> None:
        vars(self).update(vars(program))  # what it has built already
        self._reserve = reserve

    def _relaxed_form(self, limits: Indices, by_interval: bool, price: float) -> tuple[FreeForm, Indices]:
        form, order = super()._relaxed_form(limits, by_interval, price)
        place, points = np.argsort(order), self.model.points[1:]
        near = slice(0, int(np.searchsorted(points, AHEAD_S / self._instance.dt_s)))
        mean = float(np.mean(list(self._instance.cost.values())))
        shortage = PRICE * mean * knot_weights(self.model.lengths)[1:] / self._reserve.limit
        last = place[self._x[:, -1]] + 1  # the interval's widening
        form, added = self._reserve.required(
            form, place[self._u][near], self.model.p_gen[1:][near], last[near], shortage[near]
        )
        return form, np.append(order, np.arange(len(order), len(added)))[added]


class ReserveSolver(RealTimeSolver):
    """Corrects plans of one case and regime on one surrogate, and keeps reserve."""

    @functools.cached_property
    def _reserve(self) -> Reserve:
        return Reserve.of(self.case, LIMIT * self.case.omega_bound(self.regime))

    def _solved(  # type: ignore[override]
        self, program: SoftProgram, limits: set[Limit], deadline: float
    ) -> tuple[FormAnswer, Prediction | None, int]:
        return super()._solved(ReserveProgram(program, self._reserve), limits, deadline)
