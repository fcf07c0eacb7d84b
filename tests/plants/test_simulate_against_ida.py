"""The simulator against an independent solver: SUNDIALS IDA on the full index-1 DAE.

Nothing here calls the suite's physics. Residual and Jacobian are written from the JSON of case and
instance, in the implicit form 0 = F(t, y, y') with y = (θ_gen, ω, θ_alg); initial angles come from a
power flow by scipy. IDA is restarted wherever the inputs, linear between grid points, have a kink.
"""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root
from sksundae.ida import IDA

from ded_bench.files.strict import parse_record
from ded_bench.plants.plant import simulate
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule

RTOL, ATOL = 1e-10, 1e-12
#: In rad/s and pu: what IDA's own errors, accumulated over some thousand steps, allow.
AGREE = 2e-8


class Reference:
    """The swing DAE of one case, from the plain data of its file; plain floats, term by term."""

    def __init__(self, data: dict) -> None:
        slack = next(bus["id"] for bus in data["buses"] if bus["kind"] == "slack")
        algebraic = [bus["id"] for bus in data["buses"] if bus["kind"] in ("load", "junction")]
        volts = {bus["id"]: bus["v"] for bus in data["buses"]}
        self.gen = [bus["id"] for bus in data["buses"] if bus["kind"] == "generator"]
        self.load = [bus["id"] for bus in data["buses"] if bus["kind"] == "load"]
        self.n = len(self.gen)
        self.size = 2 * self.n + len(algebraic)
        #: Where each bus has its angle in y; the slack's is zero and has no place.
        self.place: dict[str, int | None] = {slack: None}
        self.place |= {bus: i for i, bus in enumerate(self.gen)}
        self.place |= {bus: 2 * self.n + i for i, bus in enumerate(algebraic)}
        self.lines = [
            (
                self.place[line["from"]],
                self.place[line["to"]],
                volts[line["from"]] * volts[line["to"]] / math.hypot(line["r"], line["x"]),
            )
            for line in data["lines"]
        ]
        self.m = [data["machines"][bus]["m"] for bus in self.gen]
        self.d = [data["machines"][bus]["d"] for bus in self.gen]

    def flows(self, y: list[float]) -> tuple[list[float], float]:
        """Injections f at the places of their angles, and at the slack."""
        f, slack = [0.0] * self.size, 0.0
        for i, j, b in self.lines:
            flow = b * math.sin((0.0 if i is None else y[i]) - (0.0 if j is None else y[j]))
            for end, sign in ((i, 1.0), (j, -1.0)):
                if end is None:
                    slack += sign * flow
                else:
                    f[end] += sign * flow
        return f, slack

    def stiffness(self, y: list[float]) -> np.ndarray:
        """∂f/∂y, zero in the columns of ω."""
        k = np.zeros((self.size, self.size))
        for i, j, b in self.lines:
            slope = b * math.cos((0.0 if i is None else y[i]) - (0.0 if j is None else y[j]))
            for end, other in ((i, j), (j, i)):
                if end is not None:
                    k[end, end] += slope
                    if other is not None:
                        k[end, other] -= slope
        return k

    def wanted(self, p_gen: np.ndarray, p_load: np.ndarray) -> np.ndarray:
        """Powers at the places of the angles of their buses."""
        out = np.zeros(self.size)
        out[: self.n] = p_gen
        out[[self.place[bus] for bus in self.load]] = p_load
        return out

    def equilibrium(self, p_gen: np.ndarray, p_load: np.ndarray) -> np.ndarray:
        """y with the angles that serve the given powers, near those of the linear power flow, and ω = 0."""
        angles = [*range(self.n), *range(2 * self.n, self.size)]
        wanted = self.wanted(p_gen, p_load)

        def full(theta: np.ndarray) -> np.ndarray:
            y = np.zeros(self.size)
            y[angles] = theta
            return y

        answer = root(
            lambda theta: (np.array(self.flows(full(theta))[0]) - wanted)[angles],
            np.linalg.solve(self.stiffness(np.zeros(self.size))[np.ix_(angles, angles)], wanted[angles]),
            tol=1e-13,
        )
        assert np.abs(answer.fun).max() < 1e-11
        y = full(answer.x)
        # Beyond a right angle on some line the grid may rest, too, but not stay there.
        assert (np.linalg.eigvalsh(self.stiffness(y)[np.ix_(angles, angles)]) > 0).all()
        return y

    def consistent_slopes(self, y: np.ndarray, power: list[float], rate: list[float]) -> np.ndarray:
        """y' from the swing equation, and from d/dt of the load equations."""
        n, k, yp = self.n, self.stiffness(y), np.zeros(self.size)
        f, _ = self.flows(y)
        yp[:n] = y[n : 2 * n]
        for i in range(n):
            yp[n + i] = (power[i] - f[i] - self.d[i] * y[n + i]) / self.m[i]
        load = k[2 * n :]
        yp[2 * n :] = np.linalg.solve(load[:, 2 * n :], np.array(rate[2 * n :]) - load[:, :n] @ yp[:n])
        return yp

    def solver(self, start: float, power: list[float], rate: list[float]) -> IDA:
        """IDA for inputs power + (t - start) rate."""
        n, size, m, d = self.n, self.size, self.m, self.d

        def residual(t, y, yp, res):
            y, yp, inside = y.tolist(), yp.tolist(), t - start
            f, _ = self.flows(y)
            for i in range(n):
                res[i] = yp[i] - y[n + i]
                res[n + i] = m[i] * yp[n + i] + d[i] * y[n + i] - (power[i] + inside * rate[i]) + f[i]
            for i in range(2 * n, size):
                res[i] = power[i] + inside * rate[i] - f[i]

        def jacobian(t, y, yp, res, cj, out):
            k = self.stiffness(y.tolist())
            out[:, :] = 0.0
            for i in range(n):
                out[i, i], out[i, n + i] = cj, -1.0
                out[n + i, :] = k[i]
                out[n + i, n + i] += cj * m[i] + d[i]
            out[2 * n :, :] = -k[2 * n :]

        algebraic = list(range(2 * n, size))
        options = {"rtol": RTOL, "atol": ATOL, "max_num_steps": 100_000}
        return IDA(residual, jacfn=jacobian, algebraic_idx=algebraic, **options)

    def integrate(self, t, p_gen, p_load, omega_initial) -> tuple[np.ndarray, np.ndarray]:
        """ω, shape (n_t, n_gen), and P_s, shape (n_t,), with inputs linear between the points t."""
        inputs = np.array([self.wanted(g, load) for g, load in zip(p_gen, p_load, strict=True)])
        slopes = np.diff(inputs, axis=0) / np.diff(t)[:, None]
        kinks = 1 + np.flatnonzero(np.abs(np.diff(slopes, axis=0)).max(axis=1) > 1e-10)
        y = self.equilibrium(p_gen[0], p_load[0])
        y[self.n : 2 * self.n] = omega_initial
        out = np.empty((len(t), self.size))
        for first, last in pairwise([0, *kinks.tolist(), len(t) - 1]):
            power = inputs[first].tolist()
            rate = ((inputs[last] - inputs[first]) / (t[last] - t[first])).tolist()
            yp = self.consistent_slopes(y, power, rate)
            answer = self.solver(t[first], power, rate).solve(t[first : last + 1], y, yp)
            assert answer.success
            # Two times are a span to IDA, which then answers at its own steps: keep the ends.
            out[first : last + 1] = answer.y if last > first + 1 else answer.y[[0, -1]]
            y = out[last].copy()
        return out[:, self.n : 2 * self.n], np.array([self.flows(row)[1] for row in out.tolist()])


def raw_inputs(reference: Reference, instance: Instance, schedule: Schedule):
    """Time grid, generator powers and loads at its points, and ω(0), from the instance's plain data."""
    data = json.loads(instance.model_dump_json(by_alias=True))
    t = np.arange(round(data["horizon_s"] / data["dt_s"]) + 1) * data["dt_s"]
    p_gen = np.column_stack([np.interp(t, schedule.t, column) for column in schedule.p.T])
    ramps = [data["load"][bus] for bus in reference.load]
    p_load = np.column_stack(
        [r["initial"] + r["rate"] * np.clip(t - r["start"], 0, r["duration"]) for r in ramps]
    )
    return t, p_gen, p_load, [data["initial"]["omega"][bus] for bus in reference.gen]


def compare(case_file: Path, instance: Instance, schedule: Schedule, trajectory) -> None:
    """Assert that IDA and the simulator agree at every grid point."""
    reference = Reference(json.loads(case_file.read_text()))
    t, p_gen, p_load, omega_initial = raw_inputs(reference, instance, schedule)
    p_initial = [instance.initial.power[bus] for bus in reference.gen]
    np.testing.assert_array_equal(p_gen[0], p_initial)  # angles at t_0 are those of P_0
    omega, p_slack = reference.integrate(t, p_gen, p_load, omega_initial)
    np.testing.assert_array_equal(trajectory.t, t)
    assert np.abs(trajectory.omega - omega).max() <= AGREE
    assert np.abs(trajectory.p_slack - p_slack).max() <= AGREE


def calm(instance: Instance, omega: float) -> Instance:
    """No load ramps, and a push at t = 0 that is large enough to be nonlinear."""
    data = json.loads(instance.model_dump_json(by_alias=True))
    for ramp in data["load"].values():
        ramp["rate"] = 0.0
    data["initial"]["omega"] = {bus: omega * (-1) ** i for i, bus in enumerate(data["initial"]["omega"])}
    return parse_record(Instance, json.dumps(data), "calm")


def early(instance: Instance, horizon_s: float) -> Instance:
    """Load ramps that begin and end soon, at none of the grid's points, and a shorter horizon."""
    data = json.loads(instance.model_dump_json(by_alias=True)) | {"horizon_s": horizon_s}
    for ramp in data["load"].values():
        ramp["start"], ramp["duration"] = 0.5031, 1.7
    return parse_record(Instance, json.dumps(data), "short")


def straight(case: Case, instance: Instance) -> Schedule:
    """From P_0 to the middle of the limits: no kink at all."""
    ends = np.stack([instance.p_initial(case), 0.5 * (case.p_min + case.p_max)])
    return Schedule(t=np.array([0.0, instance.horizon_s]), p=ends)


def fifty_knots(case: Case, instance: Instance) -> Schedule:
    """Random powers at j·horizon/49, between grid points."""
    p = np.random.default_rng(50).uniform(case.p_min, case.p_max, (50, len(case.generators)))
    p[0] = instance.p_initial(case)
    return Schedule(t=np.arange(50) * (instance.horizon_s / 49), p=p)


def bang_bang(case: Case, instance: Instance) -> Schedule:
    """Up or down at every grid point, at half to full ramp, drawn at random in pairs that cancel."""
    signs = np.random.default_rng(51).choice([-1.0, 1.0], (instance.steps, len(case.generators)))
    signs[::2] = -signs[1::2]
    steps = signs * case.ramp * instance.dt_s * np.linspace(0.5, 1.0, instance.steps)[:, None]
    p = instance.p_initial(case) + np.vstack([np.zeros(len(case.generators)), np.cumsum(steps, axis=0)])
    return Schedule(t=instance.grid, p=p)


def test_smooth_and_fifty_knot_schedules(case_file, case):
    """A full horizon without any kink, and one with 50 knots and load ramps."""
    ramping = sample_instance(case, 60, 1)
    assert any(ramp.rate != 0 for ramp in ramping.load.values())
    instances = [calm(ramping, 0.2), ramping]
    schedules = [straight(case, instances[0]), fifty_knots(case, ramping)]
    for instance, schedule in zip(instances, schedules, strict=True):
        compare(case_file, instance, schedule, simulate(case, instance, schedule))


@pytest.mark.parametrize(
    ("name", "horizon_s"), [("two-area", 12.0), ("39bus", 6.0), ("68bus", 3.0), ("140bus", 1.5)]
)
def test_physical_grids(name, horizon_s):
    """Loads ramp, and all powers go up and down at nine tenths of their ramp limits."""
    file = SHIPPED_CASES / name / "case.json"
    case = Case.load(file)
    instance = early(sample_instance(case, 60, 1), horizon_s)
    thirds = np.linspace(0.0, horizon_s, 4)
    p = instance.p_initial(case) + 0.3 * horizon_s * np.outer([0.0, 1.0, 0.0, 1.0], case.ramp)
    schedule = Schedule(t=thirds, p=p)
    compare(file, instance, schedule, simulate(case, instance, schedule))


def test_bang_bang_schedule(case_file, case):
    """A kink at every single grid point: a schedule that an optimiser in a corner would give."""
    instance = early(sample_instance(case, 60, 1), 6.0)
    schedule = bang_bang(case, instance)
    kinks = np.abs(np.diff(schedule.p, n=2, axis=0)).min(axis=0)
    assert (kinks > 0).all()
    compare(case_file, instance, schedule, simulate(case, instance, schedule))
