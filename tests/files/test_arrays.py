"""Model and policy files: named arrays with a header, and what is refused."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import safetensors.numpy

from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError


def test_arrays_and_header_round_trip(tmp_path):
    """Every bit of every float comes back, also from views that are not contiguous."""
    rng = np.random.default_rng(0)
    square = rng.standard_normal((4, 4))
    arrays = {"k": square.T, "b": rng.standard_normal((4, 2))[:, ::2], "empty": np.zeros((0, 3))}
    header = {"kind": "foh", "dt_s": 0.1 + 0.2, "layers": [1, 2], "note": 'é "quoted"\n', "none": None}
    path = tmp_path / "folder" / "model.safetensors"
    write_arrays(path, arrays, header)
    again, read_header = read_arrays(path)
    assert read_header == header
    assert set(again) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype


class _Exploit:
    def __reduce__(self):
        return (pytest.fail, ("a file was executed",))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 7,
        b"not a model",
        b"\xff" * 64,
        safetensors.numpy.save({"k": np.eye(3)})[:-8],
        safetensors.numpy.save({"k": np.eye(3)}, {"kind": "{not JSON"}),
        pickle.dumps(_Exploit()),
    ],
    ids=["empty", "short", "text", "huge length", "cut", "header not JSON", "pickle"],
)
def test_other_files_are_refused(tmp_path, content):
    """Half a file, another format, or one that would run code: an InputError, nothing executed."""
    path = tmp_path / "bad.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is not a model or policy file") as caught:
        read_arrays(path)
    assert caught.value.source == str(path)


@pytest.mark.parametrize(
    "array", [np.array([1.0, np.nan]), np.array([np.inf]), np.array([1, 2]), np.array([True])]
)
def test_arrays_must_hold_finite_floats(tmp_path, array):
    """A diverged training run is found when its model is read, by name."""
    path = tmp_path / "model.safetensors"
    write_arrays(path, {"good": np.eye(2), "weight": array}, {})
    with pytest.raises(InputError, match="weight: must hold finite numbers"):
        read_arrays(path)
