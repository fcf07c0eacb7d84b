"""Grids of others: a shipped grid, written as MATPOWER and PSS/E have it, comes back; what lacks is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ded_bench
from ded_bench.analysis.matpower_case import imported, read_matpower
from ded_bench.cli import main
from ded_bench.files.errors import InputError
from ded_bench.problem.case import REPOSITORY, Case
from tests.cli.command_line import refused

GRID = "39bus"
PUBLIC = REPOSITORY / "examples" / "grids"
#: Two machines at a bus, another base than 100 MVA, a tap, a bus out of service, a machine switched off, rows
#: on one line; at the machines' buses the power flow is to be found.
SMALL = """function mpc = small
mpc.version = '2';  % a comment with ] and ;
mpc.baseMVA = 200;
mpc.bus = [1 3 0 0 0 0 1 1.02 0 230 1 1.1 0.9; 2 1 150 40 0 5 1 1 0 230 1 1.1 0.9
  3 2 0 0 0 0 1 1 0 230 1 1.1 0.9; 9 4 0 0 0 0 1 1 0 230 1 1.1 0.9;
];
mpc.gen = [
  1, 60, 0, 99, -99, 1.02, 200, 1, 150, 10;
  3  50  0 99 -99 1.01 100 1 90 20;
  3  40  0 99 -99 1.01 50 1 60 10;
  3  10  0 99 -99 1.01 50 0 60 10;
];
mpc.branch = [
  1 2 0.01 0.1 0.02 0 0 0 0 0 1 -360 360;
  2 3 0.01 0.1 0.02 0 0 0 0.98 0 1 -360 360;
  1 3 0.02 0.2 0.04 0 0 0 0 0 1 -360 360;
  1 3 0.02 0.2 0.04 0 0 0 0 0 0 -360 360;
];
mpc.bus_name = {
  'a; b';
};
mpc.gencost = [2 0 0 3 0.01 Inf 0];
"""
DYNAMICS = "bus,h,xd1,mva,p_max\n1,4,0.25,,\n3,3,0.3,,\n3,5,0.2,80,0.7\n"


def files(folder: Path, grid: str = SMALL, dynamics: str = DYNAMICS, kind: str = "csv") -> list[Path]:
    paths = [folder / "grid.m", folder / f"machines.{kind}"]
    for path, text in zip(paths, (grid, dynamics), strict=True):
        path.write_text(text)
    return paths


def as_matpower(case: Case) -> tuple[str, str]:
    """A shipped grid as a MATPOWER file and dyr records; voltages at loads are not told."""
    network = case.detailed.network
    slack = network.slack_machine_bus
    bus, gen, branch, dyr = [], [], [], []
    machines = {machine.bus: machine for machine in network.machines}
    for b in network.buses:
        kind = 3 if b.id == slack else 2 if b.id in machines else 1
        drawn, angle = (b.pd * 100, b.qd * 100, b.gs * 100, b.bs * 100), b.angle_deg if kind == 3 else 0
        bus.append(" ".join(map(str, (b.id, kind, *drawn, 1, 1, angle))))
        if kind > 1:
            m = machines[b.id]
            gen.append(f"{b.id} {b.pg * 100} 0 0 0 {b.v} {m.mva} 1 {b.pg * 150} {b.pg * 50}")
            dyr.append(f"{b.id} 'GENROU' 1 6.5, .03 .4 .05 {m.h} 0 1.8 1.7 {m.xd1} .5 .2 .1 0 0 / {b.id}")
    for line in network.lines:
        row = (line.from_bus, line.to_bus, line.r, line.x, line.b, 0, 0, 0, line.tap, line.shift_deg, 1)
        branch.append(" ".join(map(str, row)))
    parts = {"bus": bus, "gen": gen, "branch": branch}
    text = "function mpc = case\nmpc.baseMVA = 100;\n"
    return text + "".join(f"mpc.{n} = [\n{';'.join(rows)};\n];\n" for n, rows in parts.items()), "\n".join(
        dyr
    )


def test_a_shipped_grid_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To the digits of its files, through PSS/E's records; the end of the road is a feasible schedule."""
    shipped, out = Case.load(GRID), tmp_path / "again"
    grid, dynamics = files(tmp_path, *as_matpower(shipped), "dyr")
    assert main(["import", str(grid), "--dynamics", str(dynamics), "--out", str(out)]) == 0
    assert f"regimes and sampling as in {GRID}; knots {shipped.n_knots}" in capsys.readouterr().out
    case = Case.load(out)
    assert (case.generators, case.slack) == (shipped.generators, shipped.slack)
    for name in ("p_nominal", "inertia", "p_min", "p_max", "ramp"):
        np.testing.assert_allclose(getattr(case, name), getattr(shipped, name), rtol=2e-5)
    # The shipped grid leaves three small loads out, which network.json has.
    loads, known = dict(zip(case.loads, case.load_nominal, strict=True)), shipped.load_nominal
    np.testing.assert_allclose([loads[bus] for bus in shipped.loads], known, rtol=2e-5)
    np.testing.assert_allclose([b.v for b in case.buses], [b.v for b in shipped.buses], atol=2e-5)
    lines = [
        sorted((*sorted([a.from_bus, a.to_bus]), round(a.x, 5)) for a in c.lines) for c in (case, shipped)
    ]
    assert lines[0] == lines[1]
    assert main(["instances", "--case", str(out), "--count", "2", "--test", "1"]) == 0
    [instance] = ded_bench.load_instances(out)
    regime = max(case.regimes, key=lambda name: case.regimes[name].omega_hz)
    for method in ("ed", "ded-slp"):
        answer = ded_bench.solve(instance, method, regime, case)
        assert ded_bench.score(instance, answer.schedule, regime, case).feasible


def test_rules_by_hand(tmp_path: Path) -> None:
    """Units at one bus share its reactive power by rating; the reference's first machine is the slack."""
    grid, dynamics = files(tmp_path)
    assert main(["import", str(grid), "--dynamics", str(dynamics), "--out", str(tmp_path / "s")]) == 0
    case = Case.load(tmp_path / "s")
    assert (case.slack, case.generators, case.loads) == ("g1", ("g3a", "g3b"), ("2",))
    np.testing.assert_allclose(case.load_nominal, [-1.5])
    np.testing.assert_allclose(case.p_nominal, [0.5, 0.4])
    np.testing.assert_allclose(case.p_max, [0.9, 0.7])
    np.testing.assert_allclose(
        case.inertia, [2 * h * s / (120 * np.pi * 100) for h, s in ((3, 100), (5, 80))], rtol=1e-6
    )
    lines = {(line.from_bus, line.to_bus): (line.r, line.x) for line in case.lines}
    assert lines["1", "2"] == (0.005, 0.05)  # of 200 MVA
    assert lines["2", "3"] == pytest.approx((0.0049, 0.049))
    assert lines["3", "g3b"] == (0.0, 0.25)
    assert len(case.lines) == 3 + 3
    v = {bus.id: bus.v for bus in case.buses}
    assert (v["1"], v["3"]) == (1.02, 1.01)
    assert 0.9 < v["2"] < 1.02


def test_data_of_machines_out_of_service_are_no_others(tmp_path: Path) -> None:
    """Whether these are told of, too, or not."""
    idle_last = "  3  10  0 99 -99 1.01 50 0 60 10;\n"
    idle_first = SMALL.replace(idle_last, "").replace("  3  50  0", idle_last + "  3  50  0")
    told = [DYNAMICS, DYNAMICS.replace("3,3,0.3,,", "3,9,0.9,,\n3,3,0.3,,")]
    cases = [
        imported(*files(tmp_path, grid, text), "s")
        for grid, text in zip((SMALL, idle_first), told, strict=True)
    ]
    assert cases[0] == cases[1]


def test_a_dyr_file_may_begin_with_a_comment(tmp_path: Path) -> None:
    record = "{} 'GENROU' 1 6.5 .03 .4 .05 {} 0 1.8 1.7 {} .5 .2 .1 0 0 /\n"
    text = "".join(record.format(*one) for one in ((1, 4, 0.25), (3, 3, 0.3), (3, 5, 0.2)))
    plain, commented = (
        imported(*files(tmp_path, dynamics=start + text, kind="dyr"), "s") for start in ("", "// of mine\n")
    )
    assert plain == commented


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("3,5,0.2,80,0.7\n", "", "h, xd1: are needed of every machine in service, also at bus 3"),
        ("bus,h,xd1", "bus,H,xd1", "h: required column is missing"),
        ("3,3,0.3,,", "3,3,-0.3,,", "line 3, xd1: '-0.3' is not a valid value"),
        (
            "mpc.gencost",
            "mpc.bus(:, 3) = mpc.bus(:, 3) / 1e3;\nmpc.gencost",
            "only assignments of plain data",
        ),
        ("mpc.gencost", "system('true');\nmpc.gencost", "system('true');: only assignments of plain data"),
        ("2 3 0.01 0.1", "2 3 0.01 -0.1", "mpc.branch 2-3: needs r of at least 0 and x above 0"),
        ("2 1 150 40 0 5 1 1 0 230 1 1.1 0.9", "2 1 150 40", "bus, row 2: has 4 values, not 13"),
        ("2 1 150 40", "2 1 15000 40", "the AC power flow has no solution"),
        ("3  50  0", "3  95  0", "machine at bus 3: 0.95 pu is not within its limits, 0.2 to 0.9"),
        ("mpc.bus = [1 3", "mpc.bus = [1 2", "exactly one reference bus"),
        ("3 2 0 0 0 0 1 1 0", "3 4 0 0 0 0 1 1 0", "mpc.bus: 3 is missing or out of service"),
        ("mpc.baseMVA = 200", "mpc.baseMVA = 0", "baseMVA and the size of all voltages must be above 0"),
        ("1 90 20", "1 Inf 20", "machine at bus 3: 0.5 pu is not within its limits, 0.2 to inf"),
        (
            "1,4,0.25,,\n",
            "1,4,0.25,,\n1,4,0.25,,\n",
            "2 rows for bus 1, which has 1 machines in service, 1 in",
        ),
    ],
)
def test_what_is_missing_or_wrong_is_named(tmp_path: Path, capsys, old: str, new: str, said: str) -> None:
    grid, dynamics = files(tmp_path, SMALL.replace(old, new), DYNAMICS.replace(old, new))
    line = refused(capsys, "import", grid, "--dynamics", dynamics, "--out", tmp_path / "s")
    assert said in line
    assert not (tmp_path / "s").exists()


def test_regimes_are_those_of_any_lossless_case(tmp_path: Path, capsys) -> None:
    """The paper's, too, whose file is of an older schema."""
    grid, dynamics = files(tmp_path)
    line = ["import", str(grid), "--dynamics", str(dynamics), "--out", str(tmp_path / "s"), "--like"]
    assert "has no lossless network" in refused(capsys, *line, "two-area-agc")
    assert main([*line, "9bus"]) == 0
    assert Case.load(tmp_path / "s").regimes == Case.load("9bus").regimes


def test_more_machines_at_a_bus_than_letters_are_refused(tmp_path: Path, capsys) -> None:
    machine = "  3  40  0 99 -99 1.01 50 1 60 10;\n"
    many = SMALL.replace(machine, machine.replace("40", "2").replace("60 10", "60 0") * 27)
    grid, dynamics = files(tmp_path, many, DYNAMICS + "3,5,0.2,80,0.7\n" * 26)
    assert "string should match" in refused(
        capsys, "import", grid, "--dynamics", dynamics, "--out", tmp_path / "s"
    )


def test_what_is_read_of_a_file(tmp_path: Path) -> None:
    found = read_matpower(files(tmp_path)[0])
    assert {name: values.shape for name, values in found.items()} == {
        **{"baseMVA": (1, 1), "bus": (4, 13), "gen": (4, 10), "branch": (4, 13), "gencost": (1, 7)}
    }
    with pytest.raises(InputError, match="cannot be read"):
        read_matpower(tmp_path / "none.m")


def test_what_stands_in_comments_is_not_read(tmp_path: Path) -> None:
    """Nor does a % in a string begin one."""
    other = "%{\nmpc.baseMVA = 1;\n  %{\nmpc.branch = [1];\n  %}\nmpc.bus = [1];\n%}\n"
    strings = "mpc.bus_name = {'A 50%'};\nmpc.ramp = 7;  % it's '%' here\nmpc.x = {'q'};\n"
    found = read_matpower(files(tmp_path, SMALL + other + strings)[0])
    assert found.pop("ramp") == 7.0
    expected = read_matpower(files(tmp_path)[0])
    assert found.keys() == expected.keys()
    assert all(np.array_equal(found[name], expected[name]) for name in expected)


def test_a_folder_that_cannot_name_a_case_is_named(tmp_path: Path, capsys) -> None:
    grid, dynamics = files(tmp_path)
    line = refused(capsys, "import", grid, "--dynamics", dynamics, "--out", tmp_path / "my grid")
    assert "--out: " in line
    assert "'my grid' cannot name a case" in line


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize(("name", "like"), [("ieee14", ["--like", "39bus"]), ("ieee39", [])])
def test_public_grids_to_the_end_of_the_road(
    name: str, like: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imported, drawn, solved, reported; what static dispatch breaks `ded-slp` keeps."""
    monkeypatch.chdir(tmp_path)
    grid = PUBLIC / name
    assert not main(["import", f"{grid}.m", "--dynamics", f"{grid}.csv", *like, "--out", name])
    assert not main(["instances", "--case", name, "--count", "2", "--test", "1"])
    assert not main(["solve", "--case", name, "--method", "ed,ded-slp", "--regime", "TO"])
    rows = pd.read_csv(tmp_path / "results" / name / "results.csv").set_index("method")
    assert rows["feasible"].to_dict() == {"ed": False, "ded-slp": True}
    assert not main(["report", "--case", name])
    assert "DED (SLP)" in (tmp_path / "results" / name / "report.md").read_text()


def test_two_sources_of_new_england_agree() -> None:
    """MATPOWER's has its reference elsewhere; the other machines are those of the shipped grid."""
    case, shipped = imported(PUBLIC / "ieee39.m", PUBLIC / "ieee39.csv", "public"), Case.load("39bus")
    assert set(case.generators) - set(shipped.generators) == {"g39"}
    for name in set(case.generators) & set(shipped.generators):
        own, other = case.machines[name], shipped.machines[name]
        assert (own.m, own.p_nominal) == pytest.approx((other.m, other.p_nominal), rel=1e-3)
