"""Power flow and equations of the detailed plant: symbolic against compiled, modes, idle windings."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ded_bench.files.strict import parse_record
from ded_bench.plants.detailed.equations import LoadSlopes, machine_rates, solve_afresh, sources
from ded_bench.plants.detailed.machine_arrays import DELTA, E2D, E2Q, N_STATES, SPEED, machine_arrays
from ded_bench.plants.detailed.power_system import PowerSystem, interleaved
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Case
from ded_bench.problem.grid_files import MachinesFile
from tests.detailed_cases import GRIDS, MIXED

#: Electromechanical modes that ANDES and an independent program give at nominal power, slack infinite: Hz to
#: 0.01, damping ratio in per cent.
MODES = {
    "two-area": [(0.41, 11.7), (0.93, 26), (1.31, 32), (3.81, 11)],
    "39bus": [(0.51, 14.5), (1.10, 24), (1.16, 13.0), (1.18, 21), (1.28, 25), (1.46, 18), (1.68, 17)],
    "68bus": [(0.29, 27), (0.56, 10.7), (0.82, 9.1), (1.88, 17)],
    "140bus": [(0.32, 12.9), (2.52, 1.6)],
}
ISLAND_MODES = {
    "two-area": [(0.62, 8.6), (1.30, 32), (1.36, 32), (0.10, 35)],
    "39bus": [(0.65, 13.0), (1.16, 12.7), (1.28, 25), (1.46, 18), (0.045, 60)],
    "68bus": [(0.40, 13.4), (0.56, 10.4), (0.69, 10.4), (0.82, 9.1), (0.10, 85)],
    "140bus": [(0.26, 16.7), (2.52, 1.6)],
}


def system_of(grid, island: bool) -> PowerSystem:
    return PowerSystem(Case.load(f"{grid}-agc" if island and grid != MIXED else grid))


@pytest.fixture(scope="module", params=[*GRIDS, MIXED], ids=[*GRIDS, "mixed"])
def system(request) -> PowerSystem:
    """Each grid as an island."""
    return system_of(request.param, island=True)


def test_power_flow_meets_its_powers(system):
    """At every bus of the whole network, from admittances that are put together line by line here."""
    network = system.network
    point = network.nominal()
    injected = point.voltage * (network.admittance @ point.voltage).conj()
    expected = -(point.p_drawn + 1j * network.q_drawn)
    np.add.at(expected, network.machine_port, point.power)
    np.testing.assert_allclose(injected, expected, rtol=0, atol=1e-10)
    others = np.arange(len(point.power)) != network.balancing
    np.testing.assert_array_equal(point.power.real[others], network.p_nominal[others])
    assert np.angle(point.voltage[network.machine_port[network.balancing]]) == pytest.approx(0.0, abs=1e-14)
    held = network.machine_port
    np.testing.assert_allclose(np.abs(point.voltage[held]), np.abs(network.guess[held]), rtol=1e-12)


@pytest.mark.parametrize("grid", [*GRIDS, MIXED])
def test_eliminated_buses_carry_no_current(grid):
    """Kirchhoff's current law at every bus, line by line as the file has them."""
    files = Case.load(grid).detailed
    network = system_of(grid, island=True).network
    point = network.nominal()
    voltage = dict(zip(network.buses, network.spread @ point.voltage, strict=True))
    current = dict.fromkeys(network.buses, 0.0 + 0.0j)
    for line in files.network.lines:
        # An ideal transformer at `from`, then a line with half its charging at both ends.
        tap = line.tap * np.exp(1j * np.radians(line.shift_deg))
        near, far = voltage[line.from_bus] / tap, voltage[line.to_bus]
        through = (near - far) / (line.r + 1e-8 + 1j * (line.x + 1e-8))
        current[line.from_bus] += (through + 0.5j * line.b * near) / np.conj(tap)
        current[line.to_bus] += 0.5j * line.b * far - through
    for bus in files.network.buses:
        current[bus.id] += (bus.gs + 1j * bus.bs) * voltage[bus.id]
    injected = dict.fromkeys(network.buses, 0.0 + 0.0j)
    names = [network.buses[i] for i in network.ports]
    for name, p, q in zip(names, point.p_drawn, network.q_drawn, strict=True):
        injected[name] -= p + 1j * q
    for machine, power in zip(files.data.machines, point.power, strict=True):
        injected[machine.bus] += power
    for bus in network.buses:
        assert voltage[bus] * np.conj(current[bus]) == pytest.approx(injected[bus], abs=1e-8)


def test_balance_slopes_are_those_of_differences(system):
    network, step = system.network, 1e-5
    by_machine = network.balance_slopes(network.nominal())
    assert by_machine[network.balancing] == 0.0

    def balance(machine: float) -> float:
        p_machine = network.p_nominal.copy()
        p_machine[-1 - (network.balancing == len(p_machine) - 1)] += machine
        return float(network.power_flow(p_machine, network.p_drawn).power.real[network.balancing])

    last = -1 - (network.balancing == len(by_machine) - 1)
    slope = (balance(step) - balance(-step)) / (2 * step)
    assert slope == pytest.approx(by_machine[last], abs=1e-6)


def test_no_power_flow_is_an_error(system):
    with pytest.raises(SimulationError, match="the power flow has no solution"):
        system.network.power_flow(system.network.p_nominal, 10 * system.network.p_drawn)


def random_states(system: PowerSystem, count: int):
    """States about an equilibrium, voltages that the symbolic network balance confirms, references."""
    rng, point = np.random.default_rng(7), system.network.nominal()
    rest = system.equilibrium(point)
    x = rest.x + rng.normal(scale=0.02, size=(count, *rest.x.shape))
    x[:, SPEED] = rng.normal(scale=1e-3, size=(count, rest.x.shape[1]))
    x[:, DELTA] -= (x[:, DELTA] @ system.data.inertia)[:, None]
    mean = system.data.inertia @ rest.x[DELTA]
    return x, point.voltage * np.exp(-1j * mean), point, rest.v_ref


def voltages(system: PowerSystem, x, guess, drawn):
    """Voltages at states x, (2 n_port,), by Newton's method on the symbolic balance."""
    v, still = interleaved(guess).copy(), np.zeros(x.shape[1])
    for _ in range(6):
        given = x.ravel(), v, still, drawn, still
        jacobian = system.symbolic.jacobian(*given).sparse().tocsr()[x.size : x.size + len(v), x.size :]
        v = v - np.linalg.solve(jacobian.toarray(), system.symbolic.equations(*given)[1].full().ravel())
    return v


def compiled_rates(system: PowerSystem, drawn, references, x, guess):
    """Rates at states x by the compiled equations, with voltages by their own Newton's method."""
    network, v = system.compiled_network._replace(change=1e-12), interleaved(guess).copy()
    load, source = LoadSlopes(np.empty((len(drawn), 4)), np.empty((len(v), len(v)))), np.empty(len(v))
    rates = np.zeros_like(x)
    for states, found in zip(x, rates, strict=True):
        sources(system.data, states, source)
        assert solve_afresh(network, drawn, source, load, v)
        machine_rates(system.data, states, v, *references, found, np.empty(x.shape[2]))
    return rates


def test_symbolic_and_compiled_equations_agree(system):
    """At random states, to 1e-10 of the rates, with the network solved by Newton's method symbolically."""
    x, guess, point, v_ref = random_states(system, 3)
    p_ref, n_load = point.power.real + 0.1, system.network.n_load_port
    compiled = compiled_rates(system, point.p_drawn[:n_load].copy(), (p_ref, v_ref), x, guess)
    for states, rates in zip(x, compiled, strict=True):
        v = voltages(system, states, guess, point.p_drawn)
        symbolic = system.symbolic.equations(states.ravel(), v, p_ref, point.p_drawn, v_ref)[0].full()
        size = np.maximum(np.abs(rates), 1.0)
        np.testing.assert_allclose(symbolic.reshape(rates.shape) / size, rates / size, rtol=0, atol=1e-10)


def test_linearisation_is_that_of_differences(system):
    """All derivatives of the rates by the states that move, against central differences of compiled ones."""
    x, guess, point, v_ref = random_states(system, 1)
    n, step, drawn = len(system.moving), 1e-5, point.p_drawn[: system.network.n_load_port]
    references = point.power.real, v_ref
    moved = np.tile(x, (2 * n, 1, 1))
    moved.reshape(2 * n, -1)[np.arange(2 * n), np.tile(system.moving, 2)] += np.repeat([step, -step], n)
    rates = compiled_rates(system, drawn, references, moved, guess).reshape(2, n, -1)
    differences = ((rates[0] - rates[1]) / (2 * step))[:, system.moving].T
    v = voltages(system, x[0], guess, point.p_drawn)
    slopes = system.slopes(x[0], v.view(np.complex128), point.p_drawn).rates
    scale = np.maximum(np.abs(slopes), 1.0)
    np.testing.assert_allclose(slopes / scale, differences / scale, rtol=0, atol=1e-5)


@pytest.mark.parametrize("island", [False, True])
@pytest.mark.parametrize("grid", GRIDS)
def test_modes_are_the_known_ones(grid, island):
    system = system_of(grid, island)
    modes = system.modes(system.network.nominal())
    if island:
        assert abs(modes[0]) < 1e-9
    assert modes[int(island) :].real.max() < -0.01
    assert system.stable(system.network.nominal())
    for hertz, damping in (ISLAND_MODES if island else MODES)[grid]:
        near = modes[np.abs(modes.imag / (2 * np.pi) - hertz) <= 0.006]
        ratios = -100 * near.real / np.abs(near)
        assert np.abs(ratios - damping).min() < (0.06 if damping != round(damping) else 0.8), (hertz, ratios)


def test_idle_subtransient_windings_make_a_two_axis_machine():
    """x''d = x'd = x'q: rates are those of Sauer and Pai's two-axis model, whatever e2d and e2q are."""
    system = PowerSystem(Case.load(MIXED))
    files = system.case.detailed
    data = json.loads(files.data.model_dump_json(by_alias=True))
    machine = next(m for m in data["machines"] if m["name"] == "south")
    machine |= {"xq": 0.9, "xq1": 0.35, "xd1": 0.35, "xd2": 0.35}
    records = parse_record(MachinesFile, json.dumps(data), "altered")
    system.__dict__["data"] = machine_arrays(records, system.network.machine_port, None)
    place = next(i for i, m in enumerate(records.machines) if m.name == "south")
    x, guess, point, v_ref = random_states(system, 2)
    x[1] = x[0]
    x[1, [E2D, E2Q], place] += 0.3
    symbolic = []
    for states in x:
        given = states.ravel(), interleaved(guess), point.power.real, point.p_drawn, v_ref
        symbolic.append(system.symbolic.equations(*given)[0].full().reshape(N_STATES, -1)[:, place])
    delta, w, e_q, e_d, *_ = x[0, :, place]
    k = machine["mva"] / 100.0
    turned = guess[system.data.port[place]] * np.exp(1j * (np.pi / 2 - delta))
    i_d, i_q = k * (e_q - turned.imag) / 0.35, k * (turned.real - e_d) / 0.35
    v_f, turbine = x[0, 7, place], system.data.reheat[place]
    p_m = turbine * x[0, 12, place] + (1 - turbine) * x[0, 13, place]
    p_e = turned.real * i_d + turned.imag * i_q
    expected = [
        2 * np.pi * 50.0 * w,
        (p_m - p_e - k * machine["d"] * w) / (2 * machine["h"] * k),
        (v_f - e_q - (machine["xd"] - 0.35) / k * i_d) / machine["Td10"],
        (-e_d + (machine["xq"] - 0.35) / k * i_q) / machine["Tq10"],
    ]
    for rates in symbolic:
        np.testing.assert_allclose(rates[:4], expected, rtol=0, atol=1e-10)


def test_the_states_that_move():
    """Classical machines have two and the governor's; a machine without exciter has no field voltage."""
    count = {grid: len(system_of(grid, island=True).moving) for grid in GRIDS}
    assert count == {"two-area": 4 * 13, "39bus": 10 * 13, "68bus": 12 * 13 + 4 * 10, "140bus": 372}
    assert len(system_of("39bus", island=False).moving) == 128
