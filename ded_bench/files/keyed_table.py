"""A CSV table that several processes add rows to: appended under a lock, compacted now and then.

A later line replaces an earlier one of the same key. A process that is killed leaves at most a torn last
line: readers pass over it, the next writer cuts it off. Compacting replaces the file in one step; every
key keeps its place.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Hashable, Iterable, Iterator
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.files.table import Table, csv_line, records

K = TypeVar("K", bound=Hashable)
T = TypeVar("T", bound="Keyed")

#: A table is compacted when more lines than it has rows, and than this, are superseded.
FEW_SUPERSEDED = 100
#: So many bytes before a known end of a file tell whether it has only grown since.
_TAIL = 256


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


class _Seen(NamedTuple):
    """How far a file has been read: its inode, the end of its last whole line, and what precedes it."""

    inode: int
    end: int
    tail: bytes


class KeyedTable(Generic[K, T]):
    """Rows of one file by key, in the order of their first lines.

    Attributes:
        rows: those on disk at the last `reload` or `add`.
    """

    def __init__(self, path: Path, table: Table[T]) -> None:
        self.path = path
        self.rows: dict[K, T] = {}
        self._table = table
        self._others: dict[K, dict[str, str]] = {}  # cells of columns that `table` does not declare
        self._header: tuple[str, ...] = table.names
        self._superseded = 0
        self._seen: _Seen | None = None
        self.reload()

    def made_from(self, key: K, fingerprint: str, version: int = 0) -> bool:
        """Whether there is a row of this key, from the same input and by no older version of the method."""
        row = self.rows.get(key)
        return row is not None and row.fingerprint == fingerprint and row.method_version >= version

    def reload(self) -> None:
        """Read what other processes have added; InputError if the file is wrong."""
        try:
            with open(self.path, "rb") as file:
                self._read(os.fstat(file.fileno()).st_ino, file.read, file.seek)
        except FileNotFoundError:
            self._forget()
        except OSError as error:
            raise InputError(self.path, "", f"cannot be read ({error.strerror or error})") from None

    def add(self, rows: Iterable[T]) -> None:
        """Save rows at once, replacing those with the same key; other processes' rows are kept."""
        rows = list(rows)
        with self.locked():
            self.reload()
            if self._seen is None or not set(self._table.names) <= set(self._header):
                self._take((row, {}) for row in rows)
                self._write_all()
                return
            text = "".join(self._table.format_row(row, self._header) for row in rows).encode()
            with open(self.path, "r+b") as file:
                file.truncate(self._seen.end)
                file.seek(self._seen.end)
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            self._take((row, {}) for row in rows)
            self._seen = _Seen(
                self._seen.inode, self._seen.end + len(text), (self._seen.tail + text)[-_TAIL:]
            )
            if self._superseded > max(len(self.rows), FEW_SUPERSEDED):
                self._write_all()

    def compact(self) -> None:
        """Leave one line per key."""
        with self.locked():
            self.reload()
            if self._superseded:
                self._write_all()

    def _read(self, inode: int, read: Callable[[], bytes], seek: Callable[[int], int]) -> None:
        seen = self._seen
        if seen and seen.inode == inode:
            start = seen.end - len(seen.tail)
            seek(start)
            data = read()
            if data.startswith(seen.tail):
                if new := whole_lines(data[len(seen.tail) :]):
                    found = records(self._text(new), self.path)
                    self._take(self._table.rows(found, self._header, self.path))
                    self._seen = _Seen(inode, seen.end + len(new), (seen.tail + new)[-_TAIL:])
                return
            seek(0)  # another file that happens to have the same number, or one changed by hand
        self._forget()
        data = whole_lines(read())
        found = records(self._text(data), self.path)
        self._header = self._table.check_header(found[0][1] if found else [], self.path)
        self._take(self._table.rows(found[1:], self._header, self.path))
        self._seen = _Seen(inode, len(data), data[-_TAIL:])

    def _text(self, data: bytes) -> str:
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(self.path, "", "is not UTF-8 text") from None

    def _take(self, found: Iterable[tuple[T, dict[str, str]]]) -> None:
        rows = dict(self.rows)  # whoever iterates over the present ones may add rows meanwhile
        for row, others in list(found):  # all of them are right, or none is taken
            key = row.key
            self._superseded += key in rows
            rows[key] = row
            self._others[key] = others
        self.rows = rows

    def _forget(self) -> None:
        self.rows, self._others, self._header = {}, {}, self._table.names
        self._superseded, self._seen = 0, None

    def _write_all(self) -> None:
        header = (*self._table.names, *(name for name in self._header if name not in self._table.names))
        lines = [self._table.format_row(row, header, self._others[key]) for key, row in self.rows.items()]
        data = (csv_line(header) + "".join(lines)).encode()
        write_atomically(self.path, data)
        self._header, self._superseded = header, 0
        self._seen = _Seen(self.path.stat().st_ino, len(data), data[-_TAIL:])

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing to the folder; not to be nested."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path.parent / ".lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield  # closing the file releases the lock


def whole_lines(data: bytes) -> bytes:
    """All but a torn last line, and without blank lines at the end, so that rows may follow."""
    end = len(data[: data.rfind(b"\n") + 1].rstrip(b"\r\n"))
    return data[: data.index(b"\n", end) + 1] if end else b""
