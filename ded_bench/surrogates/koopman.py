"""The Koopman surrogate: observables, K, B and G; its rollout, step by step and condensed.

    ψ(x) = (ω, P_s, N(x))
    ψ_{k+1} = K (ψ_k - B P_k) + B P_k + G (P_{k+1} - P_k)

G = 0 is the paper's eq. (KO_dyn); G = (I - K) B is the same form with the newer input sample; any
other G is a first-order hold. Inputs are P = (generators, loads). B's ω rows are zero and its P_s
row is -1, so equilibria are exact: ψ = B P gives ω = 0 and P_s = -Σ P.

A rollout is affine in its inputs, and a schedule is linear between knots, so that

    (ω, P_s) = free response + Γ knots

where the free response has ψ_0 and the loads but no generator power (`CondensedRollout`).
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.files.table import plain_name
from ded_bench.plants.hold import Hold, repeated
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import Instance

SCHEMA = "ded-bench/koopman/1"


@dataclass(frozen=True, eq=False)
class Koopman:
    """A linear model of (ω, P_s) under generator and load inputs, for one case and time step.

    `lift` maps the features (f at all buses, θ at all buses, ω, P_load, 1) to ψ; an MLP of the
    paper's x = (θ_gen, P_s, ω), with tanh layers, may add to the last rows of ψ.
    """

    kind: str
    case: Case
    dt_s: float
    k: Array  # (n_psi, n_psi)
    b: Array  # (n_psi, n_gen + n_load)
    g: Array  # (n_psi, n_gen + n_load)
    lift: Array  # (n_psi, 2 n_bus + n_gen + n_load + 1)
    mlp: tuple[tuple[Array, Array], ...] = ()  # (weight, bias) of each layer
    training: dict[str, Any] = field(default_factory=dict)
    path: Path | None = None  # the file that it was read from

    @functools.cached_property
    def network(self) -> Network:
        """Of the case."""
        return Network(self.case)

    def observables(self, theta: Array, omega: Array, p_load: Array) -> Array:
        """ψ(x), shape (..., n_psi), from angles (..., n_bus), ω (..., n_gen), loads (..., n_load)."""
        network = self.network
        injections = network.injections(theta)
        one = np.ones((*theta.shape[:-1], 1))
        psi = np.concatenate([injections, theta, omega, p_load, one], axis=-1) @ self.lift.T
        if self.mlp:
            slack = injections[..., [network.slack]]
            x = np.concatenate([theta[..., network.generators], slack, omega], axis=-1)
            for weight, bias in self.mlp[:-1]:
                x = np.tanh(x @ weight.T + bias)
            weight, bias = self.mlp[-1]
            psi[..., -len(bias) :] += x @ weight.T + bias
        return psi

    def initial(self, instances: Sequence[Instance]) -> Array:
        """ψ(x_0) of instances, shape (batch, n_psi)."""
        theta = np.stack([self.network.initial_angles(i) for i in instances])
        omega = np.stack([i.omega_initial(self.case) for i in instances])
        p_load = np.stack([i.p_load(self.case, np.zeros(1))[0] for i in instances])
        return self.observables(theta, omega, p_load)

    def rollout(self, psi: Array, inputs: Array, columns: slice = slice(None), stride: int = 1) -> Array:
        """Run the model from ψ_0.

        A step of `stride` points sums what the input increments inside it contribute at its end.

        Args:
            psi: ψ_0, shape (..., n_psi).
            inputs: P at all points, shape (n_points, ..., n_columns), pu.
            columns: which of the model's inputs these are; the others are zero.
            stride: ψ is wanted at every so many points; it divides the number of steps.

        Returns:
            ψ there, shape (n_steps / stride + 1, ..., n_psi).
        """
        b = self.b[:, columns]
        steady = inputs[::stride] @ b.T
        at_end, power = [(self.g[:, columns] - b).T], self.k
        for _ in range(stride - 1):
            at_end.append(at_end[-1] @ self.k.T)
            power = power @ self.k
        change = np.diff(inputs, axis=0)
        change = np.moveaxis(change.reshape(len(steady) - 1, stride, *change.shape[1:]), 1, -2)
        change = change.reshape(*change.shape[:-2], stride * inputs.shape[-1])
        increments = change @ np.concatenate(at_end[::-1])
        start = np.broadcast_to(psi - steady[0], np.broadcast_shapes(psi.shape, steady.shape[1:]))
        increments = np.broadcast_to(increments, (len(increments), *start.shape))
        return linear_recurrence(power, start, increments) + steady

    def along(self, instance: Instance, p_gen: Array, points: Indices, *_: object) -> TimeVarying:
        """The linear model of one instance by which it answers to schedules linear between knots.

        It is made around its own rollout, with K, B and G those of all intervals: answers do not depend
        on `p_gen` but for round-off.

        Args:
            instance: x_0 and the loads.
            p_gen: powers at the knots, shape (n_knots, n_gen), pu.
            points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
            _: what else other surrogates take.

        Raises:
            InputError: the model has another time step than the instance.
        """
        self.check_step(instance)
        n_gen, lengths = len(self.case.generators), np.diff(points)
        psi = self.initial([instance])[0]
        steps = np.arange(points[-1] + 1)
        powers = np.stack([np.interp(steps, points, p) for p in p_gen.T], axis=1)
        outputs = self.rollout(psi, np.hstack([powers, instance.p_load(self.case)]))
        b, h = self.b[:, :n_gen], self.g[:, :n_gen]
        one = Hold(self.k[None], (b - self.k @ b)[None], h[None])
        kinds, kind = np.unique(lengths, return_inverse=True)
        over = [repeated(one, int(length)) for length in kinds]
        slack = np.zeros((1, len(psi)))
        slack[0, n_gen] = 1.0
        return TimeVarying(
            points=points,
            step=Hold(*(np.broadcast_to(part, (len(lengths), *part.shape[1:])) for part in one)),
            across=Hold(*(np.concatenate(parts)[kind] for parts in zip(*over, strict=True))),
            speed=slice(0, n_gen),
            slack=np.broadcast_to(slack, (len(lengths), len(psi))),
            omega=outputs[:, :n_gen],
            p_slack=outputs[:, n_gen],
            p_gen=p_gen,
        )

    def check_step(self, instance: Instance) -> None:
        """Raise InputError unless the model's time step is the instance's."""
        if abs(self.dt_s - instance.dt_s) > 1e-9 * instance.dt_s:
            problem = f"is {instance.dt_s:g}, but the model {self.kind} has steps of {self.dt_s:g}"
            raise InputError(f"instance {instance.id}", "dt_s", problem)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when the model's arrays do."""
        arrays = [self.k, self.b, self.g, self.lift, *(a for layer in self.mlp for a in layer)]
        return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()[:12]

    def __eq__(self, other: object) -> bool:
        """Equal arrays: models are keys of what is made once for each."""
        return isinstance(other, Koopman) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def save(self, path: Path) -> None:
        """Write arrays and header (see `files.arrays`)."""
        arrays = {"k": self.k, "b": self.b, "g": self.g, "lift": self.lift}
        for i, (weight, bias) in enumerate(self.mlp):
            arrays |= {f"mlp.{i}.weight": weight, f"mlp.{i}.bias": bias}
        header = {
            "schema": SCHEMA,
            "kind": self.kind,
            "case": self.case.id,
            "case_fingerprint": self.case.fingerprint,
            "dt_s": self.dt_s,
            "training": self.training,
        }
        write_arrays(path, arrays, header)

    @staticmethod
    def load(path: str | Path, case: Case) -> Koopman:
        """Read a model of `case`.

        Raises:
            InputError: the file is wrong or belongs to another case.
        """
        arrays, header = read_arrays(path)
        if header.get("schema") != SCHEMA:
            raise InputError(path, "schema", f"expected {SCHEMA!r}")
        if header.get("case_fingerprint") != case.fingerprint:
            raise InputError(path, "case", f"was identified on another case than {case.id!r} as it is now")
        try:
            layers = sum(name.endswith(".bias") for name in arrays)
            mlp = tuple((arrays[f"mlp.{i}.weight"], arrays[f"mlp.{i}.bias"]) for i in range(layers))
            model = Koopman(
                kind=plain_name(str(header["kind"])),  # it stands in rows, and in the names of files
                case=case,
                dt_s=float(header["dt_s"]),
                training=dict(header["training"]),
                path=Path(path),
                mlp=mlp,
                **{name: arrays[name] for name in ("k", "b", "g", "lift")},
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(path, str(error).strip("'")[:60], "is missing or mistyped") from None
        if not 0 < model.dt_s < float("inf"):
            raise InputError(path, "dt_s", "is no positive number of seconds")
        model._check_shapes(path, case)
        return model

    def _check_shapes(self, path: str | Path, case: Case) -> None:
        n = self.k.shape[0] if self.k.ndim else 0
        n_gen, n_in = len(case.generators), len(case.generators) + len(case.loads)
        wanted = {"k": (n, n), "b": (n, n_in), "g": (n, n_in), "lift": (n, 2 * case.n_bus + n_in + 1)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise InputError(path, name, f"has shape {getattr(self, name).shape}, expected {shape}")
        width = 2 * n_gen + 1
        for i, (weight, bias) in enumerate(self.mlp):
            if bias.ndim != 1 or weight.shape != (len(bias), width):
                raise InputError(path, f"mlp.{i}", "has the wrong shape")
            width = len(bias)
        if n < n_gen + 1 or (width > n - n_gen - 1 and self.mlp):
            raise InputError(path, "k", "has too few observables")


def linear_recurrence(k: Array, start: Array, increments: Array) -> Array:
    """All x_i of x_{i+1} = K x_i + u_i: pairs of steps are one step with K², and so on.

    Args:
        k: K, shape (n, n).
        start: x_0, shape (..., n).
        increments: u_i, shape (n_steps, ..., n).

    Returns:
        Shape (n_steps + 1, ..., n).
    """
    n_steps = len(increments)
    if n_steps < 2:
        return np.concatenate([start[None], start @ k.T + increments])
    if n_steps % 2:
        increments = np.append(increments, np.zeros_like(increments[:1]), axis=0)
    first, second = increments[::2], increments[1::2]
    x = np.empty((len(increments) + 1, *start.shape))
    x[::2] = linear_recurrence(k @ k, start, first @ k.T + second)
    x[1::2] = x[:-1:2] @ k.T + first
    return x[: n_steps + 1]


@dataclass(frozen=True, eq=False)
class CondensedRollout:
    """(ω, P_s) at the points of a time grid, or at every `stride`-th of them, from powers at knots."""

    model: Koopman
    stride: int
    knots: Array  # times, (n_knots,), s
    points: Array  # times, (n_points,), s
    gamma: Array  # Γ by output, (n_gen + 1, n_points, n_knots n_gen): ω in rad/s, P_s in pu, per pu
    hat_weights: Array  # sum over the whole grid of each knot's hat function, (n_knots,)
    quadrature_weights: Array  # a sum over the whole grid, taken at the points, (n_points,)

    @staticmethod
    def make(model: Koopman, grid: Array, knots: Array, stride: int = 1) -> CondensedRollout:
        """Condense a model.

        Args:
            model: the surrogate; its step is that of the grid.
            grid: times t_k, shape (n_grid,), s.
            knots: knot times, shape (n_knots,), s.
            stride: outputs are taken at every so many grid points; it divides the number of steps.
        """
        n_gen, points = len(model.case.generators), grid[::stride]
        hats = hat_functions(grid, knots)
        gamma = np.empty((n_gen + 1, len(points), len(knots), n_gen))
        at_rest = np.zeros((len(knots), len(model.k)))
        for g in range(n_gen):  # one generator at a time: the states of all would fill the memory
            response = model.rollout(at_rest, hats[:, :, None], slice(g, g + 1), stride)
            gamma[..., g] = np.moveaxis(response[..., : n_gen + 1], 2, 0)
        by_output = gamma.reshape(n_gen + 1, len(points), -1)
        sums = hat_functions(grid, points).sum(axis=0) if stride > 1 else np.ones(len(grid))
        return CondensedRollout(model, stride, knots, points, by_output, hats.sum(axis=0), sums)


def free_response(model: Koopman, psi: Array, p_load: Array, stride: int = 1) -> Array:
    """(ω, P_s) without generator power, at every `stride`-th grid point.

    Args:
        model: the surrogate.
        psi: ψ_0, (batch, n_psi).
        p_load: load injections at all grid points, (batch, n_grid, n_load), pu.
        stride: divides the number of steps.

    Returns:
        Shape (batch, n_gen + 1, n_points): rad/s, pu.
    """
    n_gen = len(model.case.generators)
    response = model.rollout(psi, p_load.swapaxes(0, 1), slice(n_gen, None), stride)
    return np.moveaxis(response[..., : n_gen + 1], 0, 2)


def hat_functions(grid: Array, knots: Array) -> Array:
    """Linear interpolation as a matrix, shape (n_grid, n_knots): values(grid) = hats @ values(knots)."""
    return np.stack([np.interp(grid, knots, row) for row in np.eye(len(knots))], axis=1)
