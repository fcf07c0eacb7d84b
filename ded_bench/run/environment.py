"""What a row's times depend on: hardware, package and solver versions, date."""

from __future__ import annotations

import datetime
import functools
import hashlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

from ded_bench.problem.case import REPOSITORY

#: Flags of processors, and what people call them, the widest vectors first.
VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2"}
PACKAGES = ("pyomo", "casadi", "highspy", "piqp", "torch", "numba", "numpy", "scipy", "pandas")


@functools.cache
def host() -> str:
    """The machine in words, with a short hash of its name to tell equal machines apart."""
    name = hashlib.sha256(platform.node().encode()).hexdigest()[:6]
    return f"{_cpu()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()} ({name})"


@functools.cache
def version() -> str:
    """Version of this package."""
    return importlib.metadata.version("ded-bench")


@functools.cache
def commit() -> str:
    """Short name of the checkout's commit, with `+` if the package was changed since; empty if installed."""
    if not (REPOSITORY / ".git").exists():
        return ""
    name, changed = _git("rev-parse", "--short", "HEAD"), _git("status", "--porcelain", "--", "ded_bench")
    return f"{name}+" if name and changed else name


def now() -> str:
    """The time, ISO 8601 in UTC."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def environment() -> str:
    """Versions and hardware for the report."""
    facts = {"ded-bench": version(), "python": platform.python_version()}
    facts |= {name: _version(name) for name in PACKAGES} | {"host": host(), "memory": _memory()}
    return "; ".join(f"{name} {value}" for name, value in facts.items())


def _git(*arguments: str) -> str:
    command = ("git", "-C", str(REPOSITORY), *arguments)
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""  # no git here


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # torch, where nothing is trained


def _cpu() -> str:
    """Its name, and its widest vectors: processors of one name may differ in them."""
    try:
        lines = [line.partition(":") for line in Path("/proc/cpuinfo").read_text().splitlines()]
    except OSError:
        lines = []
    facts = {name.strip(): value.strip() for name, _, value in lines}
    vectors = [word for flag, word in VECTORS.items() if flag in facts.get("flags", "").split()]
    return " ".join([facts.get("model name") or platform.processor() or "unknown processor", *vectors[:1]])


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    except (OSError, ValueError):
        return "unknown"
