"""DED-DPC (`ded-dpc`): a network corrects the static dispatch; bounds, ramps and P_0 hold for any weights."""

from __future__ import annotations

import functools
import io
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ded_bench.methods.dpc.follower import follow
from ded_bench.methods.dpc.inputs import Channels, Inputs, n_channels
from ded_bench.methods.dpc.loss import knot_times
from ded_bench.methods.dpc.network import NumpyNetwork, ResidualNetwork
from ded_bench.methods.dpc.settings import SETTINGS as SETTINGS
from ded_bench.methods.dpc.store import (
    Scope,
    find_policy_file,
    load_weights,
    read_policy,
    weights_fingerprint,
    write_policy,
)
from ded_bench.methods.solution import Settings, Solution, Solver, Status
from ded_bench.problem.case import Array, Case
from ded_bench.problem.errors import InputError
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.problem.strict import write_atomically

METHOD = "ded-dpc"
N_KNOTS = 50
MAX_WIDTH = 4096
#: Instances worked on at once: what is computed on the way stays in a core's cache.
CHUNK = 32


@dataclass(frozen=True, eq=False)
class DispatchPolicy:
    """A trained network with all that is needed to apply it."""

    scope: Scope
    network: ResidualNetwork
    training: dict[str, Any]

    @functools.cached_property
    def knots(self) -> Array:
        """Knot times, shape (n_knots,), s."""
        return knot_times(self.scope.horizon_s, N_KNOTS)

    @functools.cached_property
    def _numpy(self) -> NumpyNetwork:
        return NumpyNetwork(self.network)

    def __call__(self, instances: Instance | Sequence[Instance]) -> list[Schedule]:
        """Schedules of one instance or several, on the knots.

        Raises:
            InputError: an instance belongs to another case or horizon.
        """
        batch = [instances] if isinstance(instances, Instance) else list(instances)
        self.scope.check(batch)
        if not batch:
            return []
        return [Schedule(self.knots, p) for p in self.powers(Inputs.of(self.scope.case, batch))]

    def powers(self, inputs: Inputs, threads: int = 1) -> Array:
        """Generator powers at the knots, shape (batch, n_knots, n_gen), pu, from stacked arrays."""
        if len(inputs) <= CHUNK:
            return follow(self._targets(inputs), inputs.p_initial, self.step)
        parts = [inputs[start : start + CHUNK] for start in range(0, len(inputs), CHUNK)]
        if threads == 1:
            targets = [self._targets(part) for part in parts]
        else:
            with ThreadPoolExecutor(threads) as pool:
                targets = list(pool.map(self._targets, parts))
        return follow(np.concatenate(targets), inputs.p_initial, self.step)

    def _targets(self, inputs: Inputs) -> Array:
        """Corrected dispatch at all knots but the first, within bounds."""
        case = self.scope.case
        channels = Channels.of(case, inputs, self.knots).with_prior(case, self.training.get("prior", True))
        half = 0.5 * (case.p_max - case.p_min)
        targets = channels.prior[:, 1:] + half * self._numpy(channels)[:, 1:]
        return np.minimum(np.maximum(targets, case.p_min), case.p_max)

    @functools.cached_property
    def step(self) -> float:
        """Largest change of power between two knots, pu."""
        return float(self.scope.case.ramp_pu_per_s * self.scope.horizon_s / (N_KNOTS - 1))

    def save(self, path: Path) -> None:
        """Write weights, normalisation and header."""
        shape = {"width": self.network.width, "dilations": list(self.network.dilations)}
        write_policy(path, METHOD, self.scope, self.network, self.training | shape)

    def export(self, path: Path) -> None:
        """Write the network alone (channels in, corrections out) for runtimes that know `torch.export`."""
        case = self.scope.case
        n_sequence, n_constants = n_channels(case)
        example = torch.zeros(2, N_KNOTS, n_sequence), torch.zeros(2, n_constants)
        batch = {0: torch.export.Dim("batch")}
        program = torch.export.export(self.network, example, dynamic_shapes=(batch, batch))
        buffer = io.BytesIO()
        torch.export.save(program, buffer)
        write_atomically(path, buffer.getvalue())

    @staticmethod
    def load(path: str | Path, case: Case, regime: str) -> DispatchPolicy:
        """Read a policy for a case and regime; InputError if the file is wrong or for something else."""
        arrays, scope, training = read_policy(path, METHOD, case, regime)
        width, dilations = training.get("width"), training.get("dilations")
        if not (isinstance(width, int) and isinstance(dilations, list) and 0 < width <= MAX_WIDTH):
            raise InputError(path, "training", "lacks the network's width and dilations")
        if not all(isinstance(d, int) and 0 < d < N_KNOTS for d in dilations):
            raise InputError(path, "training", "has dilations that are no numbers of knots")
        layers = sum(name.startswith("mix.") and name.endswith(".bias") for name in arrays)
        if len(dilations) != layers or arrays.get("first.bias", np.zeros(0)).shape != (width,):
            raise InputError(path, "training", "has another width or depth than the weights")
        if not isinstance(training.get("prior", True), bool):
            raise InputError(path, "training", "has a prior that is neither true nor false")
        network = ResidualNetwork.make(case, width, tuple(dilations))
        load_weights(network, arrays, path)
        return DispatchPolicy(scope, network.eval(), training)

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when any weight does."""
        return weights_fingerprint(self.network)


def find_policy(case: Case, regime: str, settings: Settings) -> DispatchPolicy:
    """Return the policy given in the settings, else the first one in the folders to search.

    Raises:
        InputError: there is none (names the command that trains one), or it does not fit.
    """
    path = find_policy_file(METHOD, case, regime, settings, settings.name)
    return DispatchPolicy.load(path, case, regime)


def artifact(case: Case, regime: str, settings: Settings) -> str:
    """Fingerprint of the policy that `prepare` would use."""
    return find_policy(case, regime, settings).fingerprint


def prepare(case: Case, regime: str, settings: Settings) -> Solver:
    """Return the policy as a method; `solve_s` covers features, network and all grid points."""
    policy = find_policy(case, regime, settings)

    def solve(instance: Instance) -> Solution:
        policy(instance)  # the first call of a process pays for libraries, not for inference
        started = time.perf_counter()
        schedule = policy(instance)[0]
        schedule.at(instance.grid)
        elapsed = time.perf_counter() - started
        version = f"numpy {np.__version__}"
        return Solution(Status.POLICY, schedule, solve_s=elapsed, solver_version=version)

    return solve
