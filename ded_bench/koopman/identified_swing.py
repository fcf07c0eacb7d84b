"""Swing equations whose electrical powers were identified from trajectories: no equation of a network.

    dθ/dt = ω,    M dω/dt = -D ω - p(θ, P_load) + P,    P_s = p_s(θ, P_load)

Machines are known, p and p_s are polynomials (see `identify_swing`). They say nothing beyond their data:
a simulation ends where a state is farther from these than any of them was.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.koopman.trajectory import Indices, TrajectoryModel, time_varying
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.state import State
from ded_bench.truth.integrator import Inputs
from ded_bench.truth.network import Network, PowerFlowError
from ded_bench.truth.simulate import METHOD, STEP_BY_MODE, SimulationError, Trajectory

if TYPE_CHECKING:
    from ded_bench.koopman.swing_integrator import Polynomial

#: The name of the kind in files and rows.
KIND = "swing-ac"
SCHEMA = "ded-bench/swing/1"
#: The equilibrium of P_0 is approached from the middle of the data in so many parts, by so many steps each.
PARTS, NEWTON_STEPS = 20, 20
#: Generators deliver their powers within this, pu.
MISMATCH = 1e-10


@dataclass(frozen=True, eq=False)
class IdentifiedSwing:
    """One case's machines and the polynomials of their electrical powers."""

    case: Case
    law: Polynomial
    training: dict[str, Any]
    kind: str = KIND

    @property
    def machines(self) -> Array:
        """Inertia and damping of the generators, shape (2, n_gen)."""
        return machines_of(self.case)

    def power(self, theta: Array, p_load: Array) -> tuple[Array, Array]:
        """Electrical powers and their slopes.

        Args:
            theta: angles of the generators, shape (n, n_gen), rad.
            p_load: loads, shape (n, n_load), pu.

        Returns:
            Powers of the machines, the slack's last, (n, n_gen + 1), pu; their derivatives by the angles,
            (n, n_gen + 1, n_gen), pu/rad.
        """
        law, n_gen = self.law, theta.shape[-1]
        z = (np.hstack([theta, p_load]) - law.centre) / law.scale
        monomial, slope = monomials(law.parent, law.factor, z, n_gen)
        by_angle = np.einsum("nmg,mp->npg", slope, law.weight) / law.scale[:n_gen]
        return monomial @ law.weight, by_angle

    def initial_state(self, instance: Instance) -> State:
        """Angles so that every generator delivers P_0, or what it delivers at the angles that are given.

        These are angles of the lossless network, and say which electrical powers were measured: at the same
        angles this model would deliver others, and start far from what was measured.

        Raises:
            SimulationError: there are no such angles near the data, or none of the lossless network.
        """
        theta, omega = instance.theta_initial(self.case), instance.omega_initial(self.case)
        p_gen, p_load = instance.p_initial(self.case), instance.p_load(self.case, np.zeros(1))[0]
        electrical = p_gen
        if theta is not None:
            network = Network(self.case)
            try:
                angles = network.angles(State(theta, omega, p_gen), p_load)
            except PowerFlowError as error:
                raise SimulationError(f"the lossless network has no such state: {error}") from None
            electrical = network.injections(angles)[network.generators]
        return State(self._angles(electrical, p_load), omega, p_gen)

    def _angles(self, p_gen: Array, p_load: Array) -> Array:
        """Where the generators deliver these powers, rad."""
        n_gen = len(p_gen)
        theta, middle = self.law.centre[:n_gen].copy(), self.law.centre[n_gen:]
        first = self.power(theta[None], middle[None])[0][0, :n_gen]
        for part in np.arange(1, PARTS + 1) / PARTS:
            wanted, load = first + part * (p_gen - first), middle + part * (p_load - middle)
            for _ in range(NEWTON_STEPS):
                power, slope = (value[0, :n_gen] for value in self.power(theta[None], load[None]))
                if np.abs(power - wanted).max() < MISMATCH:
                    break
                theta = theta + np.linalg.solve(slope, wanted - power)
            else:
                raise SimulationError("the identified swing equations have no angles for these powers")
        return theta

    def simulate(self, instance: Instance, schedule: Schedule) -> Trajectory:
        """What this model says about one schedule; angles of buses without a generator are NaN.

        Raises:
            SimulationError: it leads beyond the data, or there is no equilibrium at t = 0.
        """
        from ded_bench.koopman.swing_integrator import integrate_swing  # and with it Numba

        first, case = self.initial_state(instance), self.case
        p_gen, p_load = schedule.at(instance.grid), instance.p_load(case)
        theta, omega, p_slack = np.empty(p_gen.shape), np.empty(p_gen.shape), np.empty(len(p_gen))
        theta[0], omega[0] = first.theta, first.omega
        stiffness = self.power(theta[:1], p_load[:1])[1][0, :-1]
        fastest = np.sqrt(np.abs(np.linalg.eigvals(stiffness / self.machines[0][:, None])).max())
        steps = max(int(np.ceil(fastest * instance.dt_s / STEP_BY_MODE)), 1)
        inputs = Inputs(np.ascontiguousarray(p_gen), np.ascontiguousarray(p_load), instance.dt_s)
        done = integrate_swing(METHOD, self.law, self.machines, inputs, steps, theta, omega, p_slack)
        if done < len(p_gen):
            raise SimulationError("this schedule leads beyond the data of the identified swing equations")
        angles = np.full((len(theta), len(case.buses)), np.nan)
        angles[:, generator_places(case)] = theta
        return Trajectory(instance.grid, angles, omega, p_gen, p_load, p_slack, case)

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TrajectoryModel:
        """`trajectory.linearise_along` of these equations.

        Args:
            trajectory: of `simulate`.
            points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        """
        middle = (points[:-1] + points[1:]) // 2
        theta = trajectory.theta[middle][:, generator_places(self.case)]
        _, slope = self.power(theta, trajectory.p_load[middle])
        return time_varying(trajectory, points, slope[:, :-1], slope[:, -1], *self.machines)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when the model's numbers do."""
        parts = [np.ascontiguousarray(value).tobytes() for value in self.law]
        return hashlib.sha256(b"".join([*parts, self.case.fingerprint.encode()])).hexdigest()[:12]

    def save(self, path: Path) -> None:
        """Write arrays and header (see `files.arrays`)."""
        arrays = {name: np.asarray(value, dtype=np.float64) for name, value in self.law._asdict().items()}
        header = {
            "schema": SCHEMA,
            "kind": self.kind,
            "case": self.case.id,
            "case_fingerprint": self.case.fingerprint,
            "training": self.training,
        }
        write_arrays(path, arrays, header)

    @staticmethod
    def load(path: str | Path, case: Case) -> IdentifiedSwing:
        """Read a model of `case`.

        Raises:
            InputError: the file is wrong or belongs to another case.
        """
        from ded_bench.koopman.swing_integrator import Polynomial

        arrays, header = read_arrays(path)
        if header.get("schema") != SCHEMA:
            raise InputError(path, "schema", f"expected {SCHEMA!r}")
        if header.get("case_fingerprint") != case.fingerprint:
            raise InputError(path, "case", f"was identified on another case than {case.id!r} as it is now")
        n_gen = len(case.generators)
        n_x, n = n_gen + len(case.loads), arrays.get("parent", np.zeros(0)).size
        shapes = {
            "centre": (n_x,),
            "scale": (n_x,),
            "parent": (n,),
            "factor": (n,),
            "weight": (n, n_gen + 1),
            "shape": (n_x, n_x),
            "reach": (1,),
        }
        for name, shape in shapes.items():
            if name not in arrays or arrays[name].shape != shape:
                raise InputError(path, name, f"must be an array of shape {shape}")
        parent, factor = (arrays[name].astype(np.intp) for name in ("parent", "factor"))
        inside = (parent >= 0) & (parent < np.maximum(np.arange(n), 1)) & (factor >= 0) & (factor < n_x)
        if not n or not inside.all() or not (arrays["scale"] > 0).all():
            raise InputError(path, "", "describes no polynomial")
        law = Polynomial(
            arrays["centre"],
            arrays["scale"],
            parent,
            factor,
            arrays["weight"],
            arrays["shape"],
            float(arrays["reach"][0]),
        )
        return IdentifiedSwing(case, law, dict(header.get("training") or {}))


def monomials(parent: Indices, factor: Indices, z: Array, n_gen: int) -> tuple[Array, Array]:
    """All monomials, shape (n, n_monomial), and their derivatives by the first variables.

    Args:
        parent, factor: see `Polynomial`.
        z: scaled variables, shape (n, n_x).
        n_gen: how many variables have derivatives.

    Returns:
        Monomials, and their derivatives, shape (n, n_monomial, n_gen).
    """
    value, slope = np.ones((len(z), len(parent))), np.zeros((len(z), len(parent), n_gen))
    for i in range(1, len(parent)):
        before, j = parent[i], factor[i]
        value[:, i] = value[:, before] * z[:, j]
        if n_gen:
            slope[:, i] = slope[:, before] * z[:, j, None]
            if j < n_gen:
                slope[:, i, j] += value[:, before]
    return value, slope


def machines_of(case: Case) -> Array:
    """Inertia (s² pu/rad) and damping (s pu/rad) of the generators, shape (2, n_gen)."""
    machines = [case.machines[bus] for bus in case.generators]
    return np.array([[machine.m for machine in machines], [machine.d for machine in machines]])


def generator_places(case: Case) -> Indices:
    """Where the generators stand among the case's buses, shape (n_gen,)."""
    place = {bus.id: i for i, bus in enumerate(case.buses)}
    return np.array([place[bus] for bus in case.generators])
