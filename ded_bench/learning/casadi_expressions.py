"""A case's plant as CasADi expressions, for controllers and optimisers of one's own.

A semi-explicit DAE of index 1: dx/dt = ode, 0 = alg, in the symbols x, z, u, p_load and p.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi
import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.detailed_plant import DetailedPlant
from ded_bench.plants.detailed.machine_arrays import DELTA, N_STATES, SPEED
from ded_bench.plants.lossless.lossless_plant import LosslessPlant
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance


@dataclass(frozen=True, eq=False)
class CasadiModel:
    """Symbols and expressions (SX); limits of set-points and ramps are `p_min`, `p_max`, `ramp` of the case.

    lossless: `x` (n_x,) are θ, then ω of the generators (rad, rad/s), `z` (n_z,) the angles of all other
    buses but the slack (rad); `p` (n_p,) is empty. detailed: `x` are the states of
    `plants.detailed.machine_arrays`, state after state, `z` the voltages at ports, real and imaginary parts
    in turn (pu), `p` the exciters' references, what governors' are beyond set-points, and last what
    secondary control holds (pu).
    """

    case: Case
    x: casadi.SX
    z: casadi.SX
    u: casadi.SX  # set-points, (n_gen,), pu
    p_load: casadi.SX  # load injections, (n_load,), pu
    p: casadi.SX  # constant, but for what secondary control holds
    ode: casadi.SX  # dx/dt, (n_x,), in the units of x per s
    alg: casadi.SX  # zero, (n_z,), pu
    omega: casadi.SX  # (n_gen,), rad/s, deviation from nominal
    p_gen: casadi.SX  # delivered, (n_gen,), pu
    p_slack: casadi.SX  # (1,), pu; zero on an island
    held: casadi.SX  # what secondary control holds from its next time on, the last of p, (1,), pu
    start: Callable[[Instance], tuple[Array, Array, Array]]  # x, z, p at t = 0, (n,) in their units

    @property
    def function(self) -> casadi.Function:
        """(x, z, u, p_load, p) to (ode, alg, omega, p_gen, p_slack)."""
        inputs, outputs = ("x", "z", "u", "p_load", "p"), ("ode", "alg", "omega", "p_gen", "p_slack")
        given, answers = ([getattr(self, name) for name in names] for names in (inputs, outputs))
        return casadi.Function("plant", given, answers, inputs, outputs)

    def monitored(self, regime: str) -> tuple[casadi.SX, Array, NDArray[np.bool_]]:
        """Outputs y (n_out,) with |y| ≤ limit (rad/s), the limits, and which of them count at the end only.

        Raises:
            InputError: the case has no such regime.
        """
        bounds = self.case.bounds(regime)
        return casadi.DM(bounds.matrix) @ self.omega, bounds.limit, bounds.at_end


def casadi_model(case: Case, plant: str | None = None) -> CasadiModel:
    """The equations of a case's plant, by its name; None: the case's own.

    Raises:
        InputError: there is no such plant, or its equations are not known to CasADi.
    """
    chosen = plant_of(case, plant)
    if isinstance(chosen, LosslessPlant):
        return _lossless(chosen)
    if isinstance(chosen, DetailedPlant):
        return _detailed(chosen)
    raise InputError("plant", chosen.name, "has no equations for CasADi")


def _inputs(case: Case) -> tuple[casadi.SX, casadi.SX]:
    return casadi.SX.sym("u", len(case.generators)), casadi.SX.sym("p_load", len(case.loads))


def _lossless(plant: LosslessPlant) -> CasadiModel:
    case, network = plant.case, plant.network
    n, (u, p_load) = len(case.generators), _inputs(case)
    x, z, p = casadi.SX.sym("x", 2 * n), casadi.SX.sym("z", len(network.algebraic)), casadi.SX.sym("p", 0)
    theta = casadi.SX.zeros(network.n_bus)
    theta[network.generators.tolist()], theta[network.algebraic.tolist()] = x[:n], z
    incidence = casadi.sparsify(casadi.DM(network.incidence))
    f = incidence.T @ (network.coupling * casadi.sin(incidence @ theta))
    wanted = casadi.SX.zeros(network.n_bus)
    wanted[network.loads.tolist()] = p_load
    force = (u - f[network.generators.tolist()] - network.d * x[n:]) / network.m

    def start(instance: Instance) -> tuple[Array, Array, Array]:
        instance.check_case(case)
        state = plant.initial(instance)
        at = state.theta[network.generators], state.omega
        return np.concatenate(at), state.theta[network.algebraic], np.empty(0)

    rates, alg = casadi.vertcat(x[n:], force), (f - wanted)[network.algebraic.tolist()]
    none = casadi.SX.zeros(1)
    return CasadiModel(case, x, z, u, p_load, p, rates, alg, x[n:], u, f[network.slack], none, start)


def _detailed(plant: DetailedPlant) -> CasadiModel:
    case, system = plant.case, plant.system
    n, (u, p_load), scheduled = len(system.data), _inputs(case), system.scheduled.tolist()
    x, z = casadi.SX.sym("x", N_STATES * n), casadi.SX.sym("z", 2 * len(system.network.ports))
    p = casadi.SX.sym("p", 2 * n + 1)
    p_ref = p[n : 2 * n] + system.shares * p[-1]
    p_ref[scheduled] += u
    drawn = casadi.SX(casadi.DM(system.network.p_drawn))
    drawn[system.load_ports.tolist()] = -p_load
    rates, alg, p_e, p_m = system.symbolic.equations(x, z, p_ref, drawn, p[:n])
    speed = (x[SPEED * n : (SPEED + 1) * n] * system.data.omega_0)[scheduled]
    p_slack = casadi.SX.zeros(1) if system.island else p_e[system.network.balancing]
    gain = 0.0 if case.agc is None else case.agc.k
    held = -gain * casadi.dot(casadi.DM(system.data.inertia), x[DELTA * n : (DELTA + 1) * n])

    def start(instance: Instance) -> tuple[Array, Array, Array]:
        instance.check_case(case)
        state = plant.initial(instance)
        turned = state.v.view(np.complex128) * np.exp(1j * (system.data.inertia @ state.x[DELTA]))
        return state.x.ravel(), turned.view(np.float64), np.array([*state.v_ref, *state.offset, state.held])

    return CasadiModel(case, x, z, u, p_load, p, rates, alg, speed, p_m[scheduled], p_slack, held, start)
