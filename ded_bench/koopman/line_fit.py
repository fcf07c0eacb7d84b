"""Line weights and damping fitted to whole rollouts: Gauss-Newton with exact sensitivities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ded_bench.koopman.energy_form import steady_state
from ded_bench.koopman.line_form import Dynamics, LineForm, Step, discretise
from ded_bench.koopman.model import linear_recurrence
from ded_bench.problem.case import Array

#: Inputs and outputs are taken at every so many steps, inputs as linear in between.
STRIDE = 10
#: A parameter that changes by one costs this part of the error at the start: lines that the data say
#: nothing about keep their weight.
RIDGE = 1e-3
#: Levenberg and Marquardt's damping: at the start, and its factor after a step that succeeds or fails.
DAMPING, FACTOR = 1e-3, 5.0
#: Stop after so many steps, or if one lowers the error by a smaller part than this.
STEPS, ENOUGH = 12, 1e-4
#: Jacobians of a few trajectories at a time have at most so many numbers.
JACOBIAN_NUMBERS = 50_000_000


class Task(NamedTuple):
    """Rollouts to reproduce, at every STRIDE-th grid point."""

    form: LineForm
    step_s: float
    psi: Array  # ψ_0, (batch, n)
    inputs: Array  # (n_points, batch, n_in), pu
    outputs: Array  # (ω, P_s), (n_points, batch, n_gen + 1)
    unit: Array  # of the residuals, (batch, n_gen + 1)


class Fit(NamedTuple):
    """Parameters, and their error relative to that of the linearisation."""

    x: Array
    relative_cost: float
    steps: int


def fit_lines(form: LineForm, dt_s: float, psi: Array, inputs: Array, outputs: Array) -> Fit:
    """Least squares over whole rollouts.

    Residuals of ω and of P_s are relative to the root mean square that the linearisation leaves on the same
    trajectory, so that mild and wild schedules count alike.

    Args:
        form: the parametrised model.
        dt_s: grid step of inputs and outputs, s.
        psi: ψ_0, shape (batch, n).
        inputs: at all grid points, shape (n_points, batch, n_in), pu.
        outputs: (ω, P_s), shape (n_points, batch, n_gen + 1).
    """
    x, n_gen = np.zeros(form.n_parameters), outputs.shape[2] - 1
    unscaled = np.ones(outputs.shape[1:])
    task = Task(form, STRIDE * dt_s, psi, inputs[::STRIDE], outputs[::STRIDE], unscaled)
    square = np.square(_residuals(task, x)).mean(axis=0)
    square[:, :n_gen] = square[:, :n_gen].mean(axis=1, keepdims=True)
    task = task._replace(unit=np.sqrt(np.where(square > 0.0, square, 1.0)))
    start = cost = _cost(task, x, 0.0)
    ridge = RIDGE * cost
    damping, steps = DAMPING, 0
    while steps < STEPS:
        hessian, gradient = _normal_equations(task, x, ridge)
        steps, before = steps + 1, cost
        while damping < 1.0 / DAMPING:
            damped = hessian + damping * np.diag(np.diag(hessian))
            candidate = x - np.linalg.solve(damped, gradient)
            value = _cost(task, candidate, ridge)
            if value < cost:
                x, cost, damping = candidate, value, damping / FACTOR
                break
            damping *= FACTOR
        if before - cost < ENOUGH * before:
            break
    return Fit(x, cost / start, steps)


def sensitivities(step: Step, b: Array, psi: Array, inputs: Array, n_outputs: int) -> tuple[Array, Array]:
    """The first outputs of a rollout and their derivatives by parameter.

    Args:
        step: the model's step and its derivatives.
        b: B, shape (n, n_in).
        psi: ψ_0, shape (batch, n).
        inputs: shape (n_points, batch, n_in), pu.
        n_outputs: how many entries of ψ are outputs.

    Returns:
        Shapes (n_points, batch, n_outputs) and (n_points, batch, n_outputs, n_parameters).
    """
    n_parameters, n, _ = step.dk.shape
    n_points, batch, _ = inputs.shape
    steady, change = inputs @ b.T, np.diff(inputs, axis=0)
    by_state_and_change = np.concatenate([step.dk, step.dh], axis=2).reshape(n_parameters * n, -1).T
    by_state_and_change = np.ascontiguousarray(by_state_and_change)
    deviation, derivative = psi - steady[0], np.zeros((batch, n_parameters, n))
    outputs = np.empty((n_points, batch, n_outputs))
    jacobian = np.zeros((n_points, batch, n_outputs, n_parameters))
    outputs[0] = psi[:, :n_outputs]
    for i, moved in enumerate(change):
        forced = np.concatenate([deviation, moved], axis=1) @ by_state_and_change
        derivative = derivative @ step.k.T + forced.reshape(derivative.shape)
        deviation = deviation @ step.k.T + moved @ step.h.T
        outputs[i + 1] = (deviation + steady[i + 1])[:, :n_outputs]
        jacobian[i + 1] = derivative[:, :, :n_outputs].swapaxes(1, 2)
    return outputs, jacobian


def _residuals(task: Task, x: Array) -> Array:
    step, b = _step(task, x), steady_state(task.form.case)
    steady = task.inputs @ b.T
    deviation = linear_recurrence(step.k, task.psi - steady[0], np.diff(task.inputs, axis=0) @ step.h.T)
    n_outputs = task.outputs.shape[2]
    return np.asarray(((deviation + steady)[..., :n_outputs] - task.outputs) / task.unit)


def _cost(task: Task, x: Array, ridge: float) -> float:
    return float(np.square(_residuals(task, x)).sum() + ridge * (x @ x))


def _step(task: Task, x: Array) -> Step:
    """The step at x without derivatives."""
    whole = task.form.dynamics(x)
    value = Dynamics(whole.a, whole.f, whole.da[:0], whole.df[:0])
    return discretise(value, steady_state(task.form.case), task.step_s)


def _normal_equations(task: Task, x: Array, ridge: float) -> tuple[Array, Array]:
    """Half the Gauss-Newton Hessian of the cost, and half its gradient."""
    b, n_outputs = steady_state(task.form.case), task.outputs.shape[2]
    step = discretise(task.form.dynamics(x), b, task.step_s)
    hessian, gradient = ridge * np.eye(len(x)), ridge * x
    each = len(task.inputs) * n_outputs * len(x)
    chunk = max(1, JACOBIAN_NUMBERS // each)
    for first in range(0, len(task.psi), chunk):
        part = slice(first, first + chunk)
        outputs, jacobian = sensitivities(step, b, task.psi[part], task.inputs[:, part], n_outputs)
        residual = ((outputs - task.outputs[:, part]) / task.unit[part]).ravel()
        jacobian /= task.unit[part, :, None]
        rows = jacobian.reshape(-1, len(x))
        hessian += rows.T @ rows
        gradient += rows.T @ residual
    return hessian, gradient
