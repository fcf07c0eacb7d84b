"""What a trained method offers and leaves behind: its `train`, facts, the history of its loss.

Beside a policy `p.safetensors` lie `p.history.csv` and `p.checkpoint`, the state to go on from. The
history has one row per look at the loss, and columns

* `epoch`, counted from 1, and `seconds`, the training time until then;
* `training` and `held out`, the loss on what is trained on and on what is not, empty if not taken;
* and any others, which are terms of the loss or what else the method wants to show over time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.results.folder import ResultsFolder
from ded_bench.surrogates.find import find_model
from ded_bench.surrogates.koopman import Koopman

#: The surrogate on which policies train unless told otherwise; the names of their files do not say it.
DEFAULT_MODEL = "koopman"


def policy_file(results: Path, method: str, regime: str, model: str = "") -> Path:
    """Where a results folder keeps a policy: `<method>-<regime>`, and the model unless it is the default."""
    suffix = "" if model in ("", DEFAULT_MODEL) else f"-{Path(model).stem}"
    return ResultsFolder(results).policy(f"{method}-{regime}{suffix}")


def find_policy_file(method: str, case: Case, regime: str, settings: Settings) -> Path:
    """Return the policy file given in the settings, else the first one in the folders to search.

    Raises:
        InputError: there is none; names the command that trains one.
    """
    if settings.policy:
        return settings.policy
    for folder in settings.search:
        path = policy_file(folder, method, regime, settings.model)
        if path.is_file():
            return path
    command = f"ded-bench train-dpc --method {method} --regime {regime} --case {case.place}"
    command += "" if settings.model in ("", DEFAULT_MODEL) else f" --model {settings.model}"
    raise InputError("--policy", "", f"no {method} policy for {regime} yet; run `{command}`")


#: First columns of every history.
HISTORY = ("epoch", "seconds", "training", "held out")
#: Facts that tell how good the policy that was kept is; a training has at least one of them.
LOSSES = ("training_loss", "held_out_loss")


@dataclass(frozen=True)
class TrainingOptions:
    """What the caller of a training decides, whatever the method."""

    seed: int = 0
    seconds: float | None = None  # end after so much training time; None: train for all epochs
    epochs: int | None = None  # None: as many as the method's recipe says
    resume: bool = False  # go on from the checkpoint, if there is one
    device: str = "cpu"  # of torch, for methods that take it
    model: str = ""  # surrogate to train on, by name or file, for methods that train on one
    search: tuple[Path, ...] = ()  # folders where trained models may lie
    version: str = ""  # of this package, and its commit: facts that the policy's file tells
    commit: str = ""

    def find_model(self, case: Case) -> Koopman:
        """The surrogate to train on.

        Raises:
            InputError: there is no such model yet (names the command that makes it), or it does not fit.
        """
        return find_model(case, self.model or DEFAULT_MODEL, self.search)

    def facts(self) -> dict[str, Any]:
        """What every policy's file tells of how it was trained."""
        return {"seed": self.seed, "device": self.device, "version": self.version, "commit": self.commit}


#: `train(case, regime, instances, out, options)` of a method's training module. The instances are all on one
#: time grid. It writes the policy to `out`, its history beside it, and returns something whose `training` has
#: facts: `epochs` (done), `seconds` (spent), one of `LOSSES`, and any others. It raises InputError if the
#: surrogate is missing, the checkpoint to go on from belongs to another training, or there is no such device.
Trainer = Callable[[Case, str, Sequence[Instance], Path, TrainingOptions], Any]


def checkpoint_file(policy: Path) -> Path:
    """Where the state of a policy's training lies."""
    return policy.with_suffix(".checkpoint")


def write_history(policy: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Write the history of a policy's training, to nine digits; see the top of this module.

    Args:
        rows: numbers by column; `epoch` and `seconds` are needed.
    """
    columns = dict.fromkeys([*HISTORY, *(name for row in rows for name in row)])
    import pandas as pd  # help waits for no data frames

    text = pd.DataFrame(rows, columns=list(columns)).to_csv(index=False, float_format="%.9g")
    write_atomically(policy.with_suffix(".history.csv"), text)
