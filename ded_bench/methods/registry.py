"""METHODS, the registry: a new method is one module and one line here, or a function elsewhere (`plugin`).

A method's module offers `prepare(case, regime, settings) -> (instance -> Solution)` and `SETTINGS`, a
mapping from the slugs of its settings to keyword options. If it depends on a trained model or policy,
it also offers `artifacts(case, regime, settings) -> tuple[Artifact, ...]`, all of them. If it is a policy
to be trained, its line here names the module whose `train` does it (see `training_record`), and
`ded-bench train-dpc` knows it. What `prepare` returns may also have `solve(instance, last=None)`, which
the closed loop calls: it may start from the plan in force, and where no schedule meets every limit it
may answer `Infeasible` with the schedule that exceeds them least.

A setting whose answers depend on much more than the method's others has a module of its own, which offers
the same and which the method's line names: the code of a row is that of the module that answers. Where a
setting differs in operation only, `TIMED_AS` of its module names the setting whose times are its own.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.methods import plugin
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.solution import Settings, Solver
from ded_bench.methods.training_record import Trainer
from ded_bench.problem.case import Case


@dataclass(frozen=True)
class Method:
    """A method; its module, or the `module:function` of others, is imported when first used."""

    name: str
    module: str
    title: str
    trainer: str = ""  # the module that trains it
    elsewhere: tuple[tuple[str, str], ...] = ()  # settings that another module answers: slug, module

    def module_of(self, settings: str) -> str:
        """The module that answers, by the settings' name or their slug in the results."""
        of_slug = (module for slug, module in self.elsewhere if f"{settings}-".startswith(f"{slug}-"))
        return next(of_slug, self.module)

    def _answering(self, settings: str = "") -> Any:
        module = self.module_of(settings)
        return plugin.load(module) if ":" in module else importlib.import_module(module)

    @property
    def settings(self) -> Mapping[str, Mapping[str, Any]]:
        """The settings this method knows: options by slug."""
        known: dict[str, Mapping[str, Any]] = dict(self._answering().SETTINGS)
        for slug, module in self.elsewhere:
            known[slug] = importlib.import_module(module).SETTINGS[slug]
        return known

    def options(self, settings: Settings) -> Mapping[str, Any]:
        """The options that the settings' name stands for.

        Raises:
            InputError: this method has no such settings (names those it has).
        """
        known = self.settings
        if settings.name not in known:
            problem = f"unknown to method {self.name} (known: {', '.join(known)})"
            raise InputError("--settings", settings.name, problem)
        return known[settings.name]

    def prepare(self, case: Case, regime: str, settings: Settings) -> Solver:
        """Return the function that solves one instance after another.

        Raises:
            InputError: unknown settings, or a model or policy that does not fit.
        """
        self.options(settings)  # says what is wrong with them
        solver: Solver = self._answering(settings.name).prepare(case, regime, settings)
        return solver

    def artifacts(self, case: Case, regime: str, settings: Settings) -> tuple[Artifact, ...]:
        """All models and policies that answers depend on.

        Raises:
            InputError: unknown settings, or a model or policy that is missing or does not fit.
        """
        self.options(settings)  # says what is wrong with them
        find = getattr(self._answering(settings.name), "artifacts", None)
        return tuple(find(case, regime, settings)) if find else ()

    def timed_as(self, settings: str) -> str:
        """Name of the settings whose times stand for these: `TIMED_AS` of the module may name others."""
        names: Mapping[str, str] = getattr(self._answering(settings), "TIMED_AS", {})
        return names.get(settings, settings)

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
        Method(
            "ded",
            "ded_bench.methods.ded",
            "DED",
            elsewhere=(
                ("accelerated", "ded_bench.methods.ded_sequential"),
                ("start-ed", "ded_bench.methods.ded_start"),
                ("start-ko", "ded_bench.methods.ded_start"),
                ("start-random", "ded_bench.methods.ded_start"),
            ),
        ),
        Method("ded-radau", "ded_bench.methods.ded_radau", "DED (Radau)"),
        Method(
            "ded-slp",
            "ded_bench.methods.ded_slp",
            "DED (SLP)",
            elsewhere=(("ac", "ded_bench.methods.ded_slp_ac"),),
        ),
        Method("ed", "ded_bench.methods.ed", "ED"),
        Method("ded-ko", "ded_bench.methods.ded_ko", "DED-KO"),
        Method(
            "ded-ko-knots",
            "ded_bench.methods.ded_ko_knots",
            "DED-KO (knots)",
            elsewhere=(
                ("swing-ac", "ded_bench.methods.ded_ko_knots_swing"),
                ("receding", "ded_bench.methods.receding_knots"),
                ("receding-wide", "ded_bench.methods.receding_knots"),
                ("real-time", "ded_bench.methods.real_time_knots"),
                ("reserve", "ded_bench.methods.real_time_reserve"),
            ),
        ),
        Method(
            "ded-dpc-paper",
            "ded_bench.methods.dpc_paper.paper_policy",
            "DED-DPC (paper's recipe)",
            trainer="ded_bench.methods.dpc_paper.paper_training",
        ),
        Method(
            "ded-dpc", "ded_bench.methods.dpc.policy", "DED-DPC", trainer="ded_bench.methods.dpc.training"
        ),
        Method("ded-dpc-refined", "ded_bench.methods.dpc.refined", "DED-DPC (refined)"),
        Method(
            "ded-dpc-shared",
            "ded_bench.methods.dpc_shared.shared_policy",
            "DED-DPC (shared weights)",
            trainer="ded_bench.methods.dpc_shared.unrolled_training",
        ),
        Method(
            "ded-dpc-shared-refined",
            "ded_bench.methods.dpc_shared.shared_refined",
            "DED-DPC (shared weights, refined)",
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


def trainable() -> list[str]:
    """Names of the methods that are trained; imports none of them."""
    return [method.name for method in METHODS.values() if method.trainer]


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
    slug = plugin.slug_of(target)
    return Method(slug, target, slug)
