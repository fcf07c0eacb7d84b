"""Archives of schedules: what goes in comes out, whoever is killed when; hostile files are refused."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import MAX_BYTES, Schedule
from ded_bench.results.archive import Archive

HORIZON_S = 1.0


def schedule(power: float = 0.1 + 0.2) -> Schedule:
    return Schedule(np.array([0.0, 1 / 3, HORIZON_S]), np.array([[power], [-power], [1e-17]]))


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(tmp_path / "TO.npz")


def test_schedules_keep_every_bit_loose_and_packed(archive: Archive, threebus: Case) -> None:
    archive.write("a-1", schedule(), threebus)
    for _ in range(2):
        assert "a-1" in archive
        assert "a-2" not in archive
        found = archive.read("a-1", threebus, HORIZON_S)
        assert (found.t.tolist(), found.p.tolist()) == (schedule().t.tolist(), schedule().p.tolist())
        archive.pack({"a-1"})
    assert [path.name for path in archive.path.parent.iterdir()] == ["TO.npz"]


def test_numpy_opens_it_without_pickle(archive: Archive, threebus: Case) -> None:
    archive.write("a-1", schedule(), threebus)
    archive.pack({"a-1"})
    with np.load(archive.path, allow_pickle=False) as opened:
        assert sorted(opened) == ["a-1", "columns"]
        assert opened["columns"].tolist() == ["t", *(f"P_{g}" for g in threebus.generators)]
        assert opened["a-1"].shape == (3, 2)


def test_packing_adds_replaces_and_drops(archive: Archive, threebus: Case) -> None:
    """Loose ones without a row wait; packed ones without a row go."""
    for name in ("a", "b", "c"):
        archive.write(name, schedule(), threebus)
    archive.pack({"a", "b"})
    before = archive.path.read_bytes()
    archive.pack({"a", "b"})
    assert archive.path.read_bytes() == before
    assert "c" in archive
    archive.write("a", schedule(2.0), threebus)
    archive.pack({"a", "c"})
    with np.load(archive.path, allow_pickle=False) as opened:
        assert sorted(opened) == ["a", "c", "columns"]
    assert archive.read("a", threebus, HORIZON_S).p[0, 0] == 2.0
    archive.drop(["a"])
    assert "a" not in archive
    assert "c" in archive


def test_a_death_while_packing_loses_nothing(archive: Archive, threebus: Case, monkeypatch) -> None:
    """Whether the archive is replaced already or not."""
    archive.write("a", schedule(), threebus)
    archive.pack({"a"})
    archive.write("b", schedule(), threebus)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            archive.pack({"a", "b"})
    for _ in range(2):
        for name in "ab":
            assert archive.read(name, threebus, HORIZON_S).p[0, 0] == schedule().p[0, 0]
        archive.pack({"a", "b"})


def npy(array: np.ndarray, *, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=allow_pickle)
    return stream.getvalue()


GOOD = np.array([[0.0, 1.0], [1.0, 1.0]])
CLAIMS = npy(GOOD).replace(b"(2, 2), }        ", b"(9999999999, 9), }")


@pytest.mark.parametrize(
    ("member", "told"),
    [
        (npy(np.array([{"a": 1}]), allow_pickle=True), "Object arrays cannot be loaded"),
        (npy(GOOD[:, :1]), "no table of float64 with 2 columns"),
        (npy(GOOD.ravel()), "no table"),
        (npy(GOOD.astype(np.float32)), "no table"),
        (npy(GOOD * np.nan), "finite"),
        (npy(GOOD[::-1].copy()), "must increase strictly"),
        (npy(GOOD * [0.5, 1.0]), "must end at the horizon"),
        (CLAIMS, "no archive"),
        (npy(GOOD)[:-8], "no archive"),
        (b"\x93NUMPY\x09\x00", "no archive"),
        (b"", "no archive"),
        (b"0" * (MAX_BYTES + 1), "too large"),
    ],
)
def test_hostile_members_are_refused(member: bytes, told: str, archive: Archive, threebus: Case) -> None:
    with zipfile.ZipFile(archive.path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("columns.npy", npy(np.array(["t", "P_plant"])))
        made.writestr("a.npy", member)
    with pytest.raises(InputError, match=told) as caught:
        archive.read("a", threebus, HORIZON_S)
    assert str(archive.path) in str(caught.value)


def test_hostile_files_are_refused(archive: Archive, threebus: Case) -> None:
    archive.write("a", schedule(), threebus)
    archive.pack({"a"})
    whole = archive.path.read_bytes()
    for data in (b"", b"no archive", whole[:-30], whole[:40] + b"\xff" * 20 + whole[60:]):
        archive.path.write_bytes(data)
        with pytest.raises(InputError, match=r"TO\.npz"):
            Archive(archive.path).read("a", threebus, HORIZON_S)


def test_schedules_of_other_generators_are_refused(archive: Archive, threebus: Case, ninebus: Case) -> None:
    archive.write("a", schedule(), threebus)
    with pytest.raises(InputError, match=r"columns: are \['t', 'P_plant'\]"):
        archive.read("a", ninebus, HORIZON_S)
    with pytest.raises(InputError, match="are those of other generators"):
        archive.write("b", schedule(), ninebus)
    with pytest.raises(InputError, match="b: no such schedule"):
        archive.read("b", threebus, HORIZON_S)
