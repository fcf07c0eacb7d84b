"""A table that is added to: nothing lost, nothing twice, whoever writes and whenever they are killed."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.keyed_table import KeyedTable
from ded_bench.files.table import Table


class Named:
    """A row's key is its name; what it was made from is its note."""

    name: str
    note: str

    @property
    def key(self) -> str:
        return self.name

    @property
    def fingerprint(self) -> str:
        return self.note


@dataclass(frozen=True)
class Old(Named):
    name: str
    number: int
    note: str = ""


@dataclass(frozen=True)
class New(Named):
    name: str
    number: int
    code: str = ""
    note: str = ""


def old(folder: Path) -> KeyedTable[str, Old]:
    return KeyedTable(folder / "table.csv", Table(Old))


def new(folder: Path) -> KeyedTable[str, New]:
    return KeyedTable(folder / "table.csv", Table(New))


def lines(folder: Path) -> list[str]:
    return (folder / "table.csv").read_text().splitlines()


def test_later_lines_win_and_rows_keep_their_places(tmp_path: Path) -> None:
    table = old(tmp_path)
    table.add([Old("a", 1), Old("b", 2)])
    table.add([Old("c", 3)])
    table.add([Old("a", 4)])
    assert lines(tmp_path) == ["name,number,note", "a,1,", "b,2,", "c,3,", "a,4,"]
    assert list(old(tmp_path).rows.values()) == [Old("a", 4), Old("b", 2), Old("c", 3)]
    assert table.rows == old(tmp_path).rows
    table.compact()
    assert lines(tmp_path) == ["name,number,note", "a,4,", "b,2,", "c,3,"]
    before = (tmp_path / "table.csv").stat()
    table.compact()
    assert (tmp_path / "table.csv").stat() == before
    assert [p.name for p in tmp_path.iterdir() if p.name != ".lock"] == ["table.csv"]


def test_others_rows_are_seen_and_kept(tmp_path: Path) -> None:
    first, second = old(tmp_path), old(tmp_path)
    first.add([Old("a", 1)])
    second.add([Old("b", 2)])
    first.reload()
    assert first.rows == second.rows == {"a": Old("a", 1), "b": Old("b", 2)}
    second.add([Old("a", 3)])
    second.compact()
    first.add([Old("c", 4)])
    assert list(old(tmp_path).rows.values()) == [Old("a", 3), Old("b", 2), Old("c", 4)]
    assert second.asked("ba") == [Old("b", 2), Old("a", 3)]
    (tmp_path / "table.csv").unlink()
    first.reload()
    assert first.rows == {}
    with pytest.raises(InputError, match="has lost 2 of 2 rows"):
        first.asked("ab")


def test_rows_may_be_added_while_one_goes_through_them(tmp_path: Path) -> None:
    table = old(tmp_path)
    table.add([Old("a", 1), Old("b", 2)])
    for row in table.rows.values():
        table.add([Old(row.name * 2, row.number)])
    assert list(table.rows) == ["a", "b", "aa", "bb"]


def test_a_file_changed_by_hand_is_read_anew(tmp_path: Path) -> None:
    """Even if it is longer than before and still the same file to the system."""
    table = old(tmp_path)
    table.add([Old("a", 1), Old("b", 2)])
    with open(tmp_path / "table.csv", "r+") as file:
        file.write("name,number,note\nx,7,\ny,8,\nz,9,and more of it\n")
    table.add([Old("c", 3)])
    assert list(table.rows.values()) == [Old("x", 7), Old("y", 8), Old("z", 9, "and more of it"), Old("c", 3)]


WHOLE = b'name,number,note\na,1,"one ""line"", no more"\nb,2,\n'


@pytest.mark.parametrize("end", range(len(b"name,number,note\n"), len(WHOLE) + 1))
def test_a_torn_line_is_passed_over_and_cut_off(end: int, tmp_path: Path) -> None:
    """Wherever a writer was killed."""
    (tmp_path / "table.csv").write_bytes(WHOLE[:end])
    rows = [Old("a", 1, 'one "line", no more'), Old("b", 2)]
    there = rows[: (end >= WHOLE.index(b"b,2")) + (end == len(WHOLE))]
    table = old(tmp_path)
    assert list(table.rows.values()) == there
    table.add([Old("c", 3)])
    assert list(old(tmp_path).rows.values()) == [*there, Old("c", 3)]


def test_columns_of_newer_and_older_writers(tmp_path: Path) -> None:
    """An old writer keeps to the new header; a new one adds its columns first."""
    old(tmp_path).add([Old("a", 1, "first")])
    new(tmp_path).add([New("b", 2, code="f00")])
    assert lines(tmp_path) == ["name,number,code,note", "a,1,,first", "b,2,f00,"]
    old(tmp_path).add([Old("c", 3, "third")])
    assert lines(tmp_path)[3:] == ["c,3,,third"]
    assert old(tmp_path).rows["b"] == Old("b", 2)
    assert new(tmp_path).rows["b"] == New("b", 2, "f00")


def test_a_file_that_is_wrong_is_not_added_to(tmp_path: Path) -> None:
    table = old(tmp_path)
    table.add([Old("a", 1)])
    with open(tmp_path / "table.csv", "a") as file:
        file.write("b,two,\n")
    for attempt in (table.reload, lambda: table.add([Old("c", 3)]), lambda: old(tmp_path)):
        with pytest.raises(InputError, match=r"table\.csv: line \d, number: 'two'"):
            attempt()
    assert lines(tmp_path)[1:] == ["a,1,", "b,two,"]
    assert table.rows == {"a": Old("a", 1)}


def write_for_ever(folder: str, name: str) -> None:
    """Add rows until killed, and say after each that it is there."""
    table = old(Path(folder))
    for i in range(10**6):
        table.add([Old(f"{name}-{i % 40}", i, 'a "longer" note, ' * (i % 7))])
        print(i, flush=True)


def test_kill_at_any_moment_loses_nothing(tmp_path: Path) -> None:
    """Two writers are killed again and again; what they said was saved is there, and nothing is torn."""
    rng = random.Random(0)
    code = (
        "import sys; from tests.files.test_keyed_table import write_for_ever; write_for_ever(*sys.argv[1:])"
    )
    for round_ in range(6):
        names = f"x{round_}", f"y{round_}"
        writers = [
            subprocess.Popen([sys.executable, "-c", code, str(tmp_path), name], stdout=subprocess.PIPE)
            for name in names
        ]
        for writer in writers:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"0\n"
        time.sleep(0.3 * rng.random())
        for writer in writers:
            os.kill(writer.pid, signal.SIGKILL)
        for name, writer in zip(names, writers, strict=True):
            said = int((b"0\n" + writer.communicate()[0]).split()[-1])
            rows = old(tmp_path).rows
            newest = max(row.number for key, row in rows.items() if key.startswith(f"{name}-"))
            assert said <= newest <= said + 1
            assert len([key for key in rows if key.startswith(f"{name}-")]) == min(newest + 1, 40)
    table = old(tmp_path)
    table.compact()
    assert Table(Old).read(tmp_path / "table.csv") == list(table.rows.values())


def test_neither_a_lock_nor_a_table_leads_elsewhere(tmp_path: Path) -> None:
    """Folders come from strangers: a link would empty its target, a pipe never ends."""
    target, folder = tmp_path / "precious", tmp_path / "a"
    target.write_text("precious")
    folder.mkdir()
    (folder / ".lock").symlink_to(target)
    with pytest.raises(OSError, match="symbolic links"):
        old(folder).add([Old("a", 1)])
    assert target.read_text() == "precious"
    os.mkfifo(folder / "table.csv")
    with pytest.raises(InputError, match="no regular file"):
        old(folder)


def test_a_quotation_mark_out_of_place_hides_no_row(tmp_path: Path) -> None:
    """What follows is refused; it is neither passed over nor cut off."""
    old(tmp_path).add([Old("a", 1), Old("b", 2), Old("c", 3)])
    text = (tmp_path / "table.csv").read_text().replace("b,2,", 'b,2,"')
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(InputError, match=r"table\.csv"):
        old(tmp_path)
