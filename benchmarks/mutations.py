"""Damages files at random, for tests and benchmarks that read damaged files.

:func:`damage` takes any file: it changes the bytes, or, in JSON, CSV, safetensors and ``.sample``
files, the values.
"""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

#: Replacements of any value of a JSON document. Text in ``<>`` is written as it is.
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.5, -0.0, 1e-300, 1e300, -1e300, 1e6, 10**9, 2**31, 2**63, 2**64,
    "", "x", "0", "é\u202e\ud7ff", "../../../etc/passwd", "/etc/passwd", "..", "a\0b",
    "x" * 100_000,
    [], [[]], {}, [1], [None], [1, 2, 3], [[1, 2], [3]], [["x"]] * 3, {"a": 1}, {"": None},
    [0.0] * 10_000, [[0.0, 0.0, 0.0]] * 3_000,
    "<NaN>", "<Infinity>", "<-Infinity>", "<1e999>", "<-1e999>", "<1e400000>",
    "<" + "9" * 5_000 + ">", "<-" + "9" * 5_000 + ">",
    "<" + "[" * 100_000 + "]" * 100_000 + ">", "<" + '{"a":' * 50_000 + "1" + "}" * 50_000 + ">",
)  # fmt: skip

#: Replacements of a field of CSV.
FIELDS = (
    "", " ", "nan", "inf", "-inf", "1e999", "1e308", "-1e308", "1e-308", "-1", "0", "1", "2.5",
    "99999999999999999999", "9" * 5_000, "x", "é", "\0", '"', "'", "=1+1", "1,2", "x" * 200_000,
    "True", "0x10", "1_000", "٣",
)  # fmt: skip


def damage(path: Path, rng: random.Random) -> str:
    """Change a file on the disk; return a few words about the change."""
    if rng.random() < 0.02:
        return _replace_file(path, rng)
    data = path.read_bytes()
    mutations: list[Callable[[bytes, random.Random], tuple[bytes, str]]] = [_bytes]
    by_kind = {
        ".json": _json, ".csv": _csv, ".safetensors": _tensors, ".sample": _words, ".jsonl": _lines
    }  # fmt: skip
    if path.suffix in by_kind:
        mutations += 4 * [by_kind[path.suffix]]
    try:
        changed, what = rng.choice(mutations)(data, rng)
    except (ValueError, IndexError, KeyError):  # a file that has nothing to change in that way
        changed, what = _bytes(data, rng)
    path.write_bytes(changed)
    return f"{path.name}: {what}"


def _replace_file(path: Path, rng: random.Random) -> str:
    path.unlink()
    kind = rng.choice(("missing", "a folder", "a link to itself", "a pipe", "empty"))
    if kind == "a folder":
        path.mkdir()
    elif kind == "a link to itself":
        path.symlink_to(path.name)
    elif kind == "a pipe" and hasattr(os, "mkfifo"):
        os.mkfifo(path)
    elif kind == "empty":
        path.touch()
    return f"{path.name}: {kind}"


def _bytes(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    kind = rng.choice(("cut", "flip", "insert", "remove", "repeat", "zero", "bom", "text"))
    start = rng.randrange(len(data) + 1)
    length = min(int(2 ** rng.uniform(0, 14)), 10_000)
    if kind == "cut":
        return data[:start], f"cut at byte {start}"
    if kind == "flip":
        changed = bytearray(data)
        for _ in range(rng.randint(1, 8)):
            if changed:
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        return bytes(changed), "bits flipped"
    if kind == "insert":
        return data[:start] + rng.randbytes(length) + data[start:], f"bytes inserted at {start}"
    if kind == "remove":
        return data[:start] + data[start + length :], f"bytes {start} to {start + length} removed"
    if kind == "repeat":
        part = data[start : start + length]
        return data[:start] + part * rng.randint(2, 20) + data[start:], f"repeated at {start}"
    if kind == "zero":
        return data[:start] + bytes(length) + data[start + length :], f"zeros at {start}"
    if kind == "bom":
        return rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\x1f\x8b")) + data, "another beginning"
    return b"something else\n" * rng.randint(0, 100), "another text"


def _nodes(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Give the places in a JSON document; of a list the first two and the last."""
    if path:
        yield path
    inner = list(value.items()) if isinstance(value, dict) else []
    if isinstance(value, list):
        inner = list(enumerate(value))
        inner = inner if len(inner) <= 3 else [*inner[:2], inner[-1]]
    for key, each in inner:
        yield from _nodes(each, (*path, key))


def _json(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    document = json.loads(data)
    # Half of the changes are near the top, which would otherwise be rare beside long lists.
    places = list(_nodes(document))
    if rng.random() < 0.5:
        places = [path for path in places if len(path) <= 2]
    done = []
    for _ in range(1 if rng.random() < 0.8 else rng.randint(2, 4)):
        path = rng.choice(places)
        place: Any = document
        try:
            for key in path[:-1]:
                place = place[key]
            now = place[path[-1]]
        except (KeyError, IndexError, TypeError):
            continue  # something above it was changed already
        if not isinstance(place, dict | list):
            continue
        done.append(f"{_named(path)} {_change(place, path[-1], now, rng)}")
    text = json.dumps(document)
    text = re.sub(r'"<([^<>"\\]*(?:\\"a\\":[^<>"\\]*)*)>"', _raw, text)
    if rng.random() < 0.05:
        text = re.sub(r'("\w+": )', r"\g<1>0, \g<1>", text, count=rng.randint(1, 5))
        done.append("keys that stand twice")
    return text.encode("utf-8", "surrogatepass"), ", ".join(done)


def _raw(result: re.Match[str]) -> str:
    return result[1].replace('\\"', '"')


def _named(path: tuple) -> str:
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path).lstrip(".")


def _change(place: Any, key: Any, now: Any, rng: random.Random) -> str:
    kinds = ["value", "value", "value", "left out", "key"]
    number = isinstance(now, int | float) and not isinstance(now, bool)
    if number:
        kinds += ["times", "times"]
    elif isinstance(now, list):
        kinds += ["longer", "shorter", "nested"]
    elif isinstance(now, str):
        kinds += ["longer"]
    kind = rng.choice(kinds)
    if kind == "left out":
        del place[key]
    elif kind == "key" and isinstance(place, dict):
        place[rng.choice(("", "x", "format", "x" * 1000))] = place.pop(key)
    elif kind == "times":
        factor = rng.choice((-1, 0, 0.5, 1.0, 2, 10, 1000, 1e-6, 1e6, 1e12))
        place[key] = now * factor
        return f"times {factor:g}"
    elif kind == "longer":
        place[key] = now * rng.choice((2, 3, 1000))
    elif kind == "shorter":
        place[key] = now[: rng.randrange(len(now) + 1)]
    elif kind == "nested":
        place[key] = [now]
    else:
        place[key] = rng.choice(VALUES)
        return f"= {place[key]!r:.30}"
    return kind


def _csv(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    lines = data.decode().splitlines()
    cells = [line.split(",") for line in lines]
    line = rng.choice((0, min(1, len(cells) - 1), len(cells) - 1, rng.randrange(len(cells))))
    kind = rng.choice(
        ("field", "field", "field", "column", "line out", "twice", "swap", "name", "order", "all")
    )
    column = rng.randrange(len(cells[line]))
    if kind == "field":
        cells[line][column] = rng.choice(FIELDS)
    elif kind == "column":
        for row in cells:
            del row[column]
    elif kind == "line out":
        del cells[line]
    elif kind == "twice":
        cells[line:line] = [list(cells[line])] * rng.choice((1, 4, 2_000))
    elif kind == "swap":
        other = rng.randrange(len(cells))
        cells[line], cells[other] = cells[other], cells[line]
    elif kind == "name":
        cells[0][column % len(cells[0])] = rng.choice((*cells[0], *FIELDS))
    elif kind == "order":
        rng.shuffle(cells)
    else:
        value = rng.choice(FIELDS[:18])
        for row in cells[1:]:
            row[column % len(row)] = value
    changed = "\n".join(",".join(row) for row in cells) + "\n"
    return changed.encode(), f"line {line + 1}, column {column + 1}: {kind}"


def _words(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    words = data.decode().split(" ")
    place = rng.choice((rng.randrange(min(6, len(words))), rng.randrange(len(words))))
    words[place] = rng.choice((*FIELDS[:-1], "100000", "1000000000", "TURN 5", "END"))
    return " ".join(words).encode(), f"word {place} = {words[place]:.20}"


def _lines(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    lines = data.splitlines()
    place = rng.randrange(len(lines))
    lines[place], what = _json(lines[place], rng)
    return b"\n".join(lines) + b"\n", f"line {place + 1}: {what}"


def _tensors(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    from safetensors.numpy import load, save

    length = int.from_bytes(data[:8], "little")
    if rng.random() < 0.3:
        wrong = rng.choice((0, 1, length - 1, length + 1, 10 * length, 2**31, 2**63, 2**64 - 1))
        return wrong.to_bytes(8, "little") + data[8:], f"a header of {wrong} bytes"
    if rng.random() < 0.4:
        head, what = _json(data[8 : 8 + length], rng)
        return len(head).to_bytes(8, "little") + head + data[8 + length :], f"header: {what}"
    tensors = {name: value.copy() for name, value in load(data).items()}
    name = rng.choice(sorted(tensors))
    tensor = tensors[name]
    kind = rng.choice(("value", "value", "all", "shape", "out", "kind", "order", "longer", "empty"))
    if kind == "value" and tensor.size:
        numbers = (np.nan, np.inf, -np.inf, 0, -1, 1e-300, 1e30, 1e300, rng.gauss(0, 10))
        with np.errstate(over="ignore", invalid="ignore"):
            tensor.reshape(-1)[rng.randrange(tensor.size)] = np.array(rng.choice(numbers)).astype(
                tensor.dtype
            )
    elif kind == "all":
        tensors[name] = np.full_like(tensor, rng.choice((0, 1, 100)))
    elif kind == "shape":
        tensors[name] = tensor.reshape(rng.choice(((-1,), (1, *tensor.shape), (*tensor.shape, 1))))
    elif kind == "out":
        del tensors[name]
    elif kind == "kind":
        with np.errstate(over="ignore", invalid="ignore"):
            tensors[name] = tensor.astype(rng.choice((np.float32, np.int64, np.uint8, np.float16)))
    elif kind == "order":
        tensors[name] = np.ascontiguousarray(tensor[..., ::-1].T)
    elif kind == "longer":
        tensors[name] = np.concatenate([tensor] * rng.choice((2, 3, 50)))
    else:
        tensors[name] = tensor[:0]
    return save(tensors), f"{name}: {kind}"
