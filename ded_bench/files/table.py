"""Typed CSV tables: a frozen dataclass declares the columns; floats keep every digit.

A field without a default is a column that must be there and filled in. Any other column may be missing, or
its cell empty: the value is then the field's default. Types may be annotated with limits, as pydantic knows
them. Columns that the dataclass does not declare are ignored, so that tables of a newer or an older version
stay readable.
"""

from __future__ import annotations

import csv
import dataclasses
import inspect
import io
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_text, write_atomically

if TYPE_CHECKING:
    import pandas as pd

#: No number of a table is larger unless the file is damaged; sums and ratios then stay finite.
LARGEST = 1e15
T = TypeVar("T")


def plain_name(text: str) -> str:
    """Check of a cell that also names a file or folder; ValueError if it would leave its folder."""
    if "/" in text or "\\" in text or text.startswith(".") or not text.isprintable():
        raise ValueError(text)
    return text


PlainName = Annotated[str, AfterValidator(plain_name)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]

#: The cells of a row by the names of their columns.
Cells = dict[str, str]


class Table(Generic[T]):
    """Reads and writes tables whose rows are instances of one frozen dataclass.

    Its fields are of type str, int, float or bool, or one of these or None.
    """

    def __init__(
        self, kind: type[T], since: str = "", upgrade: Callable[[Cells], Cells] | None = None
    ) -> None:
        """Declare a table.

        Args:
            kind: of its rows; columns without a default come first, and those that it inherits last.
            since: a column that files of older versions lack.
            upgrade: what turns the rows of such files into those of today.
        """
        self.kind, self._since, self._upgrade = kind, since, upgrade
        known = [inspect.get_annotations(c) for c in kind.__mro__]
        depth = {name: i for i, names in reversed([*enumerate(known)]) for name in names}
        fields = list(dataclasses.fields(kind))  # type: ignore[arg-type]
        fields.sort(key=lambda f: (f.default is not dataclasses.MISSING, depth[f.name]))
        self.names = tuple(field.name for field in fields)
        self._required = [field.name for field in fields if field.default is dataclasses.MISSING]
        plain = typing.get_type_hints(kind)
        self._floats = [name for name in self.names if float in (plain[name], *typing.get_args(plain[name]))]
        self._row = TypeAdapter(kind)

    def read(self, path: str | Path) -> list[T]:
        """Read a table.

        Raises:
            InputError: the file cannot be read, a required column is missing, or a value is wrong; names
                line and column.
        """
        found = records(read_text(path), path)
        header = self.check_header(found[0][1] if found else [], path)
        return list(self.rows(found[1:], header, path))

    def existing(self, path: Path) -> list[T]:
        """Read a table (see `read`); no rows if there is no such file."""
        return self.read(path) if path.is_file() else []

    def check_header(self, cells: Sequence[str], source: str | Path) -> tuple[str, ...]:
        """Return the names of a header; InputError if a required column is missing or any is there twice."""
        found = f"found: {repr(', '.join(cells)[:100])[1:-1] or 'nothing'}"
        for name in self._required:
            if name not in cells:
                raise InputError(source, name, f"required column is missing ({found})")
        for name in cells:
            if cells.count(name) > 1:
                raise InputError(source, name[:40], f"column is there twice ({found})")
        return tuple(cells)

    def rows(
        self, found: Iterable[tuple[int, list[str]]], header: Sequence[str], source: str | Path
    ) -> Iterator[T]:
        """Yield every row.

        Args:
            found: line numbers and cells (see `records`).
            header: the file's own.

        Raises:
            InputError: a line has too many or too few values, or a wrong one.
        """
        upgrade = self._upgrade if self._since not in header else None
        for line, texts in found:
            if len(texts) != len(header):
                raise InputError(source, f"line {line}", f"{len(texts)} values for {len(header)} columns")
            cells = {name: text for name, text in zip(header, texts, strict=True) if text}
            try:
                row = self._row.validate_strings(upgrade(cells) if upgrade else cells)
                large = (
                    n for n, v in vars(row).items() if isinstance(v, float | int) and not abs(v) <= LARGEST
                )
                wrong = next(large, "")
            except ValidationError as error:
                wrong = str(error.errors()[0]["loc"][0])
            if wrong:
                text = texts[header.index(wrong)] if wrong in header else ""
                raise InputError(source, f"line {line}, {wrong}", f"{text[:30]!r} is not a valid value")
            yield row

    def format(self, rows: Iterable[T]) -> str:
        """Rows as CSV text under a header of all columns; missing values are empty."""
        return csv_line(self.names) + "".join(self.format_row(row, self.names) for row in rows)

    def format_row(self, row: T, header: Sequence[str]) -> str:
        """One row as a line of CSV under a header, which may have columns that are not declared here.

        Line breaks within a text become spaces, so that a file that ends without one has a torn last row.
        """
        return csv_line([_text(getattr(row, name)) if name in self.names else "" for name in header])

    def write(self, path: Path, rows: Iterable[T]) -> None:
        """Replace a table by these rows, in one step."""
        write_atomically(path, self.format(rows))

    def frame(self, rows: Iterable[T]) -> pd.DataFrame:
        """Rows as a data frame with typed columns; missing values are NaN or None."""
        import pandas as pd  # worker processes, which read no table, do without

        values = [[getattr(row, name) for name in self.names] for row in rows]
        return pd.DataFrame(values, columns=list(self.names)).astype(dict.fromkeys(self._floats, "float64"))


def records(text: str, source: str | Path) -> list[tuple[int, list[str]]]:
    """Line numbers and cells of CSV text; a byte order mark and blank lines at the end do not count.

    Raises:
        InputError: it is not CSV.
    """
    reader = csv.reader(io.StringIO(text.removeprefix("\ufeff"), newline=""), strict=True)
    try:
        found = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise InputError(source, "", f"is not a CSV file ({error})") from None
    while found and not any(found[-1][1]):
        found.pop()
    return found


def csv_line(cells: Sequence[str]) -> str:
    """Cells as one record of CSV, with its line break."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(float(value))
    return " ".join(str(value).splitlines()) if isinstance(value, str) else str(value)
