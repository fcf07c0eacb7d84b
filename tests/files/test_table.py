"""Typed CSV: every digit survives, other versions' columns do no harm, bad cells are named."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from pydantic import Field

from ded_bench.files.errors import InputError
from ded_bench.files.table import PlainName, Table


@dataclass(frozen=True)
class Ship:
    """A row with every kind of column."""

    name: PlainName
    masts: Annotated[int, Field(ge=1)]
    length_m: float | None = None
    afloat: bool | None = None
    note: str = ""
    crew: int = 1


SHIPS = Table(Ship)
BRIG = Ship("brig", 2, 0.1 + 0.2, True, 'comma, "quote"', 3)
HEADER = "name,masts,length_m,afloat,note,crew\n"


def put(folder: Path, text: str) -> Path:
    path = folder / "ships.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "length", [0.1 + 0.2, 5e-324, 1e15, -1e15, -0.0, 1e-9, math.pi, 123456789012345.678, None]
)
def test_rows_survive_to_the_last_digit(length: float | None, tmp_path: Path) -> None:
    ships = [dataclasses.replace(BRIG, length_m=length), Ship("sloop", 1)]
    SHIPS.write(tmp_path / "ships.csv", ships)
    assert SHIPS.read(tmp_path / "ships.csv") == ships
    assert (tmp_path / "ships.csv").read_text().startswith(HEADER)


def test_a_row_is_one_line() -> None:
    assert SHIPS.format([Ship("brig", 2, note="one\ntwo\r\nthree")]) == HEADER + "brig,2,,,one two three,1\n"


def test_columns_of_other_versions_do_no_harm(tmp_path: Path) -> None:
    """More columns, in another order, than we know; fewer of those that have a default."""
    path = put(tmp_path, "sails,masts,name\nred,2,brig\n,1,sloop\n")
    assert SHIPS.read(path) == [Ship("brig", 2), Ship("sloop", 1)]


@pytest.mark.parametrize("text", ["\ufeff" + HEADER + "brig,2,,,,\n", HEADER + "brig,2,,,,\n\n\n"])
def test_what_spreadsheets_leave_is_read(text: str, tmp_path: Path) -> None:
    """A byte order mark, blank last lines, and an empty cell where the default is meant."""
    assert SHIPS.read(put(tmp_path, text)) == [Ship("brig", 2)]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "name: required column is missing (found: nothing)"),
        ("a,b\n1,2\n", "name: required column is missing (found: a, b)"),
        ("name,length_m\n", "masts: required column is missing (found: name, length_m)"),
        ("name,masts,x,x\n", "x: column is there twice"),
        (HEADER + "brig,2,,,\n", "line 2: 5 values for 6 columns"),
        (HEADER + "brig,2,,,,\n\nsloop,1,,,,\n", "line 3: 0 values"),
        (HEADER + "brig,2,,,,\n,1,,,,\n", "line 3, name: ''"),
        (HEADER + "../brig,2,,,,\n", "line 2, name"),
        (HEADER + "brig,0,,,,\n", "line 2, masts: '0'"),
        (HEADER + "brig,2.5,,,,\n", "line 2, masts"),
        (HEADER + "brig,2,nan,,,\n", "line 2, length_m"),
        (HEADER + "brig,2,1e400,,,\n", "line 2, length_m"),
        (HEADER + "brig,2,1.1e15,,,\n", "line 2, length_m"),
        (HEADER + "brig,2,long,,,\n", "line 2, length_m: 'long' is not a valid value"),
        (HEADER + "brig,2,,perhaps,,\n", "line 2, afloat"),
        (HEADER + "brig,2,,," + "x" * 200_000 + ",\n", "is not a CSV file"),
    ],
)
def test_wrong_tables_are_refused_with_line_and_column(text: str, named: str, tmp_path: Path) -> None:
    path = put(tmp_path, text)
    with pytest.raises(InputError) as caught:
        SHIPS.read(path)
    assert str(path) in str(caught.value)
    assert named in str(caught.value)


def test_a_file_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ships\.csv: cannot be read"):
        SHIPS.read(tmp_path / "ships.csv")


def test_a_frame_has_typed_columns() -> None:
    frame = SHIPS.frame([Ship("sloop", 1), BRIG])
    assert list(frame.columns) == list(SHIPS.names)
    assert frame["length_m"].dtype == "float64"
    assert frame["length_m"].iloc[1] == 0.1 + 0.2
    assert frame["length_m"].isna().tolist() == [True, False]
    assert len(SHIPS.frame([]).columns) == 6
