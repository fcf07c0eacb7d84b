"""Strict JSON, read and written: every bad file is an InputError that names file and field."""

from __future__ import annotations

import copy
import errno
import json
import os
import pickle
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import read_record, write_atomically, write_record
from ded_bench.problem.benchmark import load_manifest, load_split
from ded_bench.problem.instance import Instance, load_instances
from ded_bench.problem.sampling import sample_instance

VALID = {
    "schema": "ded-bench/instance/1",
    "id": "threebus-0000",
    "case": "threebus",
    "seed": [2022, 0],
    "horizon_s": 6.0,
    "dt_s": 0.01,
    "cost": {"s": 0.5, "plant": 0.25},
    "load": {"town": {"initial": -1.0, "start": 1.0, "duration": 2.0, "rate": -0.02}},
    "initial": {"power": {"plant": 0.6}, "omega": {"plant": 0.001}},
}
REMOVED = object()


def _with(path: str, value: object) -> str:
    data = copy.deepcopy(VALID)
    *parents, last = path.split(".")
    inner = data
    for part in parents:
        inner = inner[part]
    if value is REMOVED:
        del inner[last]
    else:
        inner[last] = value
    return json.dumps(data)


def _literal(path: str, literal: str) -> str:
    """The file with an unquoted literal that json.dumps would not write."""
    return _with(path, "LITERAL").replace('"LITERAL"', literal)


#: name: (text, field, part of the problem)
BAD = {
    "unknown field": (_with("colour", 1), "colour", "unknown field"),
    "misspelt field": (_with("dt", 1), "dt", "did you mean dt_s?"),
    "misspelt nested field": (_with("load.town.rat", 1), "load.town.rat", "did you mean rate?"),
    "unknown nested field": (_with("load.town.colour", 1), "load.town.colour", "unknown field"),
    "missing field": (_with("dt_s", REMOVED), "dt_s", "required"),
    "missing nested field": (_with("load.town.rate", REMOVED), "load.town.rate", "required"),
    "null": (_with("horizon_s", None), "horizon_s", "valid number"),
    "NaN": (_literal("cost.s", "NaN"), "cost.s", "finite"),
    "Infinity": (_literal("load.town.initial", "Infinity"), "load.town.initial", "finite"),
    "-Infinity": (_literal("initial.omega.plant", "-Infinity"), "initial.omega.plant", "finite"),
    "1e999": (_literal("load.town.initial", "1e999"), "load.town.initial", "finite"),
    "huge integer": (_literal("load.town.rate", "1" + "0" * 400), "load.town.rate", ""),
    "string for a number": (_with("horizon_s", "6.0"), "horizon_s", "valid number"),
    "boolean for a number": (_with("horizon_s", True), "horizon_s", "valid number"),
    "list for a number": (_with("dt_s", [0.01]), "dt_s", "valid number"),
    "list for an object": (_with("load", [1]), "load", "object"),
    "number for a name": (_with("id", 7), "id", "string"),
    "path as a name": (_with("id", "../../etc/passwd"), "id", "pattern"),
    "empty name": (_with("case", ""), "case", "pattern"),
    "other schema": (_with("schema", "ded-bench/instance/3"), "schema", "ded-bench/instance/1"),
    "points in instance/1": (
        _with("load.town", {"points": [[0, -1.0], [6, -1.1]]}),
        "",
        "load.town.points: needs schema ded-bench/instance/2",
    ),
    "angles in instance/1": (
        _with("initial.theta", {"plant": 0.1}),
        "",
        "initial.theta: needs schema ded-bench/instance/2",
    ),
    "negative seed": (_with("seed", [2022, -1]), "seed", "negative"),
    "negative duration": (_with("load.town.duration", -1.0), "load.town.duration", "greater than or equal"),
    "negative start": (_with("load.town.start", -1e-9), "load.town.start", "greater than or equal"),
    "negative cost": (_with("cost.plant", -0.1), "cost.plant", "greater than or equal"),
    "zero step": (_with("dt_s", 0.0), "dt_s", "greater than 0"),
    "negative horizon": (_with("horizon_s", -6.0), "horizon_s", "greater than 0"),
    "horizon no multiple of dt": (_with("dt_s", 0.011), "", "horizon_s: must be a whole multiple of dt_s"),
    "horizon below dt": (_with("dt_s", 7.0), "", "horizon_s: must be a whole multiple of dt_s"),
    "too many steps": (_with("dt_s", 1e-6), "", "more than 1000000 time steps"),
    "infinitely many steps": (_with("dt_s", 1e-320), "", "more than 1000000 time steps"),
    "duplicate key": (_with("id", "x").replace('"dt_s"', '"id"'), "id", "appears twice"),
    "duplicate nested key": (json.dumps(VALID).replace('"rate"', '"start"'), "start", "appears twice"),
    "not JSON": ("{", "", "is not JSON"),
    "trailing text": (json.dumps(VALID) + "]", "", "is not JSON"),
    "empty": ("", "", "is not JSON"),
    "a list": ("[]", "", "object"),
    "a number": ("1", "", "object"),
    "nested too deep": ("[" * 200_000, "", "is not JSON"),
    "byte order mark": ("\ufeff" + json.dumps(VALID), "", "is not JSON"),
    "unknown bus": (_with("cost.moon", 1.0), "cost.moon", "no such bus here in case threebus"),
    "generator's load": (_with("load.plant", VALID["load"]["town"]), "load.plant", "no such bus here"),
    "missing bus": (_with("initial.power", {}), "initial.power.plant", "field required"),
    "missing slack cost": (_with("cost.s", REMOVED), "cost.s", "field required"),
    "wrong case": (_with("case", "9bus"), "case", "is for case '9bus', not 'threebus'"),
}


def test_the_valid_file_is_valid(threebus, tmp_path):
    """What the bad files are variations of reads back as what was written."""
    path = tmp_path / "valid.json"
    path.write_text(json.dumps(VALID))
    instance, case = Instance.load_file(path, threebus)
    assert case is threebus
    assert json.loads(instance.model_dump_json(by_alias=True)) == VALID


@pytest.mark.parametrize("name", BAD)
def test_a_wrong_instance_is_refused(threebus, tmp_path, name):
    """Each error names the file and the field, on one line."""
    text, field, problem = BAD[name]
    path = tmp_path / "bad.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        Instance.load_file(path, threebus)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert problem in caught.value.problem
    assert str(caught.value).startswith(f"{path}: {field}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["missing", "directory", "not UTF-8", "null byte in the name"])
def test_an_unreadable_file_is_refused(threebus, tmp_path, name):
    """A file that is not there or not text is the user's error too, and is named."""
    path = tmp_path / "bad.json"
    if name == "directory":
        path.mkdir()
    elif name == "not UTF-8":
        path.write_bytes(b'{"id": "\xff"}')
    elif name == "null byte in the name":
        path = Path("bad\0.json")
    with pytest.raises(InputError, match=r"is not UTF-8 text|cannot be read") as caught:
        Instance.load_file(path, threebus)
    assert caught.value.source == str(path)


def test_an_instance_finds_its_case(threebus, ninebus, tmp_path, monkeypatch):
    """The case given, else ../case.json, else the shipped cases; from any working directory."""
    folder = tmp_path / "problems" / "threebus"
    write_record(threebus, folder / "case.json")
    path = folder / "instances" / "a.json"
    write_record(sample_instance(threebus, 1, 0), path)
    monkeypatch.chdir(folder / "instances")
    assert Instance.load_file("a.json")[1] == threebus
    loose = tmp_path / "loose.json"
    write_record(sample_instance(ninebus, 1, 0), loose)
    assert Instance.load_file(loose)[1] == ninebus
    stray = folder / "instances" / "b.json"  # beside another case: the shipped one of its name serves
    write_record(sample_instance(ninebus, 1, 1), stray)
    assert Instance.load_file(stray)[1] == ninebus
    orphan = tmp_path / "orphan.json"
    write_record(sample_instance(threebus, 1, 0), orphan)
    with pytest.raises(InputError, match="threebus: no such case"):
        Instance.load_file(orphan)


def test_instances_of_one_run_differ_in_id_and_share_a_case(threebus, ninebus, alter, tmp_path):
    """No file, the same id twice, two cases, or two versions of one case: an error each."""
    folder = tmp_path / "threebus"
    write_record(threebus, folder / "case.json")
    paths = [folder / "instances" / f"{i}.json" for i in range(2)]
    for i, path in enumerate(paths):
        write_record(sample_instance(threebus, 1, i), path)
    instances, case = load_instances(paths)
    assert [instance.id for instance in instances] == ["threebus-0000", "threebus-0001"]
    assert case == threebus
    with pytest.raises(InputError, match="no instance was given"):
        load_instances([])
    with pytest.raises(InputError, match="threebus-0000 was already given"):
        load_instances([paths[0], paths[0]])
    other = tmp_path / "other.json"
    write_record(sample_instance(ninebus, 1, 0), other)
    with pytest.raises(InputError, match=r"other.json: case: .* must share one case"):
        load_instances([paths[0], other])
    with pytest.raises(InputError, match=r"other.json: case: is for case '9bus', not 'threebus'"):
        load_instances([other], threebus)
    heavier = tmp_path / "heavier"
    write_record(alter(threebus, ramp_pu_per_s=0.1), heavier / "case.json")
    write_record(sample_instance(threebus, 1, 2), heavier / "instances" / "2.json")
    with pytest.raises(InputError, match=r"2.json: case: .* must share one case"):
        load_instances([paths[0], heavier / "instances" / "2.json"])
    assert load_instances([paths[0], heavier / "instances" / "2.json"], threebus)[1] is threebus


SPLIT = {"schema": "ded-bench/split/1", "seed": 1, "train": [], "test": []}
MANIFEST = {"schema": "ded-bench/manifest/1", "version": "1", "files": {}}


@pytest.mark.parametrize(
    ("reader", "name", "data", "field"),
    [
        (load_split, "split.json", {k: v for k, v in SPLIT.items() if k != "test"}, "test"),
        (load_split, "split.json", SPLIT | {"seed": 1.5}, "seed"),
        (load_split, "split.json", SPLIT | {"train": ["../a"]}, "train.0"),
        (load_manifest, "MANIFEST.json", MANIFEST | {"version": 1}, "version"),
        (load_manifest, "MANIFEST.json", MANIFEST | {"files": {"a": 1}}, "files.a"),
    ],
)
def test_split_and_manifest_are_read_strictly(tmp_path, reader, name, data, field):
    """The other two files of a benchmark folder obey the same rules."""
    (tmp_path / name).write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        reader(tmp_path)
    assert (caught.value.source, caught.value.field) == (str(tmp_path / name), field)


def test_a_folder_without_a_manifest_has_no_version(tmp_path):
    """A manifest is optional, a split is not."""
    assert load_manifest(tmp_path) is None
    with pytest.raises(InputError, match=r"split.json: cannot be read"):
        load_split(tmp_path)


def test_input_errors_survive_pickling():
    """Parallel workers send them to the parent."""
    error = pickle.loads(pickle.dumps(InputError("file", "field", "problem")))
    assert (str(error), error.field) == ("file: field: problem", "field")


def test_records_round_trip_and_are_byte_identical(case, tmp_path):
    """Read what was written, write it again: the same bytes."""
    instance = sample_instance(case, 5, 1)
    for record, name in ((case, "case.json"), (instance, "a.json")):
        first, second = tmp_path / name, tmp_path / f"again-{name}"
        write_record(record, first)
        again = read_record(type(record), first)
        assert again == record
        write_record(again, second)
        assert first.read_bytes() == second.read_bytes()


def test_a_changed_copy_forgets_what_followed_from_the_original(case, quiet_instance):
    instance = quiet_instance(case)
    assert (len(instance.grid), case.ramp.max(), case.fingerprint) != (0, 0.0, "")  # cached
    shorter, tighter = instance.until(1.0), case.model_copy(update={"id": "other"})
    assert (shorter != instance, len(shorter.grid)) == (True, round(1.0 / instance.dt_s) + 1)
    assert (tighter != case, tighter.model_copy(update={"id": case.id}) == case) == (True, True)


@pytest.mark.parametrize("content", ["text é\n", b"\x00bytes"])
def test_write_atomically_replaces_the_content(tmp_path, content):
    """Folders are made, old content goes, nothing else is left behind; the umask is respected."""
    path = tmp_path / "deep" / "file"
    previous = os.umask(0o027)
    try:
        write_atomically(path, "old")
        write_atomically(path, content)
    finally:
        os.umask(previous)
    assert path.read_bytes() == (content if isinstance(content, bytes) else content.encode())
    assert path.stat().st_mode & 0o777 == 0o640
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_what_cannot_be_replaced_is_named(tmp_path):
    """The file, not the temporary one."""
    (tmp_path / "file").mkdir()
    with pytest.raises(IsADirectoryError) as caught:
        write_atomically(tmp_path / "file", "new")
    assert (caught.value.filename, caught.value.filename2) == (str(tmp_path / "file"), None)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, failing):
    """A full disk or a kill between write and rename: the old file stays whole, no litter remains."""
    path = tmp_path / "file"
    write_atomically(path, "old")

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, failing, fail)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
