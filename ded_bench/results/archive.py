"""Archives of schedules: one `.npz` file per method, settings and regime, which NumPy opens without pickle.

A member is a table of float64, shape (n, 1 + n_gen): times in s, then powers in pu. `columns` holds the names
of its columns, as in the CSV of a schedule. A schedule is saved as a loose `.npy` file first, in a folder
that has the archive's name without its ending, so that a process may be killed at any time; packing moves
loose files into the archive in one step.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ded_bench.files.errors import InputError
from ded_bench.files.strict import regular_size, write_atomically
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import MAX_BYTES, Schedule, columns_of

#: Smaller than deflate by a fourth.
COMPRESSION = zipfile.ZIP_LZMA
_COLUMNS = "columns"
_MADE = (1980, 1, 1, 0, 0, 0)


class Archive:
    """The schedules of one method, settings and regime by name; nothing need be there."""

    def __init__(self, path: Path) -> None:
        self.path, self._loose = path, path.with_suffix("")
        self._mark, self._names, self._packed_columns = (0, 0), frozenset[str](), list[str]()

    def __contains__(self, name: str) -> bool:
        return self._file(name).is_file() or name in self._packed()

    def read(self, name: str, case: Case, horizon_s: float) -> Schedule:
        """Read one schedule, for a case and a horizon in s.

        Raises:
            InputError: it is missing or damaged, is of other generators, or does not span the horizon.
        """
        source, wanted = f"{self.path}: {name}", columns_of(case)
        regular_size(self._file(name))
        try:  # in this order: a schedule that is packed meanwhile is found
            data = self._file(name).read_bytes()
        except FileNotFoundError:
            data = self._member(name)
        with _readable(source):
            table = _array(data)
        if self._columns() != wanted:
            raise InputError(self.path, _COLUMNS, f"are {self._columns()}, expected {wanted}")
        if table.dtype != np.float64 or table.ndim != 2 or table.shape[1] != len(wanted):
            raise InputError(source, "", f"is no table of float64 with {len(wanted)} columns")
        schedule = Schedule(np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1:]))
        schedule.check(horizon_s, source)
        return schedule

    def write(self, name: str, schedule: Schedule, case: Case) -> None:
        """Save a schedule beside the archive; InputError if that is of other generators."""
        if _COLUMNS not in self:
            write_atomically(self._file(_COLUMNS), _bytes(np.array(columns_of(case))))
        elif self._columns() != columns_of(case):
            raise InputError(self.path, _COLUMNS, "are those of other generators; choose another folder")
        table = np.column_stack([schedule.t, schedule.p])
        write_atomically(self._file(name), _bytes(np.asfortranarray(table)))  # a column compresses better

    def pack(self, named: Collection[str]) -> None:
        """Move loose schedules into the archive in one step; whoever calls holds the folder's lock.

        Args:
            named: the schedules that rows name. Others in the archive are dropped; loose ones, whose rows
                may be about to be written, stay.
        """
        wanted, packed = {*named, _COLUMNS}, self._packed()
        new = [path for path in sorted(self._loose.glob("*.npy")) if path.stem in wanted]
        kept = (packed & wanted) - {path.stem for path in new}
        if new or kept != packed:
            # as long as all members stay, they are copied as they are: none is compressed again
            stream = io.BytesIO(self.path.read_bytes() if packed and kept == packed else b"")
            with zipfile.ZipFile(stream, "a") as archive:
                for name in sorted(kept - packed if stream.getbuffer().nbytes else kept):
                    archive.writestr(_entry(name), self._member(name))
                for path in new:
                    archive.writestr(_entry(path.stem), path.read_bytes())
            write_atomically(self.path, stream.getvalue())
        for path in new:
            path.unlink()
        with contextlib.suppress(OSError):  # it holds more, or was never there
            self._loose.rmdir()

    def drop(self, names: Collection[str]) -> None:
        """Remove schedules; whoever calls holds the folder's lock."""
        for name in names:
            self._file(name).unlink(missing_ok=True)
        if not self._packed().isdisjoint(names):
            self.pack(self._packed() - set(names))

    def _file(self, name: str) -> Path:
        return self._loose / f"{name}.npy"

    def _columns(self) -> list[str]:
        loose = self._file(_COLUMNS)
        if loose.is_file():
            with _readable(loose):
                return [str(name) for name in _array(loose.read_bytes())]
        return self._packed_columns if self._packed() else []

    def _packed(self) -> frozenset[str]:
        """Names in the archive file, which is read again when it has changed."""
        regular_size(self.path)
        try:
            found = self.path.stat()
        except FileNotFoundError:
            return frozenset()
        mark = found.st_ino, found.st_mtime_ns
        if self._mark != mark:
            with _readable(self.path), zipfile.ZipFile(self.path) as archive:
                names = frozenset(name.removesuffix(".npy") for name in archive.namelist())
                columns = [str(n) for n in _array(self._member(_COLUMNS))] if _COLUMNS in names else []
            self._mark, self._names, self._packed_columns = mark, names, columns
        return self._names

    def _member(self, name: str) -> bytes:
        """The bytes of a member, which may not be larger than any schedule is."""
        if not self.path.is_file():
            raise InputError(self.path, name, "no such schedule")
        with _readable(f"{self.path}: {name}"), zipfile.ZipFile(self.path) as archive:
            if f"{name}.npy" not in archive.namelist():
                raise InputError(self.path, name, "no such schedule")
            if archive.getinfo(f"{name}.npy").file_size > MAX_BYTES:
                raise InputError(self.path, name, "is too large for a schedule")
            return archive.read(f"{name}.npy")


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(f"{name}.npy", _MADE)
    entry.compress_type = COMPRESSION
    entry.external_attr = 0o644 << 16
    return entry


def _bytes(array: NDArray[np.generic]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def _array(data: bytes) -> NDArray[np.generic]:
    """The array of a `.npy` file; ValueError if it is none, or holds Python objects."""
    array: NDArray[np.generic] = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    return array


@contextlib.contextmanager
def _readable(source: str | Path) -> Iterator[None]:
    """What readers raise on a damaged file becomes an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # of zipfile, its codecs and NumPy alike, on damaged files
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise InputError(source, "", f"is no archive of schedules ({reason})") from None
