"""Ways to damage a file: JSON, tables, arrays, and bytes of anything."""

from __future__ import annotations

import gzip
import json
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy


class Mutant(NamedTuple):
    """A damaged file: its bytes, and names of which one must be in the error (none: any error will do)."""

    data: bytes
    names: tuple[str, ...] = ()


class Raw(str):
    """JSON text that json.dumps would not write."""


class Object(list[Any]):
    """A JSON object as a list of pairs, so that a key can be there twice."""


STRANGE: tuple[Any, ...] = (
    *(Raw(text) for text in ("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1" + "0" * 400, "-0.0")),
    *(Raw(text) for text in ("01", "+1", ".5", "0x10", "True", "'a'", "", "[" * 3000 + "]" * 3000)),
    *(Raw(text) for text in ("[" * 100_000, '{"a":' * 3000 + "1" + "}" * 3000, '"\\ud800"', '"\\u0000"')),
    *(None, True, "", "text", "1.0", "0.95 pu", "../../etc/passwd", "a" * 5000, [], [1], [[1, 2]], Object()),
    *(-1, 0, 1, 2**63, -(2**70), 0.5, -0.5, 1e-320, 1e-9, 1e9, 1e308, -1e308, 60.0, 376.99),
)


def dump(node: Any) -> str:
    """JSON text of a tree that may hold what JSON cannot say."""
    if isinstance(node, Raw):
        return str(node)
    if isinstance(node, Object):
        return "{" + ", ".join(f"{json.dumps(key)}: {dump(value)}" for key, value in node) + "}"
    if isinstance(node, list):
        return "[" + ", ".join(map(dump, node)) + "]"
    return json.dumps(node)


def places(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[list[Any], int, tuple[str, ...]]]:
    """Every member of every object and list: where it is held, at which position, and its path of names."""
    if isinstance(node, Object):
        for i, (key, value) in enumerate(node):
            yield node, i, (*path, key)
            yield from places(value, (*path, key))
    elif isinstance(node, list):
        for i, value in enumerate(node):
            yield node, i, path
            yield from places(value, path)


def damaged_json(text: str, rng: random.Random) -> Mutant:
    """One member removed, doubled, renamed, scaled or replaced, or a new one beside it."""
    tree = json.loads(text, object_pairs_hook=Object)
    holder, i, path = rng.choice(list(places(tree)))
    member = holder[i]
    named = isinstance(holder, Object)
    action = rng.choice(["remove", "double", "rename", "scale", "replace", "replace", "replace", "add"])
    names = path
    if action == "remove":
        del holder[i]
    elif action == "double":
        holder.insert(rng.randrange(len(holder) + 1), member)
    elif action == "rename" and named:
        holder[i] = (rng.choice(["colour", "", "x" * 300, member[0].upper() + "_mw", "P_é"]), member[1])
        names = (*path, holder[i][0])
    elif action == "add" and named:
        holder.insert(i, (rng.choice(["colour", member[0] + "_", "__class__"]), member[1]))
        names = (holder[i][0],)
    else:
        value = member[1] if named else member
        scaled = isinstance(value, (int, float)) and action == "scale"
        new = value * rng.choice([1e3, 1e-3, 100, -1, 2 * 3.14159, 1e15]) if scaled else rng.choice(STRANGE)
        holder[i] = (member[0], new) if named else new
        if isinstance(new, Raw):
            names = ()  # the text may be no JSON at all
    return Mutant(dump(tree).encode("utf-8", "surrogatepass"), names if all(names) else ())


def damaged_bytes(data: bytes, rng: random.Random) -> Mutant:
    """Bits turned, bytes lost, doubled or foreign, another encoding, or nothing left."""
    start, stop = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 30])):
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    text = data.decode("utf-8", "replace")
    return Mutant(
        rng.choice(
            [
                *[bytes(changed)] * 8,
                *[data[:start]] * 3,
                data[:start] + data[stop:],
                data[:stop] + data[start:],
                data[:start] + rng.randbytes(rng.choice([1, 8, 64])) + data[start:],
                data[:start]
                + rng.choice([b"\0", b"\xff\xfe", b"\xc3\x28", b"\n\n", b'"', b"\r"])
                + data[start:],
                b"",
                b"\0" * len(data),
                data + b"\n{}",
                data + data,
                b"\xef\xbb\xbf" + data,
                text.encode("utf-16"),
                gzip.compress(data, mtime=0),
                rng.randbytes(200),
            ]
        )
    )


CELLS = (
    *("", " ", "nan", "NaN", "inf", "-Infinity", "1e400", "-1e400", "1e308", "-1e308", "1_0", "0x1p3", "1,5"),
    *("text", "None", "True", "yes", '"', "'", "\0", "\x1b[31m", "é", "１", "1" * 5000, "-1", "0", "0.95 pu"),
    *("../a", "=1+1", "Optimal ", "1\n2", "a" * 200_000),
)


def damaged_table(text: str, rng: random.Random) -> Mutant:
    """A cell, a row or a column changed."""
    rows = [line.split(",") for line in text.splitlines()]
    row, column = rng.randrange(len(rows)), rng.randrange(len(rows[0]))
    name = rows[0][column]
    action = rng.choice(["cell"] * 4 + ["lose row", "swap rows", "double row", "column", "extra", "units"])
    names: tuple[str, ...] = ()
    if action == "cell":
        rows[row][column] = rng.choice(CELLS)
        # A line break or a quotation mark moves every cell after it.
        broken = set(rows[row][column]) & set('\n,"') or len(rows[row][column]) > 100_000
        names = (name,) if row and not broken else ()
    elif action == "lose row":
        del rows[row]
    elif action == "swap rows":
        other = rng.randrange(len(rows))
        rows[row], rows[other] = rows[other], rows[row]
    elif action == "double row":
        rows.insert(row, list(rows[row]))
    elif action == "column":
        rows = [line[:column] + line[column + 1 :] for line in rows]
        names = (name,)
    elif action == "extra":
        rows[row].append(rng.choice(CELLS))
    else:
        rows[0][column] = rng.choice([f"{name}_mw", name.upper() + "!", "", "time (ms)", rows[0][0]])
        names = (name, rows[0][column])
    whole = "".join(",".join(row) + "\n" for row in rows)
    return Mutant(whole.encode("utf-8", "surrogatepass"), names)


def damaged_arrays(data: bytes, rng: random.Random) -> Mutant:
    """A safetensors file whose declared lengths, header, facts, arrays or numbers are changed."""
    (length,) = struct.unpack("<Q", data[:8])
    header, body = data[8 : 8 + length].decode(), data[8 + length :]
    action = rng.choice(["length", "header", "header", "facts", "facts", "facts", "arrays", "arrays", "body"])
    if action == "length":
        wrong = rng.choice([0, 1, length - 1, length + 1, 10**8, 2**31, 2**63 - 1, 2**64 - 1])
        return Mutant(struct.pack("<Q", wrong) + data[8:])
    if action == "header":
        return Mutant(_with_header(damaged_json(header, rng).data, body))
    if action == "facts":
        tree = json.loads(header)
        facts = tree["__metadata__"]
        name = rng.choice(sorted(facts))
        changed = damaged_json(f'{{"inner": {facts[name]}}}', rng).data.decode("utf-8", "replace")
        facts[name] = changed[changed.find(":") + 1 : -1] if rng.random() < 0.8 else dump(rng.choice(STRANGE))
        return Mutant(_with_header(json.dumps(tree).encode(), body))
    if action == "body":
        return damaged_bytes(data, rng)
    arrays = safetensors.numpy.load(data)
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    strange: list[Callable[[], np.ndarray]] = [
        lambda: np.full_like(array, rng.choice([np.nan, np.inf, 1e38, -1e38, 0.0])),
        lambda: array.reshape(-1),
        lambda: array[..., None],
        lambda: array[:0],
        lambda: np.array(0.5),
        lambda: array.astype(rng.choice([np.float16, np.float32, np.int64, np.uint8, np.bool_])),
        lambda: np.concatenate([array, array]) if array.ndim else array,
    ]
    with np.errstate(all="ignore"):
        arrays[rng.choice([name, name, name, "extra"])] = rng.choice(strange)()
    if rng.random() < 0.2:
        del arrays[name]
    return Mutant(safetensors.numpy.save(arrays, json.loads(header)["__metadata__"]), ())


def _with_header(header: bytes, body: bytes) -> bytes:
    return struct.pack("<Q", len(header)) + header + body


class Payload:
    """Unpickling this leaves a file behind."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.trace,)
