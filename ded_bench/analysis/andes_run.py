"""One run of the field's simulator ANDES, in a process of its own that imports nothing of this package.

`python andes_run.py SPEEDS.npy` reads `{"grid": ..., "run": ...}` from its standard input. It writes the
speeds to the file, (n, n_machine), rad/s from nominal at equidistant times from 0 to the horizon, machines in
the order of the grid's file, and prints `{"andes": version, "error": ""}`, or why there are none. The module
`referee` beside it describes grid and run.
"""

from __future__ import annotations

import json
import math
import os
import sys
from typing import Any

# This file's folder is no place for modules: names in it could hide others'.
sys.path = [place for place in sys.path if place != os.path.dirname(os.path.abspath(__file__))]

import numpy as np  # noqa: E402

#: Limits that never act, pu.
FREE = 999.0
#: Inertia of a machine that keeps its speed, s.
INFINITE = 1e12
KV = 110.0
#: Largest step, s, and where Newton's method ends.
STEP_S, TOLERANCE = 0.02, 1e-8
#: Newton steps for voltages and all else that is algebraic, when inputs have jumped.
SETTLING = 20


class Simulator:
    """ANDES's model of one grid for one run."""

    def __init__(self, andes: Any, grid: dict[str, Any], run: dict[str, Any]) -> None:
        self.column = andes.shared.matrix
        self.grid, self.given = grid, run
        self.machines = grid["machines"]["machines"]
        self.names = [machine["name"] for machine in self.machines]
        self.omega_0 = 2 * math.pi * grid["machines"]["f0_hz"]
        self.system = andes.System(no_output=True, default_config=True)
        self._add_network()
        for machine in self.machines:
            self._add_machine(machine)
        self.system.setup()
        self.system.PQ.config.update(p2p=1.0, q2q=1.0, p2z=0.0, q2z=0.0, pq2z=0.0)
        self.system.PFlow.config.update(tol=1e-11, max_iter=50)
        self.system.TDS.config.update(
            tol=TOLERANCE, linesearch=0, criteria=0, no_tqdm=1, check_conn=0, reset_tiny=0
        )

    def _power(self, bus: str) -> tuple[float, list[float]]:
        """Power of the machines at a bus at the start, and each one's share of it."""
        given, here = self.given["power"], [m for m in self.machines if m["bus"] == bus]
        nominal = next(b["pg"] for b in self.grid["network"]["buses"] if b["id"] == bus)
        powers = [given.get(m["name"], m["share"] * nominal) for m in here]
        return sum(powers), [p / sum(powers) if len(here) > 1 else 1.0 for p in powers]

    def _add_network(self) -> None:
        network, add = self.grid["network"], self.system.add
        stations = {machine["bus"] for machine in self.machines}
        for bus in network["buses"]:
            name, angle = bus["id"], math.radians(bus["angle_deg"])
            add("Bus", idx=name, Vn=KV, v0=bus["v"], a0=angle)
            p, q = bus["pd"], bus["qd"]
            if name in stations:
                held = {"p0": self._power(name)[0], "q0": bus["qg"], "v0": bus["v"], "Vn": KV, "Sn": 100.0}
                if name == network["slack_machine_bus"]:
                    add("Slack", idx=f"static {name}", bus=name, a0=angle, **held)
                else:
                    add("PV", idx=f"static {name}", bus=name, **held)
            else:
                p, q = p - bus["pg"], q - bus["qg"]
            if name in self.given["loads"]:
                p = self.given["loads"][name]["p"][0]
            if p or q or name in self.given["loads"]:
                add("PQ", idx=f"load {name}", bus=name, p0=p, q0=q, Vn=KV)
            if bus["gs"] or bus["bs"]:
                add("Shunt", idx=f"shunt {name}", bus=name, g=bus["gs"], b=bus["bs"], Vn=KV, Sn=100.0)
        for line in network["lines"]:
            given = {name: line[name] for name in ("r", "x", "b", "tap")}
            given |= {"bus1": line["from"], "bus2": line["to"], "phi": math.radians(line["shift_deg"])}
            add("Line", **given, trans=1, Vn1=KV, Vn2=KV, Sn=100.0)

    def _add_machine(self, machine: dict[str, Any]) -> None:
        name, kind, add = machine["name"], machine["model"], self.system.add
        inertia = INFINITE if name == self.grid["infinite"] else 2 * machine["h"]
        given = {"bus": machine["bus"], "gen": f"static {machine['bus']}", "Sn": machine["mva"], "Vn": KV}
        given |= {"fn": self.grid["machines"]["f0_hz"], "M": inertia, "D": machine["d"], "ra": 0.0}
        here = [m["name"] for m in self.machines if m["bus"] == machine["bus"]]
        share = self._power(machine["bus"])[1][here.index(name)]
        given |= {"xd1": machine["xd1"], "gammap": share, "gammaq": machine["share"]}
        if kind == "GENROU":
            names = "xd", "xq", "xq1", "xd2", "xl", "Td10", "Td20", "Tq10", "Tq20"
            given |= {key: machine[key] for key in names} | {"xq2": machine["xd2"]}
        add(kind, idx=name, **given)
        governor = machine["governor"]
        times = {"T1": governor["t1"], "T2": governor["t2"], "T3": governor["t3"]}
        add("TGOV1N", idx=name, syn=name, R=governor["r"], Dt=0.0, VMAX=FREE, VMIN=-FREE, **times)
        if (exciter := machine["exciter"]) is not None:
            add(exciter["model"], idx=name, syn=name, **_exciter(exciter))
        if (pss := machine["pss"]) is not None:
            given = {"MODE": 1, "K1": pss["ks"], "T1": 0.0, "MODE2": 0, "K2": 0.0, "T2": 0.0}
            given |= {"T3": pss["tw"], "T4": pss["tw"], "T5": pss["t1"], "T6": pss["t2"], "T7": pss["t3"]}
            given |= {"T8": pss["t4"], "T9": 0.0, "T10": 0.0, "LSMAX": FREE, "LSMIN": -FREE}
            add("ST2CUT", idx=name, avr=name, **given)

    def speeds(self) -> Any:
        """Speeds at equidistant points of the run, (n, n_machine), rad/s from nominal.

        Raises:
            ArithmeticError: there is no equilibrium to start from, or Newton's method does not converge.
        """
        start, run, agc = self._start(), self.given, self.grid["agc"]
        h = _step(run, agc)
        t, grid = (np.arange(round(run["horizon_s"] / d) + 1) * d for d in (h, run["dt_s"]))
        drawn = {b: np.interp(grid, points["t"], points["p"]) for b, points in run["loads"].items()}
        loads = [self.system.PQ.idx2uid(f"load {bus}") for bus in drawn]
        p_load = np.array([np.interp(t, grid, p) for p in drawn.values()]).T
        added = [np.interp(t, grid, self._added(name, grid)) for name in self.names]
        p_ref, rest, every = np.array(added).T + start, self._mean_angle(), len(t)
        if agc is not None:
            every = round(agc["period_s"] / h)
            part = np.array([agc["participation"].get(name, 0.0) for name in self.names])
        speeds, share = np.empty(p_ref.shape), np.zeros(len(self.names))
        for k in range(len(t)):
            speeds[k] = self.omega_0 * (self.system.dae.x[self.speed] - 1.0)
            if k == len(t) - 1:
                return speeds
            if k and k % every == 0:
                share = -agc["k"] * (self._mean_angle() - rest) * part
                self._set(p_ref[k] + share, loads, p_load[k])
                self._settle()
            self._set(p_ref[k + 1] + share, loads, p_load[k + 1])
            self._advance(h)

    def _start(self) -> Any:
        """Solve the power flow and start from it; returns the governors' references there."""
        system = self.system
        if not system.PFlow.run():
            raise ArithmeticError("the power flow has no solution")
        system.TDS.init()
        if not system.TDS.test_ok:
            raise ArithmeticError("the solved power flow is no equilibrium")
        self.speed, self.delta = self._places("omega"), self._places("delta")
        self.governors = [system.TGOV1N.idx2uid(name) for name in self.names]
        for name, omega in self.given["omega"].items():
            system.dae.x[self.speed[self.names.index(name)]] += omega / self.omega_0
        self._settle()
        return system.TGOV1N.pref0.v[self.governors].copy()

    def _places(self, variable: str) -> list[int]:
        models = self.system.GENROU, self.system.GENCLS
        owners = [next(model for model in models if name in model.idx.v) for name in self.names]
        return [getattr(o, variable).a[o.idx2uid(n)] for o, n in zip(owners, self.names, strict=True)]

    def _added(self, name: str, grid: Any) -> Any:
        """What a machine's set-points add to its power at the start."""
        run = self.given
        if name not in run["set_points"]:
            return np.zeros(len(grid))
        return np.interp(grid, run["t"], run["set_points"][name]) - run["power"][name]

    def _mean_angle(self) -> float:
        """Mean of the rotors' angles by inertia, rad."""
        weight = np.array([2 * m["h"] * m["mva"] for m in self.machines])
        return float(weight @ self.system.dae.x[self.delta] / weight.sum())

    def _set(self, p_ref: Any, loads: list[int], p_load: Any) -> None:
        self.system.TGOV1N.pref0.v[self.governors] = p_ref
        self.system.PQ.Ppf.v[loads] = p_load

    def _advance(self, h: float) -> None:
        """One step of the trapezoidal rule: inputs have their values at its end."""
        tds, dae = self.system.TDS, self.system.dae
        tds.h = h
        dae.t += h
        if not tds.itm_step():
            raise ArithmeticError(f"no solution at t = {float(dae.t):.2f} s")

    def _settle(self) -> None:
        """Solve what is algebraic for given states, so that a step starts with the slopes after a jump."""
        system = self.system
        tds, dae, models = system.TDS, system.dae, system.exist.pflow_tds
        instant = dae.Tf == 0.0  # lags without a time constant are states of ANDES
        for _ in range(SETTLING):
            system.vars_to_models()
            tds.fg_update(models=models)
            system.j_update(models=models)
            column = self.column(dae.g)
            tds.solver.linsolve(dae.gy, column)
            change = np.array(column).ravel()
            dae.y -= change
            dae.x[instant] += dae.f[instant]
            if max(np.abs(change).max(), np.abs(dae.f[instant]).max(initial=0.0)) < TOLERANCE:
                system.vars_to_models()
                tds.fg_update(models=models)
                return
        raise ArithmeticError(f"no voltages at t = {float(dae.t):.2f} s")


def _step(run: dict[str, Any], agc: dict[str, Any] | None) -> float:
    """The largest step up to STEP_S that fits a run's grid, its horizon and secondary control, s."""
    dt: float = run["dt_s"]
    lengths = [round(run["horizon_s"] / dt), *([round(agc["period_s"] / dt)] if agc else [])]
    fitting = (k for k in range(int(STEP_S / dt + 1e-9), 0, -1) if all(n % k == 0 for n in lengths))
    factor: float = next(fitting, 1 / math.ceil(dt / STEP_S - 1e-9))
    return dt * factor


def _exciter(exciter: dict[str, Any]) -> dict[str, float]:
    if exciter["model"] == "SEXS":
        given = {"TATB": exciter["ta"] / exciter["tb"], "TB": exciter["tb"], "TE": exciter["te"]}
        return given | {"K": exciter["k"], "EMIN": -FREE, "EMAX": FREE}
    given = {"TR": 0.0, "TB": 1.0, "TC": 1.0, "VRMAX": FREE, "VRMIN": -FREE}
    given |= {"TF1": exciter["tf"], "KF1": exciter["kf"]}
    return given | {key.upper(): exciter[key] for key in ("ka", "ta", "te", "ke")}


def main() -> None:
    """Answer what is asked on standard input."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever ANDES prints is no answer
    import andes

    andes.config_logger(stream_level=50)
    asked, error = json.load(sys.stdin), ""
    try:
        np.save(sys.argv[1], Simulator(andes, asked["grid"], asked["run"]).speeds())
    except (ArithmeticError, ValueError) as failure:
        error = str(failure)
    print(json.dumps({"andes": andes.__version__, "error": error}), file=answers, flush=True)


if __name__ == "__main__":
    main()
