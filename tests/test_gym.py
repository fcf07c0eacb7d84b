"""Environments: gymnasium's own check, seeds, limits by construction, the scorer's verdict on episodes."""

from __future__ import annotations

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ded_bench
import ded_bench.gym
from ded_bench.files.errors import InputError
from ded_bench.gym import DispatchEnv
from ded_bench.plants.plant import PLANTS, SimulationError
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED
from ded_bench.problem.scenario import Fluctuation, Scenario, ScenarioLoad, ScenarioRamp
from ded_bench.run.online.judgement import judge_operation
from ded_bench.run.online.loop import LoopOptions, Planned, run_loop
from tests.conftest import CASE_FILES
from tests.detailed_cases import MIXED
from tests.test_api import WITHOUT_TORCH

#: Lossless, with ramp limits of its own and a feed-in; and an island with AGC and two machines at a bus.
FOLDERS = {"fivemachine": CASE_FILES["fivemachine"].parent, "mixedisland": MIXED}


@pytest.fixture(scope="module", params=list(FOLDERS))
def env(request: pytest.FixtureRequest) -> DispatchEnv:
    case = Case.load(FOLDERS[request.param])
    return gymnasium.make("ded_bench/dispatch-v0", case=case, regime=next(iter(case.regimes))).unwrapped


def episode(env: DispatchEnv, actions: np.ndarray, **reset: object) -> tuple[list[float], list[float], dict]:
    """Rewards, excesses, and the last `info`."""
    env.reset(**reset)
    rewards, excesses = [], []
    for k in range(1000):
        seen, reward, ended, cut, info = env.step(actions[k % len(actions)])
        assert env.observation_space.contains(seen)
        assert not cut
        rewards.append(reward)
        excesses.append(info["cost"])
        if ended:
            return rewards, excesses, info
    raise AssertionError("it never ends")


def as_scenario(case: Case, instance: Instance) -> Scenario:
    """The same loads, known to everyone."""
    still = Fluctuation(step_s=2 * instance.horizon_s, values=(0.0, 0.0), decay_s=1.0)
    load = {}
    for bus, ramp in instance.load.items():
        values = {"start": ramp.start, "duration": ramp.duration, "rate": ramp.rate}
        known = ScenarioRamp(**values, announced_start=ramp.start, announced_rate=ramp.rate)
        load[bus] = ScenarioLoad(initial=ramp.initial, ramps=(known,), fluctuation=still)
    kept = {name: getattr(instance, name) for name in ("id", "case", "seed", "dt_s", "cost", "initial")}
    return Scenario(**kept, schema_="ded-bench/scenario/1", duration_s=instance.horizon_s, load=load)


def test_gymnasium_finds_nothing(env: DispatchEnv, recwarn: pytest.WarningsRecorder) -> None:
    check_env(env, skip_render_check=True)
    assert [str(warning.message) for warning in recwarn] == []


def test_an_episode_is_what_the_scorer_says(env: DispatchEnv) -> None:
    """To the last bit; rewards sum to its cost; ramps and limits hold whatever is asked."""
    actions = np.random.default_rng(5).uniform(-1.5, 1.5, (7, len(env.case.generators)))
    rewards, excesses, info = episode(env, actions, seed=3)
    instance, verdict = info["instance"], info["score"]
    assert verdict == ded_bench.score(instance, info["schedule"], env.regime, env.case)
    assert max(excesses) == verdict.freq_violation_hz
    total = -sum(rewards) - env.price * sum(excesses)
    assert total == pytest.approx(verdict.objective, rel=1e-9)
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) < 1e-12
    assert len(rewards) == np.ceil(instance.horizon_s - 1e-9)
    with pytest.raises(InputError, match="has ended"):
        env.step(actions[0])


def test_a_step_lasts_a_second_on_any_grid_of_time(env: DispatchEnv, alter) -> None:
    coarse = alter(env.reset(seed=1)[1]["instance"], dt_s=2 * env.case.sampling.dt_s)
    env.reset(options={"instance": coarse})
    steps, ended = 0, False
    while not ended:
        *_, ended, _, _ = env.step(np.zeros(len(env.case.generators)))
        steps += 1
    assert steps == np.ceil(coarse.horizon_s - 1e-9)


def test_seeds_say_which_training_draws_come(env: DispatchEnv) -> None:
    """The same seed, the same episodes, one after the other; never an instance of another purpose."""
    drawn = []
    for seed in (4, None, 4, None, 5):
        seen, info = env.reset(seed=seed)
        drawn.append((info["instance"].seed, seen))
        assert POLICY_SEED <= info["instance"].seed[0] < VALIDATION_SEED
    seeds = [seed for seed, _ in drawn]
    assert seeds[:2] == seeds[2:4]
    assert len(set(seeds)) == 3
    for name, values in drawn[0][1].items():
        np.testing.assert_array_equal(values, drawn[2][1][name])


def test_what_is_no_step_of_an_episode_is_said() -> None:
    folder = FOLDERS["fivemachine"]
    with pytest.raises(InputError, match="none has begun"):
        DispatchEnv(folder, "TO").step(np.zeros(1))
    with pytest.raises(InputError, match="must be an Instance"):
        DispatchEnv(folder, "TO").reset(options={"instance": "fivemachine-0000"})
    with pytest.raises(InputError, match="price: must be finite"):
        DispatchEnv(folder, "TO", price=float("nan"))


def test_full_ramps_lead_to_the_limits(env: DispatchEnv) -> None:
    """And no further; nothing else is accepted as an action."""
    env.reset(seed=1, options={"instance": env.reset(seed=1)[1]["instance"]})
    start, case = env._run.p_set[0].copy(), env.case
    env.step(np.ones(len(start)))
    if not case.transfers:
        np.testing.assert_allclose(
            env._run.p_set[env._run.now], np.minimum(start + case.ramp, case.p_max), atol=1e-12
        )
    for wrong in (np.full(len(start), np.nan), np.zeros(len(start) + 1)):
        with pytest.raises(InputError, match="action: must be finite, of the shape"):
            env.step(wrong)


def test_a_transfer_limit_holds() -> None:
    """With all machines at full ramp, which would break it: half a minute is enough."""
    env = DispatchEnv("two-area-agc", "TO")
    env.reset(seed=2)
    for _ in range(30):
        env.step(np.ones(4))
    done = slice(env._run.now + 1)
    assert env.case.transfer_excess(env._run.p_set[done], env._run.p_load[done]).max() < 1e-12
    assert (env._run.p_set[done] <= env.case.p_max).all()


def test_the_loop_says_the_same() -> None:
    """Operating the same loads with the same powers, a second at a time."""
    case = Case.load(FOLDERS["fivemachine"])
    env = DispatchEnv(case, "TO")
    actions = np.random.default_rng(5).uniform(-0.9, 0.9, (7, len(case.generators)))
    _, _, info = episode(env, actions, seed=3)
    scenario = as_scenario(case, info["instance"])
    plans = iter([Planned(info["schedule"])])
    outcome = run_loop(case, scenario, lambda *_: next(plans, Planned(None)), LoopOptions())
    np.testing.assert_array_equal(outcome.trajectory.omega, env._run.omega)
    judged = judge_operation(case, scenario, outcome.trajectory, "TO")
    assert judged.objective == info["score"].objective
    assert judged.max_excess_hz == info["score"].freq_violation_hz


def test_what_cannot_go_on_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant's own words, and an excess of 1 Hz in every step that is left."""
    env = DispatchEnv(FOLDERS["fivemachine"], "TO", price=2.0)
    env.reset(seed=1)
    steps = -(-env.instance.steps // env._points)
    env.step(np.zeros(env.action_space.shape))

    def collapse(*_: object, **__: object) -> None:
        raise SimulationError("no voltages")

    monkeypatch.setattr(type(env.plant), "advance", collapse)
    _, reward, ended, _, info = env.step(np.zeros(env.action_space.shape))
    assert (reward, ended, info["cost"], info["error"]) == (-2.0 * (steps - 1), True, 1.0, "no voltages")
    with pytest.raises(InputError, match="the episode has ended"):
        env.step(np.zeros(env.action_space.shape))


def test_every_shipped_case_and_regime_has_an_id() -> None:
    for path in SHIPPED_CASES.glob("*/case.json"):
        for regime in Case.load(path).regimes:
            assert f"ded_bench/{path.parent.name}-{regime}-v0" in gymnasium.registry
    env = gymnasium.make("ded_bench/9bus-TO-v0")
    assert (env.unwrapped.case.id, env.unwrapped.regime) == ("9bus", "TO")
    many = gymnasium.make_vec("ded_bench/9bus-TO-v0", num_envs=3)
    seen, _ = many.reset(seed=0)
    assert seen["omega"].shape == (3, 2)
    assert many.step(many.action_space.sample())[1].shape == (3,)
    with pytest.raises(InputError, match="unknown regime"):
        DispatchEnv("9bus", "XX")
    assert DispatchEnv("two-area", "TO", plant="detailed").plant.name in PLANTS


@pytest.mark.parametrize(("before", "known"), [("import gymnasium", True), ("", False)])
def test_gymnasium_is_not_imported_for_others(before: str, known: bool) -> None:
    """Whoever has it finds the environments without a further import."""
    code = (
        f"{before}\nimport ded_bench, sys\nprint('ded_bench.gym' in sys.modules, 'gymnasium' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(known)] * 2


def test_without_gymnasium_it_says_what_to_install() -> None:
    code = f"{WITHOUT_TORCH.replace('torch', 'gymnasium')}import ded_bench.gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1].endswith("environments need it: pip install gymnasium")
