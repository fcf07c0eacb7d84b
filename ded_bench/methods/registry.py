"""METHODS, the registry: a new method is one module and one line here, or a function elsewhere (`plugin`).

A method's module offers `Options`, its parameters (see `methods.options`); `VERSION`, a whole number that is
raised when answers change; and `prepare(case, regime, settings) -> (instance -> Solution)`. Cases that it
does not plan on have another network than its line here says, or `check(case, settings)` refuses them. If it
plans with a surrogate, its line here names the usual one. If it depends on other trained models or policies,
it offers `artifacts(case, regime, settings) -> tuple[Artifact, ...]`, all of them. If it is a policy to be
trained, its line here names the module whose `train` does it (see `training_record`), and `ded-bench
train-dpc` knows it. What `prepare` returns may also have `solve(instance, last=None)`, which the closed loop
calls: it may start from the plan in force, and where no schedule meets every limit it may answer `Infeasible`
with the schedule that exceeds them least.
"""

from __future__ import annotations

import dataclasses
import importlib
from dataclasses import dataclass
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.methods import plugin
from ded_bench.methods.options import options_text, read_options
from ded_bench.methods.solution import Artifact, Settings, Solver, model_artifact
from ded_bench.methods.training_record import Trainer
from ded_bench.problem.case import Case


@dataclass(frozen=True)
class Method:
    """A method; its module, or the `module:function` of others, is imported when first used."""

    name: str
    module: str
    title: str
    trainer: str = ""  # the module that trains it
    takes_device: bool = False  # it can be trained on a GPU
    model: str = ""  # the surrogate that it plans with unless told otherwise, if it takes any
    lossless: bool = False  # it plans on lossless networks alone

    @property
    def _answering(self) -> Any:
        return plugin.load(self.module) if ":" in self.module else importlib.import_module(self.module)

    @property
    def version(self) -> int:
        """Raised when answers change; 0 for a method of others, whose code is an artifact."""
        return int(getattr(self._answering, "VERSION", 0))

    @property
    def options(self) -> type[Any]:
        """The dataclass of its options."""
        kind: type[Any] = self._answering.Options
        return kind

    def canonical(self, settings: Settings) -> Settings:
        """The same settings with the canonical text of their options.

        Raises:
            InputError: unknown options (names those it has), or a wrong value.
        """
        options = options_text(read_options(self.options, settings.options))
        return dataclasses.replace(settings, options=options)

    def interval_s(self, settings: Settings) -> float | None:
        """How often it means to be asked in operation: its option `every`, where it has one and it is set."""
        return getattr(read_options(self.options, settings.options), "every", None)

    def check(self, case: Case, settings: Settings) -> None:
        """Raise InputError if it does not plan on a case, or not with these options."""
        if self.lossless and case.plant_name != "lossless":
            raise InputError(f"case {case.id}", "schema", "has no lossless network, which is needed here")
        if check := getattr(self._answering, "check", None):
            check(case, settings)

    def prepare(self, case: Case, regime: str, settings: Settings) -> Solver:
        """Return the function that solves one instance after another.

        Raises:
            InputError: unknown regime or options, or a model or policy that does not fit.
        """
        case.check_regimes([regime])
        self.check(case, own := self.canonical(settings))
        solver: Solver = self._answering.prepare(case, regime, own)
        return solver

    def artifacts(self, case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
        """All models and policies that answers depend on.

        Raises:
            InputError: unknown options, a case that it does not plan on, or a model or policy that is
                missing or does not fit.
        """
        find, own = getattr(self._answering, "artifacts", None), self.canonical(settings)
        self.check(case, own)
        if find:
            return tuple(find(case, regime, own))
        return (model_artifact(case, own, self.model),) if self.model else ()

    @property
    def train(self) -> Trainer:
        """The function that trains this method's policy.

        Raises:
            InputError: it has none (names the methods that do).
        """
        if not self.trainer:
            raise InputError("--method", self.name, f"is not trained (known: {', '.join(trainable())})")
        trainer: Trainer = importlib.import_module(self.trainer).train
        return trainer


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("ded", "ded_bench.methods.ded", "DED", lossless=True),
        Method("ded-radau", "ded_bench.methods.ded_radau", "DED (Radau)"),
        Method("ded-slp", "ded_bench.methods.ded_slp", "DED (SLP)"),
        Method("ded-rti", "ded_bench.methods.ded_rti", "DED (real-time iteration)", model="trajectory"),
        Method("ed", "ded_bench.methods.ed", "ED"),
        Method("ded-ko", "ded_bench.methods.ded_ko", "DED-KO", model="koopman"),
        Method("ded-ko-knots", "ded_bench.methods.ded_ko_knots", "DED-KO (knots)", model="koopman"),
        Method(
            "ded-dpc-paper",
            "ded_bench.methods.dpc_paper.paper_policy",
            "DED-DPC (paper's recipe)",
            trainer="ded_bench.methods.dpc_paper.paper_training",
            takes_device=True,
            lossless=True,
        ),
        Method(
            "ded-dpc",
            "ded_bench.methods.dpc.dpc_policy",
            "DED-DPC",
            trainer="ded_bench.methods.dpc.training",
            model="koopman",
            lossless=True,
        ),
        Method(
            "ded-admm",
            "ded_bench.methods.admm.admm_policy",
            "DED-ADMM",
            trainer="ded_bench.methods.admm.admm_training",
        ),
    )
}


def registered() -> dict[str, Method]:
    """Every method that has a name: ours, then those that installed packages bring, by name.

    Ours keep their names whatever others call theirs.
    """
    others = plugin.installed()
    names = sorted(name for name in others if name not in METHODS and plugin.SLUG.fullmatch(name))
    return METHODS | {name: Method(name, others[name], name) for name in names}


def trainable(case: Case | None = None) -> list[str]:
    """Names of the methods that are trained, and plan on a case if one is given; imports none of them."""
    fits = case is None or case.plant_name == "lossless"
    return [method.name for method in METHODS.values() if method.trainer and (fits or not method.lossless)]


def get_method(name: str) -> Method:
    """Return a method by its name, as `module:function`, or as the `module.function` of its rows.

    Raises:
        InputError: there is none (names the known ones), or the function cannot be used.
    """
    if name in METHODS:
        return METHODS[name]
    known = registered()
    if name not in known and not (":" in name or "." in name):
        raise InputError("--method", name, f"unknown method (known: {', '.join(known)}, or module:function)")
    if name in known:
        plugin.load(known[name].module)  # says at once what is wrong with it
        return known[name]
    target = name if ":" in name else ":".join(name.rsplit(".", 1))
    plugin.load(target)
    slug = target.replace(":", ".")  # what rows carry
    if not plugin.SLUG.fullmatch(slug):
        raise InputError("--method", target, f"does not make a method's name (wanted: {plugin.SLUG.pattern})")
    return Method(slug, target, slug)
