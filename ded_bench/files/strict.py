"""Strict JSON: what a file may say is what its model declares; and files that are written whole or not."""

from __future__ import annotations

import contextlib
import difflib
import errno
import functools
import gzip
import hashlib
import json
import os
import secrets
import stat
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, WrapValidator

from ded_bench.files.errors import InputError

#: No text that we read is larger; what is read of it takes ten times as much memory.
MAX_BYTES = 64 * 2**20


class Record(BaseModel):
    """A frozen record whose unknown, missing, mistyped or non-finite fields are errors."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, populate_by_name=True
    )

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy without what is cached, which may follow from what is updated."""
        copied = super().model_copy(update=update, deep=deep)
        for name in vars(copied).keys() - type(self).model_fields.keys():
            del vars(copied)[name]
        return copied


class Fingerprinted(Record):
    """A record that is equal to others of its content."""

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


def read_text(path: str | Path, largest: int = MAX_BYTES) -> str:
    """Return the text of a UTF-8 file, unpacked if its name ends in `.gz`.

    Raises:
        InputError: it cannot be read, is no regular file, or larger than `largest`, also when unpacked.
    """
    if regular_size(path) > largest:
        raise InputError(path, "", f"is larger than {largest >> 20} MiB")
    try:
        opened: Any = gzip.open if str(path).endswith(".gz") else open
        with opened(path, "rt", encoding="utf-8") as file:
            text: str = file.read(largest + 1)
    except UnicodeDecodeError:
        raise InputError(path, "", "is not UTF-8 text") from None
    except (OSError, EOFError, ValueError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(path, "", f"cannot be read ({reason})") from None
    if len(text) > largest:
        raise InputError(path, "", f"is larger than {largest >> 20} MiB")
    return text


def regular_size(path: str | Path) -> int:
    """Size in bytes, 0 without a file; InputError if it is no regular one, whose reading might never end."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return 0  # whoever opens it says why it cannot be
    if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode):
        raise InputError(path, "", "is no regular file")
    return found.st_size


def parse_record(kind: type[R], text: str, source: str | Path) -> R:
    """Parse JSON text as a `kind`; `source` is the name that errors give."""

    def once(pairs: list[tuple[str, Any]]) -> None:
        if twice := [key for key, count in Counter(key for key, _ in pairs).items() if count > 1]:
            raise InputError(source, twice[0], "appears twice")

    try:
        json.loads(text, object_pairs_hook=once)
        return kind.model_validate_json(text)
    except ValidationError as error:
        found = error.errors(include_url=False)
        first = next((wrong for wrong in found if wrong["type"] == "extra_forbidden"), found[0])
        field = ".".join(str(part) for part in first["loc"])
        unknown = first["type"] == "extra_forbidden"
        said = _unknown(kind, str(first["loc"][-1])) if unknown else _plain(first["msg"])
        raise InputError(source, field, said) from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(source, "", f"is not JSON ({str(error)[:120]})") from None


def write_record(record: Record, path: Path) -> None:
    """Write one record as indented JSON, byte-identical for equal records."""
    write_atomically(path, record.model_dump_json(by_alias=True, indent=1) + "\n")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content`, packed for `.gz`, in one step: no reader or crash sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content if isinstance(content, bytes) else content.encode()
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with naming(path), open(temporary, "xb") as file:
            file.write(gzip.compress(data, 3, mtime=0) if path.suffix == ".gz" else data)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.replace(temporary, path)
        except OSError as error:  # it names the temporary file
            raise OSError(error.errno, error.strerror, str(path)) from None
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an OSError that names no file, as that of a full disk, name this one."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
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


def of_kind(choose: Callable[[dict[str, Any]], type[Record]], *kinds: type[Record]) -> WrapValidator:
    """Read a record as what its fields say it is: a union's errors would name fields of all kinds."""

    def read(value: Any, _: Any) -> Any:
        if isinstance(value, kinds):
            return value
        return choose(value if isinstance(value, dict) else {}).model_validate(value)

    return WrapValidator(read)


def _unknown(kind: type[Record], key: str) -> str:
    """What to say of a key that is none, with the one that may be meant."""
    schema = kind.model_json_schema()
    known = {
        name for part in (schema, *schema.get("$defs", {}).values()) for name in part.get("properties", ())
    }
    near = difflib.get_close_matches(key, sorted(known), n=1)
    return "unknown field" + (f"; did you mean {near[0]}?" if near else "")


def _plain(message: str) -> str:
    """Pydantic's sentence, without its prefix for our own checks, starting in lower case."""
    message = message.removeprefix("Value error, ").splitlines()[0]
    return message[:1].lower() + message[1:]
