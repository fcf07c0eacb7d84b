"""Every path inside a results folder, and where such folders of a case lie unless told otherwise.

A checkout has a whole reference run of each case. An installed package has of each its models, its policies
and the table of objectives (`rows.OBJECTIVES`), so that every method answers in an empty folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from ded_bench.problem.case import REPOSITORY, Case

#: Where reference runs lie: inside an installed package, or in a checkout's results.
REFERENCE_RUNS = next(
    (p for p in (REPOSITORY / "ded_bench" / "_reference_runs", REPOSITORY / "results") if p.is_dir()),
    REPOSITORY / "results",
)

#: The plant of rows of the closed loop that name none.
PLANT = "lossless"


class OnlineKey(NamedTuple):
    """What makes a row of `online.csv` unique. `model` and `policy` are `name@fingerprint`, or empty."""

    scenario: str
    regime: str
    method: str
    settings: str
    model: str
    policy: str
    period_s: float
    latency_s: float
    forecast: str
    predicted: bool
    warm: bool
    plant: str = PLANT


class ResultsFolder:
    """Where a results folder keeps what; it need not exist."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results = path / "results.csv"  # rows of instance × regime × method × settings
        self.schedules = path / "schedules"  # of the results' rows, see `archive`
        self.failures = path / "failures.log"  # what methods raised, with whole tracebacks
        self.validated = path / "validated.csv"  # kept schedules on plants other than those of their rows
        self.referee = path / "referee.csv"  # what the field's simulator says of kept schedules
        self.timing = path / "timing.csv"  # times of methods alone on the machine
        self.latency = path / "latency.csv"  # times that `ded-bench online` took itself, of several runs
        self.online = path / "online.csv"  # rows of scenario × regime × method × settings × loop
        self.hindsight = path / "hindsight.csv"  # rows of scenario × regime, with full knowledge
        self.koopman = path / "koopman"  # identified models, see `model`
        self.policies = path / "policies"  # trained ones, see `policy`
        self.certificates = path / "certificate.json"  # certificates of policies
        self.tables, self.figures = path / "tables", path / "figures"  # of the report
        self.objectives = self.tables / "objectives.csv"  # see `rows.OBJECTIVES`

    def archive(self, method: str, settings: str, regime: str) -> Path:
        """The schedules of some rows (see `results.archive`)."""
        return self.schedules / method / settings / f"{regime}.npz"

    def log_failure(self, what: str, trace: str) -> None:
        """Add a traceback to the log; the folder is made if there is none."""
        self.path.mkdir(parents=True, exist_ok=True)
        with self.failures.open("a", encoding="utf-8", errors="replace") as log:
            log.write(f"{what}\n{trace}\n")

    def model(self, kind: str) -> Path:
        """An identified model."""
        return self.koopman / f"{kind}.safetensors"

    def policy(self, name: str) -> Path:
        """A trained policy."""
        return self.policies / f"{name}.safetensors"

    def certificate_rows(self, *name: str) -> Path:
        """What one certificate counts, one row per instance; `name` is what makes it unique."""
        return self.path / "certificates" / f"{'-'.join(filter(None, name))}.csv.gz"

    def trajectory(self, key: OnlineKey) -> Path:
        """The trajectory of a row of the closed loop."""
        loop = f"{key.period_s:g}s-{key.latency_s:g}s-{key.forecast}"
        loop += ("" if key.predicted else "-present") + ("" if key.warm else "-cold")
        made_with = "+".join(filter(None, (key.settings, key.model, key.policy)))
        place = self.path / "online" / key.plant / key.method / made_with / key.regime
        return place / loop / f"{key.scenario}.safetensors"

    def hindsight_trajectory(self, scenario: str, regime: str, plant: str) -> Path:
        """The trajectory of a scenario's hindsight."""
        return self.path / "online" / plant / "hindsight" / regime / f"{scenario}.safetensors"


def default_results(case: Case) -> Path:
    """Where results of a case lie unless told otherwise, below the working directory."""
    return Path("results") / case.id


def reference_run(case: Case) -> Path:
    """The results folder of a case's reference run; it need not exist."""
    return REFERENCE_RUNS / f"{case.id}-reference"


def search_folders(case: Case, *first: Path) -> tuple[Path, ...]:
    """Where models and policies are looked for: `first`, the default results, then the reference run."""
    return tuple(dict.fromkeys((*first, default_results(case), reference_run(case))))
