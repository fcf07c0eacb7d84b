"""Every path inside a results folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


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
    def schedules(self) -> Path:
        """Folder of the schedules of the results' rows."""
        return self.path / "schedules"

    def archive(self, method: str, settings: str, regime: str) -> Path:
        """The schedules of some rows (see `results.archive`)."""
        return self.schedules / method / settings / f"{regime}.npz"

    @property
    def validated(self) -> Path:
        """Kept schedules on plants other than those of their rows."""
        return self.path / "validated.csv"

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
    def training_histories(self) -> list[Path]:
        """The loss curves of the policies that are there, by name."""
        return sorted((self.path / "policies").glob("*.history.csv"))

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

    def report(self, suffix: str) -> Path:
        """The report; `suffix` is `md` or `html`."""
        return self.path / f"report.{suffix}"
