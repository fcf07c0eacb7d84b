"""The AC simulator against an independent solver: SUNDIALS IDA on the full DAE in polar voltages.

The reference calls nothing of the suite's physics: power balances are written at every network bus from the
JSON of case and AC data, term by term, with line flows instead of an admittance matrix.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import least_squares, root
from sksundae.ida import IDA

from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import SHIPPED_CASES, Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.ac_network import AcNetwork
from ded_bench.truth.ac_simulate import simulate_ac
from ded_bench.truth.network import PowerFlowError

HORIZON_S = 3.0
AGREE = 1e-7  # rad/s


class Reference:
    """0 = F(t, y, y') with y = (δ, ω, angles of buses, magnitudes of buses), from the files' plain data.

    Angles of E' are given relative to that of the slack's machine, whose place is last in the file's order.
    """

    def __init__(self, name: str) -> None:
        case = json.loads((SHIPPED_CASES / name / "case.json").read_text())
        data = json.loads((SHIPPED_CASES / name / "ac.json").read_text())
        ids = [bus["id"] for bus in data["buses"]]
        slack = str(data["slack_machine_bus"])
        machines = sorted(data["machines"], key=lambda m: m["bus"] == slack)
        self.names = [f"g{m['bus']}" for m in machines[:-1]]
        self.at = np.array([ids.index(m["bus"]) for m in machines])
        self.x = np.array([m["xd1"] * 100.0 / m["mva"] for m in machines])
        volts = np.array([b["v"] for b in data["buses"]])
        angles = np.deg2rad([b["angle_deg"] for b in data["buses"]])
        power = np.array([complex(b["pg"], b["qg"]) for b in data["buses"]])[self.at]
        terminal = (volts * np.exp(1j * angles))[self.at]
        emf = terminal + 1j * self.x * np.conj(power / terminal)
        self.emf, turn = np.abs(emf), np.angle(emf[-1])
        self.nominal = np.concatenate([np.angle(emf[:-1]) - turn, angles - turn, volts])
        self.m = np.array([case["machines"][g]["m"] for g in self.names])
        self.d = np.array([case["machines"][g]["d"] for g in self.names])
        self.p_nominal = np.array([case["machines"][g]["p_nominal"] for g in self.names])
        self.lines = data["lines"]
        self.ends = np.array([[ids.index(line["from"]), ids.index(line["to"])] for line in data["lines"]])
        self.shunt = np.array([complex(b["gs"], b["bs"]) for b in data["buses"]])
        self.drawn = np.array([complex(b["pd"], b["qd"]) for b in data["buses"]])
        self.ids, self.n, self.n_bus = ids, len(self.m), len(ids)

    def balances(self, delta: Array, theta: Array, v: Array, drawn: Array) -> tuple[Array, Array]:
        """Powers of the machines, and real and imaginary power that is missing at every bus."""
        across = np.append(delta, 0.0) - theta[self.at]
        p = self.emf * v[self.at] * np.sin(across) / self.x
        q = v[self.at] * (self.emf * np.cos(across) - v[self.at]) / self.x
        missing = -drawn - np.conj(self.shunt) * v**2
        np.add.at(missing, self.at, p + 1j * q)
        z = np.array([complex(line["r"], line["x"]) for line in self.lines])
        half = np.array([line["b"] / 2 for line in self.lines])
        tap = np.array([line["tap"] for line in self.lines])
        i, j = self.ends.T
        one = v[i] / tap * np.exp(1j * (theta[i] - np.deg2rad([line["shift_deg"] for line in self.lines])))
        two = v[j] * np.exp(1j * theta[j])
        series = (one - two) / z
        np.add.at(missing, i, -one * np.conj(series + 1j * half * one))
        np.add.at(missing, j, -two * np.conj(-series + 1j * half * two))
        return p, np.concatenate([missing.real, missing.imag])

    def split(self, y: Array) -> tuple[Array, Array, Array, Array]:
        n = self.n
        return y[:n], y[n : 2 * n], y[2 * n : 2 * n + self.n_bus], y[2 * n + self.n_bus :]

    def equilibrium(self, p_gen: Array) -> Array:
        """y where every machine but the slack's delivers its power, ω = 0."""

        def residual(z: Array) -> Array:
            delta, theta, v = np.split(z, [self.n, self.n + self.n_bus])
            p, missing = self.balances(delta, theta, v, self.drawn)
            return np.concatenate([p[:-1] - p_gen, missing])

        answer = root(residual, self.nominal, tol=1e-13)
        assert np.abs(answer.fun).max() < 1e-10
        return np.concatenate([answer.x[: self.n], np.zeros(self.n), answer.x[self.n :]])

    def integrate(self, t: Array, y: Array, p_gen: Callable, drawn: Callable) -> Array:
        """y at times t, shape (n_t, n_y)."""

        def residual(at, y, yp, res):
            delta, omega, theta, v = self.split(y)
            p, missing = self.balances(delta, theta, v, drawn(at))
            n = self.n
            res[:n] = yp[:n] - omega
            res[n : 2 * n] = self.m * yp[n : 2 * n] + self.d * omega - p_gen(at) + p[:-1]
            res[2 * n :] = missing

        algebraic = list(range(2 * self.n, len(y)))
        solver = IDA(
            residual,
            algebraic_idx=algebraic,
            calc_initcond="yp0",
            rtol=1e-10,
            atol=1e-12,
            max_num_steps=100_000,
        )
        answer = solver.solve(t, y, np.zeros(len(y)))
        assert answer.success
        return answer.y


@pytest.mark.parametrize("name", ["two-area", "39bus"])
def test_ida_agrees(name: str, quiet_instance) -> None:
    """Machines swing against each other while one load and all generators ramp."""
    case = Case.load(name)
    reference = Reference(name)
    load_bus, load_rate = case.loads[1], -0.1
    gen_rate = 0.5 * case.ramp * (-1.0) ** np.arange(len(case.ramp))
    omega = {bus: 0.05 * (-1) ** i for i, bus in enumerate(case.generators)}
    load = json.loads(quiet_instance(case).model_dump_json())["load"]
    load[load_bus] |= {"duration": 60.0, "rate": load_rate}
    initial = {"power": dict(zip(case.generators, case.p_nominal, strict=True)), "omega": omega}
    instance = quiet_instance(case, load=load, initial=initial, horizon_s=HORIZON_S)
    ends = np.array([case.p_nominal, case.p_nominal + gen_rate * HORIZON_S])
    ours = simulate_ac(case, AcCase.of(case), instance, Schedule(np.array([0.0, HORIZON_S]), ends))

    assert tuple(reference.names) == case.generators
    y = reference.equilibrium(reference.p_nominal)
    y[reference.n : 2 * reference.n] = list(omega.values())
    unit = np.eye(reference.n_bus)[reference.ids.index(load_bus)]
    theirs = reference.integrate(
        ours.t,
        y,
        lambda at: reference.p_nominal + gen_rate * at,
        lambda at: reference.drawn - load_rate * at * unit,
    )
    assert np.abs(ours.omega).max() > 0.04
    assert np.abs(ours.omega - theirs[:, reference.n : 2 * reference.n]).max() <= AGREE
    angles = theirs[:, 2 * reference.n : 2 * reference.n + reference.n_bus]
    places = [[bus.id for bus in case.buses].index(i) for i in reference.ids]
    assert np.abs(ours.theta[:, places] - angles).max() <= AGREE
    p_slack = [
        reference.balances(delta, theta, v, reference.drawn)[0][-1]
        for delta, _, theta, v in map(reference.split, theirs)
    ]
    assert np.abs(ours.p_slack - p_slack).max() <= 1e-6


@pytest.mark.parametrize(("number", "exists"), [(0, False), (3, False), (4, True), (5, True)])
def test_where_there_is_no_equilibrium_least_squares_finds_none(number: int, exists: bool) -> None:
    """P_0 and the initial loads of some instances leave the AC network without any equilibrium."""
    reference = Reference("two-area")
    file = SHIPPED_CASES / "two-area" / "instances" / f"two-area-{number:04d}.json"
    raw = json.loads(file.read_text())
    p_gen = np.array([raw["initial"]["power"][bus] for bus in reference.names])
    drawn = reference.drawn.copy()
    for bus, load in raw["load"].items():
        drawn[reference.ids.index(bus)] += -load["initial"] - drawn[reference.ids.index(bus)].real

    def residual(z: Array) -> Array:
        p, missing = reference.balances(
            *np.split(z, [reference.n, reference.n + reference.n_bus]), drawn=drawn
        )
        return np.concatenate([p[:-1] - p_gen, missing])

    random = np.random.default_rng(number)
    spread = np.repeat([0.6, 0.2], [reference.n + reference.n_bus, reference.n_bus])
    starts = [reference.nominal + k * random.uniform(-spread, spread) for k in (0.0, 0.5, 1.0)]
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "max_nfev": 300}
    off = min(np.abs(least_squares(residual, start, **tight).fun).max() for start in starts)
    instance, case = Instance.load_file(file)
    network = AcNetwork(case, AcCase.of(case))
    if exists:
        assert off < 1e-10
        assert network.initial_state(instance).theta.shape == (3,)
    else:
        assert off > 0.1
        with pytest.raises(PowerFlowError):
            network.initial_state(instance)
