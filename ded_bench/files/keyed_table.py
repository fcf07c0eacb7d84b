"""A CSV table that several processes add rows to: appended under a lock, compacted at the end of a run.

A later line replaces an earlier one of the same key. A process that is killed leaves at most a torn last
line: readers pass over it, the next writer cuts it off. Compacting replaces the file in one step; every
key keeps its place.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Hashable, Iterable, Iterator
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from ded_bench.files.errors import InputError
from ded_bench.files.strict import naming, regular_size, write_atomically
from ded_bench.files.table import Table, records

K = TypeVar("K", bound=Hashable)
T = TypeVar("T", bound="Keyed")


class Keyed(Protocol):
    """A row that knows its place in the table and what it was made from and by."""

    @property
    def key(self) -> Any:
        """What makes the row unique."""

    @property
    def fingerprint(self) -> str:
        """Changes with all that decides on the row."""

    @property
    def method_version(self) -> int:
        """Version of the method that made it."""


class KeyedTable(Generic[K, T]):
    """Rows of one file by key, in the order of their first lines.

    Attributes:
        rows: those on disk at the last `reload` or `add`.
    """

    def __init__(self, path: Path, table: Table[T]) -> None:
        self.path = path
        self.rows: dict[K, T] = {}
        self._table = table
        self._header: tuple[str, ...] = table.names
        self._superseded = 0
        self._mark: tuple[int, int, int] | None = None  # of the file when it was read
        self._end = 0  # of its last whole line then
        self.reload()

    def made_from(self, key: K, fingerprint: str, version: int = 0) -> bool:
        """Whether there is a row of this key, from the same input and by no older version of the method."""
        row = self.rows.get(key)
        return row is not None and row.fingerprint == fingerprint and row.method_version >= version

    def asked(self, keys: Iterable[K]) -> list[T]:
        """The rows of some keys, all of which were added; InputError if somebody took them away since."""
        keys = list(keys)
        if lost := sum(key not in self.rows for key in keys):
            problem = f"has lost {lost} of {len(keys)} rows: it was replaced or deleted meanwhile; run again"
            raise InputError(self.path, "", problem)
        return [self.rows[key] for key in keys]

    def reload(self) -> None:
        """Read what other processes have added; InputError if the file is wrong."""
        regular_size(self.path)
        try:
            with open(self.path, "rb") as file:
                mark = _mark(os.fstat(file.fileno()))
                if self._mark != mark:
                    self._read(file.read(), mark)
        except FileNotFoundError:
            self._forget()
        except OSError as error:
            raise InputError(self.path, "", f"cannot be read ({error.strerror or error})") from None

    def add(self, rows: Iterable[T]) -> None:
        """Save rows at once, replacing those with the same key; other processes' rows are kept."""
        rows = list(rows)
        with locked(self.path.parent):
            self.reload()
            if self._mark is None or not set(self._table.names) <= set(self._header):
                self._take(rows)
                self._write_all()
                return
            text = "".join(self._table.format_row(row, self._header) for row in rows).encode()
            with naming(self.path), open(self.path, "r+b") as file:
                file.truncate(self._end)
                file.seek(self._end)
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            self._take(rows)
            self._mark, self._end = _mark(self.path.stat()), self._end + len(text)

    def compact(self) -> None:
        """Leave one line per key."""
        with locked(self.path.parent):
            self.reload()
            if self._superseded:
                self._write_all()

    def _read(self, data: bytes, mark: tuple[int, int, int]) -> None:
        # All but a torn last line, and without blank lines at the end, so that rows may follow.
        end = len(data[: data.rfind(b"\n") + 1].rstrip(b"\r\n"))
        data = data[: data.index(b"\n", end) + 1] if end else b""
        try:
            found = records(data.decode("utf-8"), self.path)
        except UnicodeDecodeError:
            raise InputError(self.path, "", "is not UTF-8 text") from None
        header = self._table.check_header(found[0][1] if found else [], self.path)
        rows = list(self._table.rows(found[1:], header, self.path))  # all of them are right, or none is taken
        self._forget()
        self._header, self._mark, self._end = header, mark, len(data)
        self._take(rows)

    def _take(self, found: Iterable[T]) -> None:
        rows = dict(self.rows)  # whoever iterates over the present ones may add rows meanwhile
        for row in found:
            key = row.key
            self._superseded += key in rows
            rows[key] = row
        self.rows = rows

    def _forget(self) -> None:
        self.rows, self._header = {}, self._table.names
        self._superseded, self._mark = 0, None

    def _write_all(self) -> None:
        data = self._table.format(self.rows.values()).encode()
        write_atomically(self.path, data)
        self._header, self._superseded = self._table.names, 0
        self._mark, self._end = _mark(self.path.stat()), len(data)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to tables of a folder; not to be nested."""
    folder.mkdir(parents=True, exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW  # a link may lead to a file of somebody's
    with open(folder / ".lock", "r+b", 0, opener=lambda path, _: os.open(path, flags, 0o666)) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield  # closing the file releases the lock


def _mark(found: os.stat_result) -> tuple[int, int, int]:
    """Changes whenever a file is written to."""
    return found.st_ino, found.st_mtime_ns, found.st_size
