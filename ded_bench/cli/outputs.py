"""Folders that commands write to: can they, before they work for minutes; what a killed run left there."""

from __future__ import annotations

import errno
import os
import re
import tempfile
import time
from pathlib import Path

from ded_bench.files.errors import InputError

#: Names of temporary files that `files.strict.write_atomically` renames when they are complete.
_TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}")
#: No write takes so long: what is older was left by a process that was killed, s.
LEFT_BEHIND_S = 600.0


def check_writable(out: Path) -> None:
    """Raise InputError unless a file can be made at `out`; its folder is made."""
    try:
        if out.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        out.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out.parent).close()
    except OSError as error:
        raise InputError(out, "", f"cannot be written ({error.strerror})") from None


def sweep(folder: Path) -> None:
    """Remove half-written files that killed processes have left below a results folder."""
    before = time.time() - LEFT_BEHIND_S
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place, name)
            if _TEMPORARY.fullmatch(name) and path.stat().st_mtime < before:
                path.unlink(missing_ok=True)
