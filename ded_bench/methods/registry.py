"""METHODS, the registry: a new method is one module and one line here, or a function elsewhere (`plugin`).

A method's module offers `prepare(case, regime, settings) -> (instance -> Solution)` and `SETTINGS`, a
mapping whose keys are the slugs of its settings. If it depends on a trained model or policy, it
also offers `artifact(case, regime, settings) -> str`, a fingerprint of it.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ded_bench.files.errors import InputError
from ded_bench.methods import plugin
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Case


@dataclass(frozen=True)
class Method:
    """A method; its module, or the `module:function` of others, is imported when first used."""

    name: str
    module: str
    title: str

    @property
    def _loaded(self) -> Any:
        return plugin.load(self.module) if ":" in self.module else importlib.import_module(self.module)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The settings this method knows, by slug."""
        known: Mapping[str, Any] = self._loaded.SETTINGS
        return known

    def prepare(self, case: Case, regime: str, settings: Settings) -> Solver:
        """Return the function that solves one instance after another.

        Raises:
            InputError: unknown settings, or a model or policy that does not fit.
        """
        self._check(settings)
        solver: Solver = self._loaded.prepare(case, regime, settings)
        return solver

    def artifact(self, case: Case, regime: str, settings: Settings) -> str:
        """Fingerprint of the trained model or policy that answers depend on; empty if none."""
        self._check(settings)
        find = getattr(self._loaded, "artifact", None)
        return str(find(case, regime, settings)) if find else ""

    def _check(self, settings: Settings) -> None:
        if settings.name not in self.settings:
            known = ", ".join(self.settings)
            raise InputError("--settings", settings.name, f"unknown to method {self.name} (known: {known})")


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method("ded", "ded_bench.methods.ded", "DED"),
        Method("ded-radau", "ded_bench.methods.ded_radau", "DED (Radau)"),
        Method("ed", "ded_bench.methods.ed", "ED"),
        Method("ded-ko", "ded_bench.methods.ded_ko", "DED-KO"),
        Method("ded-ko-knots", "ded_bench.methods.ded_ko_knots", "DED-KO (50 knots)"),
        Method("ded-dpc-paper", "ded_bench.methods.dpc_paper.paper_policy", "DED-DPC (paper's recipe)"),
        Method("ded-dpc", "ded_bench.methods.dpc.policy", "DED-DPC"),
        Method("ded-dpc-refined", "ded_bench.methods.dpc.refined", "DED-DPC (refined)"),
    )
}


def registered() -> dict[str, Method]:
    """Every method that has a name: ours, then those that installed packages bring, by name.

    Ours keep their names whatever others call theirs.
    """
    others = plugin.installed()
    names = sorted(name for name in others if name not in METHODS and plugin.SLUG.fullmatch(name))
    return METHODS | {name: Method(name, others[name], name) for name in names}


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
