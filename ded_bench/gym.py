"""Environments for reinforcement learning (extra `gym`): a second is a step, an instance an episode.

Importing this module registers `ded_bench/<case>-<regime>-v0` of every shipped case with gymnasium, and
`ded_bench/dispatch-v0`, for a case of one's own: `gymnasium.make(..., case=DIR, regime=R)`.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import Plant, SimulationError, plant_of, servable
from ded_bench.plants.score import judge
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import LARGEST_DEVIATION_HZ, Instance, State
from ded_bench.problem.quantities import Array
from ded_bench.problem.sampling import ATTEMPTS, POLICY_SEED, VALIDATION_SEED, sample_instances
from ded_bench.problem.schedule import Schedule
from ded_bench.run.online.loop import History

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict
except ModuleNotFoundError:
    raise InputError("gymnasium", "", "environments need it: pip install gymnasium") from None

__all__ = ["DispatchEnv", "register"]

Observed = dict[str, NDArray[np.float32]]

#: A step, and times ahead at which loads are forecast, s.
STEP_S, AHEAD_S = 1.0, np.arange(0.0, 61.0, 5.0)


class DispatchEnv(gymnasium.Env[Observed, NDArray[np.floating]]):
    """Dispatch of one case in one regime.

    An observation is a dict of float32 arrays, each clipped to its bounds:

    * `time` (1,): the part of the episode that is over, 0 to 1;
    * `omega` (n_gen,): frequency deviations, rad/s, ±2π;
    * `p` (n_gen,): set-points, pu, within the machines' limits;
    * `forecast` (13, n_load): load injections now, 5 s, ... 60 s ahead, pu, within what the sampler draws;
      beyond the end of the episode they stay;
    * `cost` (n_priced,): of the slack, if there is one, and the generators, within the sampler's range;
    * what the plant lets be observed of `theta` (n_gen,), rad, turned into ±π, `mechanical` (n_gen,), powers
      of turbines, pu, and `agc` (3,): what secondary control holds (pu), its integral (rad), when it acts, s.

    An action (n_gen,) in ±1 is a part of the ramp limits: set-points move linearly for a second, and stop at
    the machines' limits; machines behind a transfer limit are lowered to it as fast as they can be.
    The reward is -cost - price · excess: Σ_k Σ_i c_i P_i + c_s |P_s| over the grid points of the step, and
    the largest excess over the regime's bounds in it, Hz, which is `info["cost"]`, too. The episode ends at
    the horizon, or when the plant cannot follow, which counts as an excess of 1 Hz in all steps that are left
    (`info["error"]` says why). At the horizon `info["score"]` is what the scorer says of
    `info["schedule"]` on `info["instance"]`.

    Args:
        case: a case, its folder, or the name of a shipped one.
        regime: one of the case's.
        plant: its name, or a plant of the case; None: the case's own.
        price: of 1 Hz of excess in a step; None: an excess as large as the bound costs as much as nominal
            loads at the sampler's mean cost.

    Raises:
        InputError: there is no such case, regime or plant, or the price is not finite.
    """

    metadata = {"render_modes": []}  # noqa: RUF012, as gymnasium declares it

    def __init__(
        self,
        case: Case | str | Path,
        regime: str,
        plant: str | Plant | None = None,
        price: float | None = None,
    ) -> None:
        self.case = case if isinstance(case, Case) else Case.load(case)
        self.regime, self.plant = regime, plant_of(self.case, plant)
        self._bounds = self.case.bounds(regime)
        ranges = self.case.sampling
        drawn = float(np.abs(self.case.load_nominal).sum())
        step_cost = max(round(STEP_S / ranges.dt_s), 1) * float(np.mean(ranges.cost)) * drawn
        self.price = step_cost / self.case.regimes[regime].largest_hz if price is None else price
        if not np.isfinite(self.price):
            raise InputError("price", "", "must be finite")
        self.action_space = Box(-1.0, 1.0, (len(self.case.generators),), np.float32)
        ends = _ends(self.case, self.plant.observed(self._drawn(POLICY_SEED)[1].state))
        self._spaces: dict[str, Any] = {
            name: Box(low.astype(np.float32), high.astype(np.float32)) for name, (low, high) in ends.items()
        }
        self.observation_space = cast(gymnasium.Space[Observed], Dict(self._spaces))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begin an episode on a training draw; which one follows from the seed.

        Args:
            seed: of this episode and those after it; None: what follows from the seed before.
            options: `instance`, to be had instead of a draw.

        Returns:
            What is observed, as the class says, and `instance`.

        Raises:
            InputError: the instance is of another case.
        """
        super().reset(seed=seed)
        given = (options or {}).get("instance")
        if given is not None:
            if not isinstance(given, Instance):
                raise InputError("options", "instance", "must be an Instance, as `load_instances` gives")
            given.check_case(self.case)
        master = POLICY_SEED + int(self.np_random.integers(VALIDATION_SEED - POLICY_SEED))
        self.instance: Instance
        self._run: History
        self.instance, self._run = self._drawn(master) if given is None else (given, self._begun(given))
        self._cost = self.instance.cost_gen(self.case), self.instance.cost_slack(self.case)
        self._knots, self._points = [0], max(round(STEP_S / self.instance.dt_s), 1)
        return self._observation(), {"instance": self.instance}

    def step(self, action: NDArray[np.floating]) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Move the set-points for a second.

        Args:
            action: parts of the ramp limits, (n_gen,).

        Returns:
            What is observed, the reward, whether the episode is over, False, and more, as the class says.

        Raises:
            InputError: the action is no number for each generator, or no episode goes on.
        """
        run = getattr(self, "_run", None)
        if run is None or run.now == self.instance.steps or not self._points:
            raise InputError("step", "", "the episode has ended, or none has begun: reset the environment")
        first, last = run.now, min(run.now + self._points, self.instance.steps)
        if np.shape(action) != self.action_space.shape or not np.isfinite(np.asarray(action, float)).all():
            raise InputError("action", "", f"must be finite, of the shape {self.action_space.shape}")
        grid = self.instance.grid
        power = np.stack([run.p_set[first], self._moved(np.asarray(action, dtype=np.float64), first, last)])
        p_set = Schedule(grid[[first, last]], power).at(grid[first : last + 1])
        ended = last == self.instance.steps
        info: dict[str, Any] = {"instance": self.instance}
        try:
            run.go_on(p_set)
        except SimulationError as error:
            left = -((first - self.instance.steps) // self._points)
            self._points = 0  # the episode has ended
            info |= {"cost": LARGEST_DEVIATION_HZ, "error": str(error)}
            return self._observation(), -left * self.price * LARGEST_DEVIATION_HZ, True, False, info
        self._knots.append(last)
        new = slice(first + bool(first), last + 1)
        cost = float((run.p_gen[new] @ self._cost[0] + self._cost[1] * np.abs(run.p_slack[new])).sum())
        excess = max(self._bounds.excess_hz(run.omega[new], ended).values())
        info["cost"] = excess
        if ended:
            info |= {
                "score": judge(self.case, self.instance, run.trajectory(), self.regime),
                "schedule": Schedule(grid[self._knots], run.p_set[self._knots]),
            }
        return self._observation(), -cost - self.price * excess, ended, False, info

    def _begun(self, instance: Instance) -> History:
        return History(self.case, self.plant, instance, instance.grid, instance.p_load(self.case))

    def _drawn(self, master: int) -> tuple[Instance, History]:
        """The first draw that the plant, which need not be the case's own, can begin with."""
        for instance in sample_instances(self.case, master, ATTEMPTS, servable=servable):
            with contextlib.suppress(SimulationError):
                return instance, self._begun(instance)
        raise InputError(f"case {self.case.id}", "plant", f"{self.plant.name} can begin with no draw")

    def _moved(self, action: Array, first: int, last: int) -> Array:
        """Set-points at the end of a step, (n_gen,), pu."""
        case, before = self.case, self._run.p_set[first]
        reach = case.ramp * (last - first) * self.instance.dt_s
        wanted = np.clip(before + np.clip(action, -1.0, 1.0) * reach, case.p_min, case.p_max)
        power = before + np.clip(wanted - before, -reach, reach)
        # Until the end of the next step, so that the limit is kept between the ends of steps, too.
        ahead = self._run.p_load[first : last + self._points + 1]
        for row, by_load, limit in zip(*case.transfer_rows, strict=True):
            over = row @ power + (ahead @ by_load).max() - limit
            room = row * np.maximum(power - np.maximum(before - reach, case.p_min), 0.0)
            if over > 0.0 < room.sum():
                power = power - room * min(over / room.sum(), 1.0)
        return np.asarray(power)

    def _observation(self) -> Observed:
        instance, run, seen = self.instance, self._run, self.plant.observed(self._run.state)
        ahead = np.minimum(run.now + np.round(AHEAD_S / instance.dt_s).astype(int), instance.steps)
        found = {
            "time": np.array([run.now / instance.steps]),
            "p": run.p_set[run.now],
            "forecast": run.p_load[ahead],
            "cost": np.array([instance.cost[name] for name in self.case.priced]),
            **_seen(seen),
        }
        spaces = self._spaces.items()
        return {name: np.clip(found[name], s.low, s.high).astype(np.float32) for name, s in spaces}


def _seen(state: State) -> dict[str, Array]:
    """What a plant lets be observed, by name."""
    found = {"omega": state.omega}
    if state.theta is not None:
        found["theta"] = np.angle(np.exp(1j * state.theta))
    if state.mechanical is not None:
        found["mechanical"] = state.mechanical
    if state.agc is not None:
        found["agc"] = np.array([state.agc.held_pu, state.agc.integral_rad, state.agc.next_s or 0.0])
    return found


def _ends(case: Case, seen: State) -> dict[str, tuple[Array, Array]]:
    """Bounds of what is observed, by name."""
    ranges, n = case.sampling, len(case.generators)
    ramped = case.load_rate[1] * ranges.duration_s[1] + ranges.load_relative * np.abs(case.load_nominal)
    load = np.tile(case.load_nominal, (len(AHEAD_S), 1))
    fast, half = np.full(n, 2 * np.pi * LARGEST_DEVIATION_HZ), np.full(n, np.pi)
    total = case.p_max - case.p_min
    period = 0.0 if case.agc is None else case.agc.period_s
    agc = np.array([total.sum(), 2 * np.pi * LARGEST_DEVIATION_HZ * ranges.horizon_s, period])
    found = {
        "time": (np.zeros(1), np.ones(1)),
        "p": (case.p_min, case.p_max),
        "forecast": (load - ramped, load + ramped),
        "cost": tuple(np.full(len(case.priced), end) for end in ranges.cost),
    }
    found |= {"omega": (-fast, fast), "theta": (-half, half)}
    found |= {"mechanical": (case.p_min - total, case.p_max + total), "agc": (-agc, agc)}
    return {name: found[name] for name in ("time", "p", "forecast", "cost", *_seen(seen))}


def register() -> None:
    """Register the environments of all shipped cases with gymnasium."""
    entry = f"{__name__}:{DispatchEnv.__name__}"
    gymnasium.register("ded_bench/dispatch-v0", entry)
    for path in sorted(SHIPPED_CASES.glob("*/case.json")):
        for regime in json.loads(path.read_text(encoding="utf-8"))["regimes"]:
            given = {"case": str(path.parent), "regime": regime}
            gymnasium.register(f"ded_bench/{path.parent.name}-{regime}-v0", entry, kwargs=given)


register()
