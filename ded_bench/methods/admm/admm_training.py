"""Train `ded-admm` by CMA-ES on problems drawn afresh; no solution, no surrogate, no gradient is needed.

The covariance matrix adaptation evolution strategy (Hansen and Ostermeier 2001) compares candidates by
their loss on the same few problems, which are others in every generation. A running mean of its
distribution's mean averages that out; the policy keeps the one with the least loss on problems held out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cma
import numpy as np
from tqdm import tqdm

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.methods.admm.admm_inference import CompiledIterations, schedule_loss, weight_shapes
from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.methods.admm.modal_grid import ModalGrid
from ded_bench.methods.admm.problems import Problems, draw
from ded_bench.methods.island.island_training import train as train_on_island
from ded_bench.methods.policy_file import Scope, Weights, checked_weights, weights_fingerprint
from ded_bench.methods.trained_policy import TrainedPolicy
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file, write_history
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import score
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED

#: Weights fit every grid: training may start from another's.
TAKES_START = True
#: Iterations of an answer: the fewest, and times generators on small grids, where they take less time. Where
#: the bound on |ω| is loose, schedules are shaped by ramps, and a few iterations go almost as far.
TIGHT, LOOSE = (14, 60), (3, 30)
#: A bound is loose if a generator that ramps alone, at its limit, turns at less than this part of it.
RAMPING = 0.1
#: Generations of an epoch, epochs.
STEPS, EPOCHS = 10, 24
#: Candidates of a generation, and problems on which they are compared.
CANDIDATES, BATCH = 14, 16
#: First standard deviation of the weights: penalties change by factors of e^±0.5.
SIGMA = 0.5
#: What a running mean keeps from one generation to the next.
KEEP = 0.9
#: Of candidates that lead to no number.
WORST = 1e3
#: The policy is trained on a bound tighter by this fraction, so that small excesses stay within the true one.
MARGIN = 0.015
#: Penalty, as a part of an instance's cost, of which half counts: a few instances have no feasible schedule,
#: and would else be all that is learned from.
HOPELESS = 0.1
#: Most instances on which weights are compared.
HELD_OUT = 100
#: Margins of the answering policy that are tried by simulation, as fractions of the bound, in this order.
MARGINS = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.2, 0.25)
#: The first that keeps so large a part of the instances within the scorer's tolerance is taken.
WANTED = 0.98
#: So many margins after the best so far, none better, end the search.
PATIENCE = 3
#: Most instances that are simulated with each margin.
SIMULATED = 50


def train(
    case: Case, regime: str, instances: Sequence[Instance], out: Path, options: TrainingOptions, /
) -> TrainedPolicy:
    """Train a policy; see `training_record.Trainer`.

    Args:
        instances: choose the best weights and the margin, and are never trained on, but for islands.
    """
    if case.slack is None:
        return train_on_island(case, regime, instances, out, options)
    horizon = instances[0].horizon_s
    grid = ModalGrid(case, case.omega_bound(regime), horizon)
    start = read_start(options.start) if options.start else None
    run = Search(grid, start, Problems.of(case, instances[:HELD_OUT], grid.points), out, options)
    with np.errstate(over="ignore", invalid="ignore"):  # a draw may swing up without end
        facts = run.train(f"{AdmmPolicy.method} {regime}")
    weights = {"nodes": run.best_weights.astype(np.float32)}
    policy = with_margin(AdmmPolicy(Scope(case, regime, horizon), weights, facts), instances)
    policy.save(out)
    return policy


def iterations_of(grid: ModalGrid) -> int:
    """Iterations of an answer, by the size of a case and how tight its bound is."""
    rates = grid.ramp / (np.diag(grid.stiffness) * grid.spacing)
    fewest, rounds = LOOSE if np.median(rates) < RAMPING * grid.bound else TIGHT
    return max(fewest, rounds // len(rates))


def read_start(path: Path) -> Weights:
    """Weights of a policy of whatever grid and regime, to start from.

    Raises:
        InputError: the file is wrong, or a policy of another method.
    """
    arrays, header = read_arrays(path)
    if header.get("method") != AdmmPolicy.method:
        raise InputError(path, "method", f"is no {AdmmPolicy.method} policy")
    return checked_weights(arrays, weight_shapes(), path)


class Judge:
    """What weights are worth on some problems; what does not depend on weights is prepared once."""

    def __init__(self, grid: ModalGrid, iterations: int, problems: Problems) -> None:
        self.grid, self.iterations, self.start = grid, iterations, grid.start(problems)
        self.linear = grid.along_first(self.start)
        self.served = self.start.served.copy()
        self.cost = problems.cost / self.start.scale[:, None]

    def __call__(self, weights: Array) -> Array:
        """Cost, penalty, excess over the bound as a part of it, of the last schedules, (n_served, 3).

        First schedules, which the policy answers with where the last are no better, would hide what weights
        do: where that is so on all problems, all weights would be worth the same.
        """
        grid, start = self.grid, self.start
        start.served[:] = self.served  # whatever weights before these led to
        iterate = CompiledIterations(grid, grid.bound, weights, self.iterations, only_better=False)
        powers = iterate(start, self.linear, start.schedule)
        x = grid.respond(powers, start, self.linear)[0]
        _, omega, p_slack = grid.respond(powers, start, grid.along(start, x))
        bound, spacing = (1.0 - MARGIN) * grid.bound, float(grid.points[1])
        given = zip(powers, omega, p_slack, self.cost, strict=True)
        found = [schedule_loss(*one, bound, spacing) for one in given]
        excess = np.maximum(np.abs(omega).max(axis=(1, 2)) / grid.bound - 1.0, 0.0)
        return np.column_stack([found, excess])[self.served]

    def loss(self, weights: Array) -> float:
        """Mean cost and penalty, of which large ones count less."""
        cost, penalty, _ = self(weights).T
        return _number((cost + penalty / (1.0 + penalty / HOPELESS)).mean()) if len(cost) else WORST


class Search:
    """The state of one training; a checkpoint holds the losses, from which the search is replayed."""

    def __init__(
        self, grid: ModalGrid, start: Weights | None, check: Problems, out: Path, options: TrainingOptions
    ) -> None:
        self.grid, self.iterations, self.out, self.options = grid, iterations_of(grid), out, options
        self.shape = weight_shapes()["nodes"]
        first = np.zeros(self.shape) if start is None else start["nodes"].astype(np.float64)
        random = np.random.default_rng(options.seed)
        own = {"popsize": CANDIDATES, "randn": lambda *shape: random.standard_normal(shape)}
        self.strategy = cma.CMAEvolutionStrategy(first.ravel(), SIGMA, own | {"seed": np.nan, "verbose": -9})
        self.check = Judge(grid, self.iterations, check)
        #: What a checkpoint must agree in.
        self.facts = {
            "seed": options.seed,
            "start": weights_fingerprint(start) if start is not None else "",
            "iterations": self.iterations,
            "batch": BATCH,
            "held_out": int(self.check.served.sum()),
        }
        self.losses: list[list[float]] = []
        self.history: list[dict[str, float]] = []
        self.mean, self.best_weights, self.best = first.copy(), first.copy(), math.inf
        self.spent, self.busy = 0.0, 0.0

    @property
    def epoch(self) -> int:
        """How many are done."""
        return len(self.history)

    def train(self, title: str) -> dict[str, Any]:
        """Train, from the checkpoint if asked; returns facts for the policy's file.

        Raises:
            InputError: the checkpoint is none, or one of another training.
        """
        options, epochs = self.options, self.options.epochs or EPOCHS
        if options.resume and checkpoint_file(self.out).is_file():
            self.load()
        began, busy = time.perf_counter() - self.spent, time.process_time() - self.busy
        with tqdm(total=epochs, initial=self.epoch, unit="epoch", disable=None, desc=title) as bar:
            while self.epoch < epochs:
                for _ in range(STEPS):
                    self._step()
                    self.spent, self.busy = time.perf_counter() - began, time.process_time() - busy
                    if options.seconds is not None and self.spent >= options.seconds:
                        epochs = self.epoch + 1
                        break
                self._look()
                bar.update()
                bar.set_postfix_str(f"loss {self.history[-1]['held out']:.6g}")
                self.save()
        write_history(self.out, self.history)
        done = {"epochs": self.epoch, "steps": len(self.losses), "instances": len(self.losses) * BATCH}
        spent = {"seconds": self.spent, "cpu_seconds": self.busy, "held_out_loss": self.best}
        made = {"parameters": self.mean.size, "cma": cma.__version__}
        return options.facts() | self.facts | done | spent | made

    def _step(self, losses: list[float] | None = None) -> None:
        """One generation; its losses are taken unless they are known."""
        candidates, grid = self.strategy.ask(), self.grid
        if losses is None:
            drawn = (POLICY_SEED + self.options.seed, len(self.losses) * BATCH, BATCH)
            judge = Judge(grid, self.iterations, draw(grid.case, grid.bound, grid.points, *drawn))
            losses = [judge.loss(one.reshape(self.shape)) for one in candidates]
        self.strategy.tell(candidates, losses)
        self.losses.append(losses)
        share = max(1.0 - KEEP, 1.0 / len(self.losses))
        self.mean += share * (self.strategy.mean.reshape(self.shape) - self.mean)

    def _look(self, row: dict[str, float] | None = None) -> None:
        """Judge the running mean on what is held out, unless that is known; the best so far is kept."""
        if row is None:
            cost, penalty, excess = self.check(self.mean).T
            hertz = excess * self.grid.bound / (2 * math.pi)
            row = {"epoch": self.epoch + 1, "step": len(self.losses), "seconds": self.spent}
            row |= {"held out": _number((cost + penalty).mean()), "cost": _number(cost.mean())}
            row |= {"mean excess": _number(hertz.mean()), "max excess": _number(hertz.max())}
        self.history.append(row)
        if row["held out"] < self.best:
            self.best, self.best_weights = row["held out"], self.mean.copy()

    def save(self) -> None:
        """Write the checkpoint."""
        rows = np.array([list(row.values()) for row in self.history])
        arrays = {
            "losses": np.array(self.losses),
            "history": rows,
            "spent": np.array([self.spent, self.busy]),
        }
        write_arrays(checkpoint_file(self.out), arrays, self.facts | {"columns": list(self.history[0])})

    def load(self) -> None:
        """Replay the search of the checkpoint, which is read without trust.

        Raises:
            InputError: it is no checkpoint, or one of another training.
        """
        path = checkpoint_file(self.out)
        try:
            arrays, header = read_arrays(path)
            if any(header[name] != value for name, value in self.facts.items()):
                raise ValueError
            rows = [dict(zip(header["columns"], row, strict=True)) for row in arrays["history"].tolist()]
            for losses in arrays["losses"].tolist():
                self._step(losses)
                if len(self.losses) == rows[self.epoch]["step"]:
                    self._look(rows[self.epoch])
            self.spent, self.busy = arrays["spent"].tolist()
        except (InputError, LookupError, TypeError, ValueError):
            problem = "is no checkpoint of this training; remove it, or train without --resume"
            raise InputError(path, "", problem) from None


def _number(value: Any) -> float:
    return float(np.nan_to_num(value, nan=WORST, posinf=WORST))


def with_margin(policy: AdmmPolicy, instances: Sequence[Instance]) -> AdmmPolicy:
    """The policy with the least margin that makes enough of its schedules feasible on the true system.

    Where no margin does, the one with most feasible schedules of those tried, and of several the least.

    Args:
        policy: trained; its margin so far counts for nothing.
        instances: not those that it will be judged on. Those that cannot be scored count as infeasible.
    """
    found: list[tuple[float, AdmmPolicy]] = []
    for margin in MARGINS:
        tried = dataclasses.replace(policy, training=policy.training | {"margin": margin})
        share = _feasible_share(tried, instances[:SIMULATED])
        facts = tried.training | {"margin_feasible": share, "margin_instances": len(instances[:SIMULATED])}
        found.append((share, dataclasses.replace(tried, training=facts)))
        best = max(found, key=lambda pair: pair[0])
        if share >= WANTED or len(found) - found.index(best) > PATIENCE:
            break
    return best[1]


def _feasible_share(policy: AdmmPolicy, instances: Sequence[Instance]) -> float:
    case, regime, found = policy.scope.case, policy.scope.regime, 0
    for instance, schedule in zip(instances, policy(instances), strict=True):
        with contextlib.suppress(SimulationError):
            found += score(case, instance, schedule, regime).feasible
    return found / len(instances)
