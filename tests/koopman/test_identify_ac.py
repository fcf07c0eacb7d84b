"""The Koopman model learned from AC trajectories: stable, at rest in equilibria, right about losses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ded_bench.cli import main
from ded_bench.evaluate import ac_rollouts
from ded_bench.files.errors import InputError
from ded_bench.koopman import identify_ac
from ded_bench.koopman.identify_ac import sample_ac
from ded_bench.koopman.model import Koopman
from ded_bench.methods import ded_ko_knots
from ded_bench.methods.solution import Settings
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.solvers.status import Status
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import Trajectory

TWO_AREA = Case.load("two-area")
DATA = AcCase.of(TWO_AREA)
#: Numbers of the first draws of seed 0 that the AC network can carry.
FEW = 2


@pytest.fixture(scope="module")
def drawn() -> tuple[list[Instance], list[Trajectory]]:
    return sample_ac(TWO_AREA, DATA, 0, 1)


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """What the command makes, judged on one trajectory only."""
    path: Path = tmp_path_factory.mktemp("models") / "koopman-ac.npz"
    command = f"train-ko --case two-area --truth ac --count {FEW} --noise 1e-4 --out {path}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ac_rollouts, "HELD_OUT", 1)
        assert main(command.split()) == 0
    return path


@pytest.fixture(scope="module")
def model(file) -> Koopman:
    return Koopman.load(file, TWO_AREA)


def test_model_is_stable_with_one_constant(model):
    size = np.sort(np.abs(np.linalg.eigvals(model.k)))
    assert size[-1] == pytest.approx(1.0, abs=1e-12)
    assert size[-2] < 1 - 1e-5
    assert model.kind == "koopman-ac"
    assert model.training["noise_hz"] == 1e-4


def test_equilibria_rest(model, drawn):
    """Without initial frequency, constant inputs leave ω at zero and P_s at its affine law."""
    instance, run = (part[0] for part in drawn)
    quiet = instance.model_copy(
        update={
            "initial": instance.initial.model_copy(update={"omega": dict.fromkeys(TWO_AREA.generators, 0.0)})
        }
    )
    psi = model.initial(Network(TWO_AREA), [quiet])[0]
    inputs = np.tile(np.hstack([run.p_gen[0], run.p_load[0]]), (50, 1))
    outputs = model.rollout(psi, inputs)
    n_gen = len(TWO_AREA.generators)
    assert np.abs(outputs[:, :n_gen]).max() < 1e-9
    assert np.ptp(outputs[:, n_gen]) < 1e-9
    # The slack carries the losses: what a lossless model says is off by 0.5 pu.
    assert abs(outputs[0, n_gen] - run.p_slack[0]) < 0.2 < abs(-inputs[0].sum() - run.p_slack[0])


def test_errors_beside_the_lossless_equations(file):
    table = pd.read_csv(file.with_suffix(".errors.csv"))
    assert table["model"].tolist() == ["linear", "koopman-ac", "lossless simulation"]
    assert table["n"].tolist() == [1, 1, 1]
    assert (table.select_dtypes("number") > 0).all(axis=None)


@pytest.mark.parametrize("options", ["--noise 1e-4", "--truth ac --kind koopman-paper"])
def test_options_that_do_not_go_together(options, tmp_path):
    assert main(f"train-ko --case two-area {options} --out {tmp_path / 'a.npz'}".split()) == 2


def test_methods_read_it_as_a_file(file, drawn):
    settings = Settings(model=str(file))
    solution = ded_ko_knots.prepare(TWO_AREA, "NO", settings)(drawn[0][0])
    assert solution.status == Status.OPTIMAL
    assert settings.slug == "default-koopman-ac"


def test_grids_that_carry_nothing(monkeypatch):
    monkeypatch.setattr(identify_ac, "MAX_DRAWS", -1)
    with pytest.raises(InputError, match="draws in a row"):
        sample_ac(TWO_AREA, DATA, 0, 1)
