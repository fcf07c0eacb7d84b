"""Strict JSON: what a file may say is what its model declares; and files that are written whole or not."""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from ded_bench.files.errors import InputError


class Record(BaseModel):
    """A frozen record whose unknown, missing, mistyped or non-finite fields are errors."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, populate_by_name=True
    )


class Fingerprinted(Record):
    """A record that is equal to others of its content: cached arrays do not count."""

    @functools.cached_property
    def fingerprint(self) -> str:
        """Twelve hex digits that change when anything in the record does."""
        return hashlib.sha256(self.model_dump_json(by_alias=True).encode()).hexdigest()[:12]

    def __eq__(self, other: object) -> bool:
        """Equal kind and content."""
        return isinstance(other, type(self)) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        """Equal records have equal hashes: they are keys of what is made once for each."""
        return hash(self.fingerprint)


R = TypeVar("R", bound=Record)


def read_record(kind: type[R], path: str | Path) -> R:
    """Read `path` as a `kind`.

    Raises:
        InputError: the file cannot be read, is not JSON, or a field is wrong; names file and field.
    """
    return parse_record(kind, read_text(path), path)


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file; InputError if it cannot be read."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(path, "", "is not UTF-8 text") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(path, "", f"cannot be read ({reason})") from None


def parse_record(kind: type[R], text: str, source: str | Path) -> R:
    """Parse JSON text as a `kind`; `source` is the name that errors give."""
    try:
        json.loads(text, object_pairs_hook=_no_duplicates)
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(source, field, _plain(first["msg"])) from None
    except _DuplicateKeyError as error:
        raise InputError(source, str(error), "appears twice") from None
    except (ValueError, RecursionError) as error:
        raise InputError(source, "", f"is not JSON ({str(error)[:120]})") from None


def write_record(record: Record, path: Path) -> None:
    """Write one record as indented JSON, byte-identical for equal records."""
    write_atomically(path, record.model_dump_json(by_alias=True, indent=1) + "\n")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content` in one step: a reader or a crash never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content if isinstance(content, bytes) else content.encode())
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def check_writable(out: Path) -> None:
    """Raise InputError unless a file can be made at `out`; its folder is made."""
    try:
        if out.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        out.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out.parent).close()
    except OSError as error:
        raise InputError(out, "", f"cannot be written ({error.strerror})") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


class _DuplicateKeyError(Exception):
    pass


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise _DuplicateKeyError(key)
        seen[key] = value
    return seen


def _plain(message: str) -> str:
    """Pydantic's sentence, without its prefix for our own checks, starting in lower case."""
    message = message.removeprefix("Value error, ").splitlines()[0]
    return message[:1].lower() + message[1:]
