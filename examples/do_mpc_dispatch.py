"""Nonlinear model predictive control by do-mpc, with the equations of `case.casadi()`, as one's own method.

pip install do-mpc
ded-bench solve --method do_mpc_dispatch:solve --regime TO --limit 2 --out results/mine
ded-bench online --method do_mpc_dispatch:solve --regime TO --scenarios 1 --out results/mine
"""

from functools import cache

import casadi
import do_mpc
import numpy as np

from ded_bench import Schedule


@cache
def controller(case, regime):
    """Collocation once a second, enough where modes are slow; set-points and loads are states that ramp."""
    plant, model = case.casadi(), do_mpc.model.Model("continuous", "SX")
    states = ("x", plant.x), ("p", plant.u), ("load", plant.p_load)
    x, p, load = (model.set_variable("_x", name, of.shape) for name, of in states)
    z, ramp = model.set_variable("_z", "z", plant.z.shape), model.set_variable("_u", "ramp", plant.u.shape)
    rate = model.set_variable("_tvp", "rate", plant.p_load.shape)
    price = model.set_variable("_tvp", "price", (len(case.generators) + 1, 1))
    ode, alg, _, p_gen, p_slack = plant.function(x, z, p, load, casadi.SX.zeros(plant.p.shape))
    model.set_rhs("x", ode)
    model.set_rhs("p", ramp)
    model.set_rhs("load", rate)
    model.set_alg("alg", alg)
    model.set_expression("paid", casadi.dot(price, casadi.vertcat(p_gen, casadi.sqrt(p_slack**2 + 1e-6))))
    y, limit, _ = plant.monitored(regime)
    y = casadi.Function("y", [plant.x], [y / (0.99 * limit)])(x)  # some room between the points
    model.set_expression("y", casadi.vertcat(y, -y))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = round(case.sampling.horizon_s), 1.0
    mpc.settings.collocation_deg, mpc.settings.store_full_solution = 3, True
    mpc.settings.nl_cons_check_colloc_points = True
    mpc.settings.supress_ipopt_output()
    mpc.set_objective(mterm=casadi.SX(0), lterm=model.aux["paid"])
    mpc.set_rterm(ramp=0.0)
    mpc.set_nl_cons("y", model.aux["y"], ub=1.0, soft_constraint=True, penalty_term_cons=1e3)
    mpc.bounds["lower", "_x", "p"], mpc.bounds["upper", "_x", "p"] = case.p_min, case.p_max
    mpc.bounds["lower", "_u", "ramp"], mpc.bounds["upper", "_u", "ramp"] = -case.ramp, case.ramp
    known = mpc.get_tvp_template()
    mpc.set_tvp_fun(lambda _: known)
    mpc.setup()
    return mpc, plant, known


def solve(instance, regime, case):
    """Answer one instance, or one moment of the closed loop."""
    mpc, plant, known = controller(case, regime)
    t = np.arange(mpc.settings.n_horizon + 1.0)
    loads = instance.p_load(case, t)
    known["_tvp", :, "rate"] = [*np.diff(loads, axis=0), np.zeros(len(case.loads))]
    known["_tvp", :, "price"] = [np.append(instance.cost_gen(case), instance.cost_slack(case))] * len(t)
    x, z, _ = plant.start(instance)
    mpc.reset_history()
    mpc.x0, mpc.z0 = np.concatenate([x, instance.p_initial(case), loads[0]]), z
    mpc.set_initial_guess()
    mpc.make_step(mpc.x0)
    return Schedule(t, mpc.data.prediction(("_x", "p"))[:, :, 0].T)
