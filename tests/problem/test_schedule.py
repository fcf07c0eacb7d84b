"""Schedules: interpolation, the CSV round trip, and every way a CSV can be wrong."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.problem import schedule as module
from ded_bench.problem.schedule import Schedule


def knots(case, n: int, horizon: float = 60.0) -> Schedule:
    """A random schedule with n knots at j·horizon/(n-1), not rounded to any grid."""
    rng = np.random.default_rng(n)
    t = np.arange(n) * (horizon / (n - 1))
    return Schedule(t=t, p=rng.uniform(case.p_min, case.p_max, (n, len(case.generators))))


def test_schedules_are_linear_between_rows():
    """Values at rows, midway, and one per generator."""
    schedule = Schedule(t=np.array([0.0, 1.0, 4.0]), p=np.array([[0.0, 5.0], [1.0, 4.0], [-2.0, 4.0]]))
    got = schedule.at(np.array([0.0, 0.25, 1.0, 2.5, 4.0]))
    np.testing.assert_allclose(got, [[0, 5], [0.25, 4.75], [1, 4], [-0.5, 4], [-2, 4]], rtol=0, atol=1e-15)


@pytest.mark.parametrize("n", [2, 3, 61])
def test_schedules_are_what_numpy_interpolates(n):
    """To the last bit, at rows, between and beyond them, and where two rows are as near as numbers can be."""
    rng = np.random.default_rng(n)
    t = np.sort(rng.uniform(0.0, 60.0, n))
    t[1] = np.nextafter(t[0], 60.0) if n > 2 else t[1]
    schedule = Schedule(t=t, p=rng.normal(size=(n, 4)) * 10)
    times = np.concatenate([t, rng.uniform(-5.0, 65.0, 500)])
    wanted = np.stack([np.interp(times, t, column) for column in schedule.p.T], axis=1)
    np.testing.assert_array_equal(schedule.at(times), wanted)


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
@pytest.mark.parametrize("n", [2, 50, 6001])
def test_schedules_round_trip(case, tmp_path, n, suffix):
    """15 significant digits: relative error 5e-15 at most; the same bytes each time."""
    schedule, path = knots(case, n), tmp_path / f"schedule{suffix}"
    schedule.write(path, case.generators)
    again = Schedule.read(path, case, 60.0)
    np.testing.assert_allclose(again.t, schedule.t, rtol=5e-15, atol=0)
    np.testing.assert_allclose(again.p, schedule.p, rtol=5e-15, atol=0)
    first = path.read_bytes()
    assert first.startswith(b"\x1f\x8b") == (suffix == ".csv.gz")
    again.write(path, case.generators)
    assert path.read_bytes() == first  # 15 digits survive a second trip
    assert suffix == ".csv" or first[4:8] == bytes(4)  # no time stamp, so equal content is equal bytes


def test_the_csv_is_what_the_documentation_says(ninebus, tmp_path):
    """Columns t,P_2,P_3; one row per knot; plain numbers."""
    path = tmp_path / "a.csv"
    Schedule(t=np.array([0.0, 60.0]), p=np.array([[1.63, 0.85], [1.5, 1.0]])).write(path, ninebus.generators)
    assert path.read_text() == "t,P_2,P_3\n0,1.63,0.85\n60,1.5,1\n"


@pytest.mark.parametrize(
    "text",
    [
        "P_3,t,P_2\n0.85,0,1.63\n1,60,1.5\n",
        "\ufefft, P_2 ,P_3\r\n0,1.63,0.85\r\n60,1.5,1\r\n",
        't,P_2,P_3\n"0",1.63,8.5e-1\n\n6e1,1.5,+1.0\n',
        "t,P_2,P_3\n1e-10,1.63,0.85\n59.9999999999,1.5,1\n",
    ],
    ids=["column order", "spreadsheet export", "quotes, blank line, exponents", "ends within 1e-9 s"],
)
def test_reading_is_tolerant_of_form(ninebus, tmp_path, text):
    """What a spreadsheet or another program writes is read alike."""
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    schedule = Schedule.read(path, ninebus, 60.0)
    np.testing.assert_allclose(schedule.t, [0, 60], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(schedule.p, [[1.63, 0.85], [1.5, 1.0]])


#: name: (text, field, part of the problem)
BAD = {
    "empty": ("", "t", "is empty"),
    "header only": ("t,P_2,P_3\n", "t", "at least two rows"),
    "missing column": ("t,P_2\n0,1\n60,1\n", "P_3", "is missing (expected t,P_2,P_3, found t,P_2)"),
    "column twice": ("t,P_2,P_2,P_3\n0,1,1,1\n60,1,1,1\n", "P_2", "is there twice"),
    "unknown column": ("t,P_2,P_3,P_4\n0,1,1,1\n60,1,1,1\n", "P_4", "P_3, found t,P_2,P_3,P_4"),
    "short row": ("t,P_2,P_3\n0,1,1\n60,1\n", "line 3", "2 values for 3 columns"),
    "word": ("t,P_2,P_3\n0,1,1\n60,1,much\n", "line 3, P_3", "'much' is not a finite number"),
    "nan": ("t,P_2,P_3\n0,1,nan\n60,1,1\n", "line 2, P_3", "'nan' is not a finite number"),
    "underscore": ("t,P_2,P_3\n0,1_0,1\n60,1,1\n", "line 2, P_2", "'1_0' is not a finite number"),
    "time repeats": ("t,P_2,P_3\n0,1,1\n5,1,1\n5,1,1\n60,1,1\n", "t", "5.0 follows 5.0"),
    "starts late": ("t,P_2,P_3\n0.01,1,1\n60,1,1\n", "t", "must start at 0, not 0.01"),
    "ends early": ("t,P_2,P_3\n0,1,1\n59.99,1,1\n", "t", "horizon 60.0, not 59.99"),
}


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
@pytest.mark.parametrize("name", BAD)
def test_a_wrong_schedule_is_refused(ninebus, tmp_path, name, suffix):
    """Each error names the file and the place in it, on one line; compressed or not."""
    text, field, problem = BAD[name]
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(gzip.compress(text.encode()) if suffix == ".csv.gz" else text.encode())
    with pytest.raises(InputError) as caught:
        Schedule.read(path, ninebus, 60.0)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert problem in caught.value.problem
    assert "\n" not in str(caught.value)


GOOD_TEXT = b"t,P_2,P_3\n0,1.63,0.85\n60,1.5,1\n"
ZIPPED = gzip.compress(GOOD_TEXT, mtime=0)  # without the time, every process collects the same tests


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("latin.csv", b"t,P_2,P_3\n0,1,\xff\n60,1,1\n"),
        ("plain.csv.gz", GOOD_TEXT),
        ("cut.csv.gz", ZIPPED[:-12]),
        ("flipped.csv.gz", ZIPPED[:12] + b"\xff\xff" + ZIPPED[14:]),
        ("binary.csv", bytes(range(256))),
        ("compressed.csv", ZIPPED),
        ("missing.csv", None),
        ("missing.csv.gz", None),
        ("folder.csv", "folder"),
    ],
)
def test_an_unreadable_schedule_is_refused(ninebus, tmp_path, name, content):
    """Not there, not text, or not what its name promises."""
    path = tmp_path / name
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"cannot be read|is not UTF-8 text") as caught:
        Schedule.read(path, ninebus, 60.0)
    assert caught.value.source == str(path)


def test_a_compressed_bomb_is_refused(ninebus, tmp_path, monkeypatch):
    """A small file that unpacks to more than the limit is not unpacked further."""
    monkeypatch.setattr(module, "MAX_BYTES", 10_000)
    path = tmp_path / "bomb.csv.gz"
    path.write_bytes(gzip.compress(b"t,P_2,P_3\n" + b"0" * 10_000))
    with pytest.raises(InputError, match="is larger than"):
        Schedule.read(path, ninebus, 60.0)
