"""What rows were called before methods had options: names of then, names of now.

A setting was a name, perhaps with that of a surrogate behind it (`default-trajectory`); refined policies and
real-time iterations were settings or methods of their own; a plant was a `truth`.
"""

from __future__ import annotations

import re

from ded_bench.files.table import Cells

#: Surrogates that ended the name of a setting; `koopman` went without saying.
_MODELS = ("koopman-paper", "koopman-single", "linear", "trajectory-ac", "trajectory")
_METHODS = {"ded-dpc-shared": "ded-admm", "ded-dpc-shared-refined": "ded-admm", "ded-dpc-refined": "ded-dpc"}
_SETTINGS = {
    ("ded", "accelerated"): "accelerated=on",
    ("ded-dpc-refined", "default"): "refine=200",
    ("ded-dpc-shared-refined", "default"): "iterations=80",
}
_NUMBERS = (
    (re.compile(r"ded-dpc-refined steps(\d+)"), "refine={}", 1),
    (re.compile(r"ded-slp (\d+)ms"), "knot_s={:g}", 1e-3),
    (re.compile(r"ed (\d+)s"), "every={:g}", 1),
)


def renamed(method: str, settings: str) -> tuple[str, str, str]:
    """Method, settings and surrogate of today for a method and settings of then.

    The surrogate is empty where the settings do not name one. Names that mean nothing today stay as they are.
    """
    model = next((m for m in _MODELS if settings.endswith(f"-{m}")), "")
    name = settings.removesuffix(f"-{model}") if model else settings
    if (method, name) == ("ded-ko-knots", "real-time"):
        return "ded-rti", "default", model
    for pattern, text, unit in _NUMBERS:
        if found := pattern.fullmatch(f"{method} {name}"):
            return _METHODS.get(method, method), text.format(int(found[1]) * unit), model
    return _METHODS.get(method, method), _SETTINGS.get((method, name), name), model


def upgraded(cells: Cells) -> Cells:
    """A row of then, of results, times or the closed loop, as one of now."""
    if "method" in cells and "settings" in cells:
        method, settings, model = renamed(cells["method"], cells["settings"])
        cells = cells | {"method": method, "settings": settings, "method_version": "1"}
        cells["model"] = cells.get("model") or model
    if "policy" in cells:
        cells = cells | {"policy": cells["policy"].replace("ded-dpc-shared@", "ded-admm@")}
    if "truth" in cells:
        truth = cells.pop("truth")
        cells = cells | {"plant": "lossless" if truth == "paper" else truth}
    return cells
