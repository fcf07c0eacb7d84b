"""Every path inside a results folder, and where such folders of a case lie unless told otherwise.

A checkout has a whole reference run of each case. An installed package has of each its models, its policies
and the table of objectives (`results.objectives`), so that every method answers in an empty folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ded_bench.problem.case import REPOSITORY, Case

#: Where reference runs lie: inside an installed package, or in a checkout's results.
REFERENCE_RUNS = next(
    (p for p in (REPOSITORY / "ded_bench" / "_reference_runs", REPOSITORY / "results") if p.is_dir()),
    REPOSITORY / "results",
)


@dataclass(frozen=True)
class ResultsFolder:
    """Where a results folder keeps what; it need not exist."""

    path: Path

    @property
    def contents(self) -> tuple[Path, ...]:
        """What makes a folder one of results: at least one of these is there."""
        names = ("results.csv", "timing.csv", "online.csv", "certificate.json", "koopman", "policies")
        return tuple(self.path / name for name in names)

    @property
    def results(self) -> Path:
        """Rows of instance × regime × method × settings."""
        return self.path / "results.csv"

    @property
    def timing(self) -> Path:
        """Times of methods alone on the machine."""
        return self.path / "timing.csv"

    @property
    def latency(self) -> Path:
        """Times that `ded-bench online` took itself, of several runs."""
        return self.path / "latency.csv"

    @property
    def schedules(self) -> Path:
        """Folder of the schedules of the results' rows."""
        return self.path / "schedules"

    def archive(self, method: str, settings: str, regime: str) -> Path:
        """The schedules of some rows (see `results.archive`)."""
        return self.schedules / method / settings / f"{regime}.npz"

    @property
    def failures(self) -> Path:
        """Log of what methods raised, with whole tracebacks."""
        return self.path / "failures.log"

    def log_failure(self, what: str, trace: str) -> None:
        """Add a traceback to the log; the folder is made if there is none."""
        self.path.mkdir(parents=True, exist_ok=True)
        with self.failures.open("a", encoding="utf-8", errors="replace") as log:
            log.write(f"{what}\n{trace}\n")

    @property
    def validated(self) -> Path:
        """Kept schedules on plants other than those of their rows."""
        return self.path / "validated.csv"

    @property
    def referee(self) -> Path:
        """What the field's simulator says of kept schedules."""
        return self.path / "referee.csv"

    @property
    def koopman(self) -> Path:
        """Folder of identified models."""
        return self.path / "koopman"

    def model(self, kind: str) -> Path:
        """An identified model."""
        return self.koopman / f"{kind}.safetensors"

    @property
    def models(self) -> list[Path]:
        """The models that are there, by name."""
        return sorted(self.koopman.glob("*.safetensors"))

    def policy(self, name: str) -> Path:
        """A trained policy."""
        return self.path / "policies" / f"{name}.safetensors"

    @property
    def policies(self) -> list[Path]:
        """The policies that are there, by name."""
        return sorted((self.path / "policies").glob("*.safetensors"))

    @property
    def certificates(self) -> Path:
        """Certificates of policies."""
        return self.path / "certificate.json"

    def certificate_rows(self, *name: str) -> Path:
        """What one certificate counts, one row per instance; `name` is what makes it unique."""
        return self.path / "certificates" / f"{'-'.join(filter(None, name))}.csv"

    @property
    def tables(self) -> Path:
        """Folder of the report's tables."""
        return self.path / "tables"

    @property
    def figures(self) -> Path:
        """Folder of the report's figures."""
        return self.path / "figures"


def default_results(case: Case) -> Path:
    """Where results of a case lie unless told otherwise, below the working directory."""
    return Path("results") / case.id


def reference_run(case: Case) -> Path:
    """The results folder of a case's reference run; it need not exist."""
    return REFERENCE_RUNS / f"{case.id}-reference"


def search_folders(case: Case, *first: Path) -> tuple[Path, ...]:
    """Where models and policies are looked for: `first`, the default results, then the reference run."""
    return tuple(dict.fromkeys((*first, default_results(case), reference_run(case))))
