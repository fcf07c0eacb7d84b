"""The equations for CasADi, integrated by CasADi: the plant does the same."""

from __future__ import annotations

import itertools

import casadi
import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import PLANTS, plant_of, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from tests.lagged_plant import lagged, lagged_case  # noqa: F401
from tests.learning.test_learning import CASES, drawn, wandering


@pytest.mark.parametrize(("name", "plant"), [("lossless", None), ("island", None), ("infinite", "detailed")])
def test_casadi_integrates_to_what_the_plant_does(name: str, plant: str | None) -> None:
    """IDAS over half a second, before secondary control acts; what that would hold is the same, too."""
    case = CASES[name]()
    instances = (drawn(case, k, plant, 0.5) for k in itertools.count())
    instance = next(i for i in instances if len(i.kinks) == 2)
    schedule = wandering(case, instance)
    p = schedule.at(instance.grid)
    run = simulate(case, instance, Schedule(instance.grid, p), plant_of(case, plant))
    model = case.casadi(plant)
    x, z, fixed = model.start(instance)
    ode, alg, omega, p_gen, p_slack = (
        part.full().ravel() for part in model.function(x, z, p[0], run.p_load[0], fixed)
    )
    assert np.abs(alg).max() < 1e-8
    np.testing.assert_allclose(omega, run.omega[0], atol=1e-12)
    np.testing.assert_allclose(p_slack, run.p_slack[0], atol=1e-8)
    np.testing.assert_allclose(p_gen, run.p_gen[0], atol=1e-9)
    assert ode.shape == x.shape
    sizes = ("u0", len(p[0])), ("u1", len(p[0])), ("l0", len(case.loads)), ("l1", len(case.loads)), ("t", 1)
    u0, u1, l0, l1, t = (casadi.SX.sym(*one) for one in sizes)
    rates, balance, *_ = model.function(model.x, model.z, u0 + t * (u1 - u0), l0 + t * (l1 - l0), model.p)
    dae = {"x": model.x, "z": model.z, "p": casadi.vertcat(u0, u1, l0, l1, model.p), "t": t}
    dae |= {"ode": rates * instance.horizon_s, "alg": balance}
    step = casadi.integrator("step", "idas", dae, 0.0, 1.0, {"abstol": 1e-10, "reltol": 1e-10})
    found = step(x0=x, z0=z, p=np.concatenate([p[0], p[-1], run.p_load[0], run.p_load[-1], fixed]))
    x, z = found["xf"].full().ravel(), found["zf"].full().ravel()
    omega = model.function(x, z, p[-1], run.p_load[-1], fixed)[2].full().ravel()
    np.testing.assert_allclose(omega, run.omega[-1], atol=1e-7)
    if case.agc is not None:
        own = plant_of(case)
        end = own.advance(own.initial(instance), p, run.p_load, instance.dt_s).end
        mean = own.observed(end).agc.integral_rad
        held = casadi.Function("held", [model.x], [model.held])(x).full().item()
        assert held == pytest.approx(-case.agc.k * mean, abs=1e-7)


def test_bounds_are_those_of_the_regime() -> None:
    case = CASES["island"]()
    model, regime = case.casadi(), next(iter(case.regimes))
    y, limit, at_end = model.monitored(regime)
    assert y.shape == (len(limit), 1)
    assert at_end.sum() == 1


def test_a_plant_without_equations_refuses(lagged: None) -> None:  # noqa: F811
    assert "lagged" in PLANTS
    case: Case = lagged_case(CASES["lossless"]())
    with pytest.raises(InputError, match="lagged: has no equations for CasADi"):
        case.casadi()
