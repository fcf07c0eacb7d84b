"""How far the mean frequency of an island goes at least when a load ramps and nobody announced it.

The system frequency response model: machines swing as one, governors and turbines are those of the case, AGC
acts at its times. From rest, a load ramps at t = 0. The controller learns the whole course of the ramp later,
and nothing before; from then on it moves all set-points within their ramp limits as it likes, for any price,
and whatever machines swing: once with room for that at every machine, once within their limits from the
cheapest dispatch. One linear program has the least peak of |mean frequency|. It is a reference for single
scenarios and no bound: other loads that ramp meanwhile may help.

    python studies/least_peak.py CASE
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.sparse as sp
from causal_bound import held

from ded_bench import Case
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Array
from ded_bench.problem.scenario import Scenario, ScenarioRamp, load_scenarios
from ded_bench.solvers.highs import solve_form
from ded_bench.solvers.linear_program import FreeForm

ROOT = Path(__file__).resolve().parents[1]
#: Distance of knots of set-points and of points at which the frequency counts; how long after a ramp, s.
STEP_S, AFTER_S = 0.25, 5.0
#: Plans are asked for so often, s.
PERIOD_S = 1.0
#: When the ramp is told, and what machines have room for.
KINDS = ("at once", "next second", "at once, limits", "next second, limits")


class FrequencyResponse:
    """An island as one machine; states: mean frequency (pu), its angle (rad), gates and turbines (pu)."""

    def __init__(self, case: Case) -> None:
        system = plant_of(case).system  # type: ignore[attr-defined]
        data, n = system.data, len(case.generators)
        if case.agc is None or len(data) != n:
            raise SystemExit(f"{case.id}: not an island whose machines are all scheduled")
        self.case, self.agc, self.shares = case, case.agc, system.shares
        self.nominal_hz, per_inertia = data.omega_0[0] / (2.0 * np.pi), 1.0 / np.sum(1.0 / data.inverse_m)
        a, gate, turbine = np.zeros((2 + 2 * n, 2 + 2 * n)), slice(2, 2 + n), slice(2 + n, None)
        a[0, 0], a[1, 0] = -per_inertia * data.d.sum(), data.omega_0[0]
        a[0, gate], a[0, turbine] = per_inertia * data.reheat, per_inertia * (1.0 - data.reheat)
        a[gate, 0], a[gate, gate] = -data.rate_g * data.droop, -np.diag(data.rate_g)
        a[turbine, gate], a[turbine, turbine] = np.diag(data.rate_h), -np.diag(data.rate_h)
        b = np.zeros((len(a), n + 1))  # set-points, and an injection
        b[gate, :n], b[0, n] = np.diag(data.rate_g), per_inertia
        self.after, self.by_start, self.by_slope = held(a, b, STEP_S)

    def answer(self, inputs: Array, first: int) -> Array:
        """Mean frequency at the points, (n_points, n_answers), Hz.

        Args:
            inputs: set-points and an injection, (n_points, n_gen + 1, n_answers), pu; linear between points.
            first: point at which AGC acts next.
        """
        every, x = round(self.agc.period_s / STEP_S), np.zeros((len(self.after), inputs.shape[2]))
        asked, found = np.zeros(inputs.shape[2]), np.empty((len(inputs), inputs.shape[2]))
        by_asked = self.by_start[:, :-1] @ self.shares
        slopes = np.diff(inputs, axis=0) / STEP_S
        for k, now in enumerate(inputs):
            found[k] = self.nominal_hz * x[0]
            if k >= first and (k - first) % every == 0:
                asked = -self.agc.k * x[1]
            if k + 1 < len(inputs):
                x = self.after @ x + self.by_start @ now + self.by_slope @ slopes[k]
                x += np.outer(by_asked, asked)
        return found

    def least_peak(self, ramp: ScenarioRamp, told: int, room: tuple[Array, Array]) -> float:
        """Least peak of the mean frequency, Hz.

        Args:
            ramp: of a load.
            told: so many points after its start.
            room: of set-points, below (negative) and above, (n_gen,), pu.
        """
        n, n_gen = round((ramp.duration + AFTER_S) / STEP_S), len(self.case.generators)
        first = int(np.ceil((-ramp.start % self.agc.period_s) / STEP_S))
        knots = np.arange(told + 1, n + 1)
        inputs = np.zeros((n + 1, n_gen + 1, 1 + n_gen * len(knots)))
        inputs[:, -1, 0] = ramp.rate * np.clip(np.arange(n + 1) * STEP_S, 0.0, ramp.duration)
        for j, knot in enumerate(knots):
            inputs[knot, :n_gen, 1 + j * n_gen : 1 + (j + 1) * n_gen] = np.eye(n_gen)
        free, moved = np.split(self.answer(inputs, first), [1], axis=1)
        m = moved.shape[1]
        change = sp.eye_array(m) - sp.eye_array(m, k=-n_gen)
        peak = -np.ones((n + 1, 1))
        between = sp.csc_matrix(
            sp.vstack(
                [np.hstack([moved, peak]), np.hstack([-moved, peak]), sp.hstack([change, np.zeros((m, 1))])]
            )
        )
        step, endless = np.tile(self.case.ramp * STEP_S, len(knots)), np.full(n + 1, np.inf)
        form = FreeForm(
            cost=np.append(np.zeros(m), 1.0),
            equal=sp.csc_matrix((0, m + 1)),
            right=np.empty(0),
            between=between,
            low=np.concatenate([-endless, -endless, -step]),
            high=np.concatenate([-free[:, 0], free[:, 0], step]),
            lower=np.append(np.tile(room[0], len(knots)), 0.0),
            upper=np.append(np.tile(room[1], len(knots)), np.inf),
        )
        return float(solve_form(form).x[-1])


def references(response: FrequencyResponse, scenario: Scenario) -> list[float]:
    """The largest of all ramps of a scenario that were not announced, for each of `KINDS`, mHz; 0: none."""
    case, found = response.case, [[0.0] * len(KINDS)]
    endless = np.full(len(case.generators), np.inf)
    for load in scenario.load.values():
        for ramp in load.ramps:
            if ramp.announced_start is None and ramp.start < scenario.duration_s:
                late = int((-ramp.start % PERIOD_S) / STEP_S)
                there = scenario.snapshot(case, ramp.start)
                power = plant_of(case).static_dispatch(there, np.zeros(1))[0]  # type: ignore[attr-defined]
                free, limited = (-endless, endless), (case.p_min - power, case.p_max - power)
                asked = ((0, free), (late, free), (0, limited), (late, limited))
                found.append([1e3 * response.least_peak(ramp, *one) for one in asked])
    return np.max(found, axis=0).tolist()


def main(name: str) -> None:
    """Print means over the committed scenarios of 300 s, beside those of methods."""
    case = Case.load(name)
    response = FrequencyResponse(case)
    files = sorted((ROOT / "problems" / name / "scenarios").glob("*-s*.json"))
    scenarios = load_scenarios(files, case)
    rows = pd.read_csv(ROOT / "results" / f"{name}-reference" / "online.csv")
    found = [references(response, one) for one in scenarios]
    least = pd.DataFrame(found, index=[one.id for one in scenarios], columns=list(KINDS))
    print(least.describe().loc[["mean", "max"]].round(2).to_string())
    rows = rows[(rows.forecast == "announced") & (rows.regime == "TO") & rows.scenario.isin(least.index)]
    for (method, settings), own in rows.groupby(["method", "settings"]):
        peak = 1e3 * own.set_index("scenario").mean_freq_max_hz
        beside = least.loc[peak.index]
        below = ", ".join(str(int((peak < beside[kind]).sum())) for kind in KINDS)
        print(
            f"{method} {settings}: {peak.mean():.2f} mHz in {len(peak)} scenarios, below the least in {below}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:2])
