"""Which instances a split or a list of files means."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_record
from ded_bench.problem.benchmark import (
    VALIDATION_COUNT,
    check_own_name,
    load_manifest,
    load_split,
    select_files,
    select_split,
    validation_instances,
    write_benchmark,
    write_scenarios,
)
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import VALIDATION_SEED, sample_instance


@pytest.fixture
def folder(problem: Path) -> Path:
    return problem


def test_splits_are_parts_of_the_whole_in_order(folder: Path, threebus: Case) -> None:
    parts = {name: select_split(folder, name) for name in ("test", "train", "all")}
    ids = {name: [i.id for i, _ in part.instances] for name, part in parts.items()}
    assert ids["all"] == [f"threebus-{k:04d}" for k in range(5)]
    assert ids["test"] == list(load_split(folder).test)
    assert sorted(ids["test"] + ids["train"]) == ids["all"]
    for name, part in parts.items():
        assert part.case == threebus
        assert part.version.startswith("1-")
        assert all(split == ("test" if i.id in ids["test"] else "train") for i, split in part.instances), name
    assert [i.id for i, _ in select_split(folder, "all", 2).instances] == ids["all"][:2]
    assert select_split(folder / "case.json", "test") == parts["test"]


def test_validation_instances_are_drawn_afresh_and_are_not_of_the_benchmark(
    folder: Path, threebus: Case
) -> None:
    chosen = select_split(folder, "validation", 3)
    ids = [instance.id for instance, _ in chosen.instances]
    assert ids == ["threebus-v0000", "threebus-v0001", "threebus-v0002"]
    assert [split for _, split in chosen.instances] == ["validation"] * 3
    manifest = load_manifest(folder)
    assert manifest is not None
    assert chosen.version == manifest.version
    plain = sample_instance(threebus, VALIDATION_SEED, 2)
    assert chosen.instances[2][0] == plain.model_copy(update={"id": "threebus-v0002"})
    assert validation_instances(threebus, 1, first=2) == [chosen.instances[2][0]]
    assert len(select_split(folder, "validation").instances) == VALIDATION_COUNT
    assert not set(ids) & {instance.id for instance, _ in select_split(folder, "all").instances}


def test_files_know_their_split_and_version(folder: Path, tmp_path: Path, threebus: Case) -> None:
    files = sorted((folder / "instances").glob("*.json"))
    assert select_files(files) == select_split(folder, "all")
    stranger = tmp_path / "elsewhere" / "mine.json"
    stranger.parent.mkdir()
    stranger.write_text(json.dumps(json.loads(files[0].read_text()) | {"id": "mine"}))
    chosen = select_files([stranger], threebus)
    assert [split for _, split in chosen.instances] == ["none"]
    assert chosen.version == ""


def test_an_edited_copy_needs_a_name_of_its_own(
    threebus: Case, quiet_instance, alter, tmp_path: Path
) -> None:
    instance = quiet_instance(threebus)
    write_record(threebus, tmp_path / "case.json")
    case = Case.load(tmp_path)
    place = tmp_path / "instances" / f"{instance.id}.json"
    check_own_name(instance, "copy.json", case)
    write_record(instance, place)
    check_own_name(instance, "copy.json", case)  # the same instance, wherever it lies
    edited = alter(instance, horizon_s=2 * instance.horizon_s)
    with pytest.raises(InputError, match=rf"copy.json: id: {instance.id} is the name of .*: choose another"):
        check_own_name(edited, "copy.json", case)
    check_own_name(alter(edited, id="mine"), "copy.json", case)


def test_draws_make_room_for_draws_of_their_case_alone(tmp_path: Path, threebus: Case) -> None:
    others = [tmp_path / "package.json", tmp_path / "instances" / "mine.json"]
    write_benchmark(threebus, 3, 1, tmp_path)
    for other in others:
        other.write_text("{}")
    write_benchmark(threebus, 2, 1, tmp_path)
    for count in (2, 1):
        write_scenarios(threebus, count, 0, tmp_path, duration_s=1.0)
    assert all(other.exists() for other in others)
    found = sorted(path.name for path in tmp_path.rglob(f"{threebus.id}-*.json"))
    assert found == ["threebus-0000.json", "threebus-0001.json", "threebus-s0000.json"]


def test_files_that_were_changed_have_a_version_of_their_own(tmp_path: Path, threebus: Case) -> None:
    """And that of the manifest again when they are as they were."""
    version = write_benchmark(threebus, 3, 1, tmp_path).version
    path = tmp_path / "case.json"
    before, data = path.read_text(), json.loads(path.read_text())
    data["regimes"]["TO"]["omega_hz"] *= 0.5
    path.write_text(json.dumps(data))
    changed = select_split(tmp_path, "all").version
    assert changed.startswith("1-")
    assert changed != version
    path.write_text(before)
    assert select_split(tmp_path, "all").version == version
    (tmp_path / "instances" / "threebus-0002.json").unlink()
    assert select_split(tmp_path, "all", 1).version not in ("", version, changed)


def test_draws_that_are_cut_short_have_no_version(
    tmp_path: Path, threebus: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_benchmark(threebus, 3, 1, tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ded_bench.problem.benchmark.draw_split", full)
    with pytest.raises(OSError, match="No space"):
        write_benchmark(threebus, 3, 2, tmp_path)
    assert select_split(tmp_path, "all").version == ""


def test_a_copy_of_a_benchmark_has_its_version(tmp_path: Path, threebus: Case) -> None:
    """The case's file keeps its bytes, however it is written."""
    source = tmp_path / "mine.json"
    source.write_text(threebus.model_dump_json(by_alias=True, indent=7))
    versions = [write_benchmark(threebus, 3, 1, tmp_path / n, source=source).version for n in ("a", "b")]
    assert versions[0] == versions[1]
    assert (tmp_path / "a" / "case.json").read_bytes() == source.read_bytes()
    assert write_benchmark(threebus, 3, 1, tmp_path / "c").version != versions[0]
