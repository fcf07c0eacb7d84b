"""What a planner in operation knows of ramps that are still to come, and what of them may surprise it.

Scenarios have a law (`problem.sampling`): in every stretch of a horizon each load begins one ramp; four in
five are announced, with a start and a rate that err. So a planner that remembers what it was told knows when

* a ramp may begin that nobody announced: in a stretch of which no ramp is known, and in no other;
* an announced ramp is late: its load does not move yet. No plan counts on it before `WAIT_S` from now, else
  generators follow a ramp that is not there;
* the start of a ramp is uncertain: about when it is announced. Plans leave more room there.
"""

from __future__ import annotations

import numpy as np

from ded_bench.methods.reserve import Room, steady_speeds, sudden_speeds
from ded_bench.methods.state_estimate import passed_s
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance, LoadPoints, LoadRamp
from ded_bench.problem.lossless_case import LosslessCase
from ded_bench.problem.sampling import RATE_ERROR, START_ERROR_S
from ded_bench.problem.schedule import Schedule

#: A plan is old after so many seconds. News are what is forecast otherwise within so many.
OLD_S, NEWS_S = 1.0, 2.0
#: Forecasts are looked at every so many seconds.
LOOK_S = 0.25
#: No plan counts on a ramp that has not begun sooner than so many seconds from now.
WAIT_S = 0.5
#: Parts of the bound that plans leave free: always, and where a ramp's start is uncertain; but no more than
#: the steepest ramp moves any machine until a plan has effect, so long after the planner is asked again, s.
ALWAYS, UNCERTAIN, EFFECT_S = 0.3, 0.5, 0.4
#: Times at which that is known, s.
REACTION_S = np.arange(0.0, OLD_S + EFFECT_S + 0.025, 0.05)
#: Room for surprises at knots so far ahead, s; what may be left of the bound; how far a sudden ramp swings
#: machines, in steady speeds, and how long, s; how long a ramp lasts, s; the price of a shortage.
AHEAD_S, LIMIT, SWING, SWING_S, LASTS_S, PRICE = 15.0, 0.85, 3.0, 3.0, 16.0, 5.0
#: A sudden ramp asks for room if so many times its steady speed, the swing without damping, is beyond the
#: bound, and plans come too late for it; another, if its steady speed is.
OVERSHOOT = 2.0


class Surprises:
    """The memory of one planner, from plan to plan.

    Args:
        case: gives the ranges of ramps.
        bound: of |ω|, rad/s.
    """

    def __init__(self, case: Case, bound: float) -> None:
        self._case, self._bound = case, bound
        #: Steady speeds by loads' ramps, and the compliance; None where no network tells.
        self._speeds = steady_speeds(case) if isinstance(case, LosslessCase) else None
        self._steepest = np.abs(case.load_rate).max(axis=0)
        #: How far the steepest ramps move machines until each of REACTION_S, rad/s.
        self._moved = np.full(len(REACTION_S), np.inf)
        if isinstance(case, LosslessCase):
            self._moved = (sudden_speeds(case, REACTION_S) * self._steepest[:, None]).max(axis=(1, 2))
        #: Slower changes are no ramps, pu/s.
        self._slow = 0.5 * float(np.abs(case.load_rate).min())
        self._schedule: Schedule | None = None
        self._forget()

    def _forget(self) -> None:
        self.now_s, self._given_s, self._planned_s, self._between_s = 0.0, 0.0, 0.0, OLD_S
        self._forecast: Instance | None = None  # that of the last plan
        self._known: set[tuple[int, int]] = set()  # stretches and loads whose ramp is known
        self._present, self._ramps = None, np.zeros(len(self._case.loads), dtype=bool)

    def expected(self, instance: Instance, in_force: Schedule | None) -> Instance:
        """What to plan for: no ramp that has not begun begins within WAIT_S.

        Args:
            instance: what is measured and forecast.
            in_force: the plan in force, on the time of the instance.
        """
        passed = None if self._schedule is None else passed_s(instance, in_force, self._schedule)
        if passed is None:
            self._forget()
        before, self.now_s = self.now_s, self._given_s + (passed or 0.0)
        self._between_s = min(passed or OLD_S, OLD_S)
        self._look(instance, self.now_s - before)
        later = {
            bus: _delayed(instance.load[bus], at, WAIT_S - at, instance.horizon_s)
            for bus, (at, _) in zip(self._case.loads, self._next, strict=True)
            if at < WAIT_S
        }
        return instance.model_copy(update={"load": instance.load | later}) if later else instance

    def _look(self, instance: Instance, passed: float) -> None:
        """Find in the forecast which ramps are known, and which begins next."""
        t = np.arange(0.0, instance.horizon_s, LOOK_S)
        load = instance.p_load(self._case, t)
        slope = np.diff(load, axis=0) / LOOK_S
        ramps = np.abs(slope) > self._slow
        begins = ramps & ~np.vstack([self._ramps, ramps[:-1]])
        stretch = self._stretch(t)
        self._known |= {(int(stretch[i]), int(of)) for i, of in np.argwhere(begins)}
        begun = ramps[0]
        if self._present is not None:
            begun = begun & (np.abs(load[0] - self._present) > self._slow * passed)
        self._present, self._ramps = load[0], ramps[0]
        #: When each load's next ramp begins, s, and its rate, pu/s; inf: not known, or it has begun.
        self._next = [(np.inf, 0.0)] * len(self._case.loads)
        for of in np.flatnonzero(ramps.any(axis=0)):
            first = int(ramps[:, of].argmax())
            if first > 0 or not begun[of]:
                self._next[of] = (first * LOOK_S, float(slope[first, of]))

    def _stretch(self, t: Array) -> Array:
        """Number of the stretch at times ahead."""
        return np.floor((self.now_s + t) / self._case.sampling.horizon_s + 1e-9)

    def is_news(self, expected: Instance) -> bool:
        """Whether to plan anew."""
        age = self.now_s - self._planned_s
        if self._forecast is None or age > OLD_S - 1e-6:
            return True
        t = np.arange(0.0, NEWS_S, LOOK_S)
        change = expected.p_load(self._case, t) - self._forecast.p_load(self._case, t + age)
        return bool(np.abs(change).max() > self._slow)

    def keep(self, schedule: Schedule | None, made_for: Instance | None = None) -> None:
        """Remember the plan that is given, and what it was made for, if it is new; of no plan, nothing."""
        if schedule is None:
            return
        self._schedule, self._given_s = schedule, self.now_s
        if made_for is not None:
            self._forecast, self._planned_s = made_for, self.now_s

    def margin(self, t: Array) -> Array:
        """By how much bounds are tighter at times ahead, (n_t,), rad/s."""
        starts = np.array([at for at, _ in self._next])
        unsure = (np.abs(t[:, None] - np.maximum(starts, 0.0)) <= 2.0 * START_ERROR_S).any(axis=1)
        return np.minimum(np.where(unsure, UNCERTAIN, ALWAYS) * self._bound, self._until_a_plan())

    def _until_a_plan(self) -> float:
        """How far a ramp may move machines until a plan has effect, rad/s."""
        return float(np.interp(self._between_s + EFFECT_S, REACTION_S, self._moved))

    def room(self, t: Array) -> Room | None:
        """Room for all surprises at knots, but the first, of the next AHEAD_S.

        A ramp that nobody announced lasts; that, and an announced one that begins earlier or later than
        planned, are sudden.

        Args:
            t: times of the knots, (n_knots,), s.
        """
        found = [one for j in np.flatnonzero(t <= AHEAD_S) for one in self._at(int(j), float(t[j]))]
        if not found or self._speeds is None:
            return None
        by_load, compliance = self._speeds
        speeds = np.array([rate * by_load[load] for _, load, rate, _ in found])
        is_sudden = np.array([one[-1] for one in found])
        asks = np.where(is_sudden, OVERSHOOT, 1.0) * np.abs(speeds).max(axis=1) > self._bound
        if self._until_a_plan() < ALWAYS * self._bound:
            asks &= ~is_sudden
        if not asks.any():
            return None
        return Room(
            self._case,
            compliance,
            knot=np.array([j for j, *_ in found])[asks],
            speeds=speeds[asks],
            lasts_s=np.where(is_sudden, SWING_S, LASTS_S)[asks],
            swing=np.where(is_sudden, SWING, 1.0)[asks],
            limit=LIMIT * self._bound,
            price=PRICE,
        )

    def _at(self, knot: int, t: float) -> list[tuple[int, int, float, bool]]:
        """Knot, load, rate and suddenness of what may happen at a time ahead."""
        found, stretch, about = [], int(self._stretch(np.array(t))), 2.0 * START_ERROR_S
        for load, (at, rate) in enumerate(self._next):
            if (stretch, load) not in self._known:
                up = float(self._steepest[load])
                found += [(knot, load, ramp, sudden) for sudden in (False, True) for ramp in (up, -up)]
            elif abs(t - at) <= about:
                sign = 1.0 if t < at else -1.0  # early: it comes on top; late: the plan has it
                found.append((knot, load, sign * (1.0 + RATE_ERROR) * rate, True))
        return found


def _delayed(load: LoadRamp | LoadPoints, at: float, by: float, last: float) -> LoadPoints:
    """A load that stays for some time at an instant, and goes on then; known up to `last`, all in s."""
    times = sorted({0.0, *(t for t in load.kinks if t < last), at, last})
    values = load.at(np.array(times)).tolist()
    later = zip(((t + by if t >= at else t) for t in times), values, strict=True)
    return LoadPoints(points=np.array(sorted({*later, (at, float(load.at(np.array(at))))})))
