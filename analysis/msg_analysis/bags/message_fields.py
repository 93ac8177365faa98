# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Single fields of messages of any type, by the definition in the bag (ros2msg, ros2idl).

rosbags parses the definition; the places of the fields in CDR bytes are found here, without code that is made of a
definition. A message has the same layout as another one of its type where all lengths of texts and sequences before the
last field are the same: then numpy reads thousands of messages at once.
"""

from __future__ import annotations

import functools
import itertools
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.records import Schema

from msg_analysis.bags.stored_file import Batch, gather
from msg_analysis.common.arrays import AnyArray, IntArray
from msg_analysis.common.text import listed
from msg_analysis.errors import InputError, NotAvailableError

HEADER = 4  # bytes of the encapsulation; alignment counts from its end
LONGEST_DEFINITION = 2**18  # bytes
MOST_DEFINITIONS = 2**21  # bytes of all definitions of a bag, which are parsed in 5 s
IDL_FACTOR = 25  # ros2idl takes so much longer to parse
STAMP = ("header.stamp.sec", "header.stamp.nanosec")
DEEPEST = 32  # types within types
LAYOUTS = 50  # of a batch, after which messages are read one by one
MOST_LEAVES = 10_000  # numbers and texts of a type that are listed
STORE = "ROS2_JAZZY"  # whose types are used where a bag has no definitions
_CODES = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "octet": "B",
    **{f"int{bits}": code for bits, code in ((8, "b"), (16, "h"), (32, "i"), (64, "q"))},
    **{f"uint{bits}": code for bits, code in ((8, "B"), (16, "H"), (32, "I"), (64, "Q"))},
    "float32": "f",
    "float64": "d",
}
_EXPRESSION = re.compile(
    r'"(?:\\.|[^"\\])*"|//.*|@\w+\s*\([^()"]*(?:"(?:\\.|[^"\\])*"[^()"]*)*\)'
)  # has no ( of its own
_NO_IDL = re.compile(r"^(=+|IDL: .*|#.*)$", re.MULTILINE)  # between and in definitions; the parser does not know it
_PART = re.compile(r"([A-Za-z]\w*)((?:\[\d+\])*)")
_INTEGER = re.compile(r"\[(\d+)\]")

Fields = Sequence[tuple[str, Any]]
Types = Mapping[str, tuple[Any, Fields]]
Path = tuple[str | int, ...]


class FieldError(InputError):
    """A field that messages of a type do not have, or a message or definition that cannot be read."""


def parse_path(text: str) -> Path:
    """Names and indices of ``pose.covariance[3]``; FieldError: it is not of this form."""
    parts: list[str | int] = []
    for part in text.split("."):
        if not (found := _PART.fullmatch(part)):
            raise FieldError(f"{text!r}: expected a field such as pose.position.x or data[0]")
        parts += [found[1], *map(int, _INTEGER.findall(found[2]))]
    return tuple(parts)


@functools.lru_cache(maxsize=256)
def _definitions(name: str, idl: bool, text: bytes) -> Types:
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError:
        raise NotAvailableError(
            "rosbags is not installed: expected it for messages of any type: pip install rosbags"
        ) from None
    known: Types = get_typestore(Stores[STORE]).fielddefs
    if not text.strip():
        if name not in known:
            raise FieldError(f"type {name}: the bag has no definition of it: record again with storage MCAP")
        return known
    try:
        source = text.decode()
        if idl and ("<<" in source or "(" in _EXPRESSION.sub("", source)):  # the parser takes 70 times longer for each
            raise ValueError("it has expressions: expected plain numbers")
        found: Types = get_types_from_idl(_NO_IDL.sub("", source)) if idl else get_types_from_msg(source, name)
    except Exception as error:  # the parser raises many kinds of errors on wrong definitions
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FieldError(f"type {name}: its definition in the bag is not valid ({reason})") from None
    return {**known, **found}


@dataclass(slots=True)
class Definitions:
    """Reads the types in the schemas of a bag, together with those of ROS 2."""

    left: int = MOST_DEFINITIONS
    _seen: set[tuple[str, str, bytes]] = field(default_factory=set)

    def of(self, schema: Schema) -> Types:
        """All types by name; FieldError: the definition is not valid, or those of the bag are too long to be parsed."""
        text = bytes(schema.data)
        idl = schema.encoding in ("ros2idl", "omgidl") or text.lstrip(b"=\r\n ").startswith(b"IDL: ")
        key, size = (schema.name, schema.encoding, text), len(text) * (IDL_FACTOR if idl else 1)
        if key not in self._seen:
            self._seen.add(key)
            self.left -= size
        if len(text) > LONGEST_DEFINITION or self.left < 0:
            raise FieldError(f"type {schema.name[:200]}: its definition, or all before it, are too long to be read")
        return _definitions(schema.name, idl, text)


def is_stamped(types: Types, name: str) -> bool:
    """Whether all messages have a header with a stamp."""
    kinds = dict(leaves(types, name))
    return kinds.get(STAMP[0]) in ("int32", "uint32") and kinds.get(STAMP[1]) == "uint32"


def leaves(types: Types, name: str, deepest: int = 4) -> list[tuple[str, str]]:
    """Path and type of the first numbers and texts that each message has, without those in arrays."""
    return list(itertools.islice(_leaves(types, name, "", deepest, [MOST_LEAVES]), MOST_LEAVES))


def _leaves(types: Types, name: str, before: str, deepest: int, left: list[int]) -> Iterator[tuple[str, str]]:
    """The same one after the other; ``left``: how many types may still be entered, since those may be empty."""
    for each, (kind, detail) in types.get(name, (None, ()))[1]:
        if int(kind) == 1:
            yield before + each, detail[0]
        elif int(kind) == 2 and deepest and left[0]:
            left[0] -= 1
            yield from _leaves(types, detail, f"{before}{each}.", deepest - 1, left)


@dataclass(slots=True)
class _Layout:
    """Places in a message; offsets count from its beginning."""

    end: int = 0
    lengths: list[tuple[int, int]] = field(default_factory=list)  # offset of a length, and what it is here
    places: dict[Path, tuple[int, str]] = field(default_factory=dict)  # offset and code; "s": of a text's length


class FieldReader:
    """Reads some fields of the messages of one type. FieldError: it does not have them."""

    def __init__(self, name: str, types: Types, paths: Sequence[str]) -> None:
        self.name, self._types = name, types
        self.paths = {text: parse_path(text) for text in paths}
        for text, path in self.paths.items():
            self._require(text, path)

    def _require(self, text: str, path: Path) -> None:
        """FieldError: the type has no such number or text."""
        kind: tuple[Any, Any] = (2, self.name)
        for part in path:
            number, detail = int(kind[0]), kind[1]
            if number == 2 and isinstance(part, str):
                fields = dict(self._fields(detail))
                if part not in fields:
                    known = listed([name for name, _ in leaves(self._types, self.name)] or list(fields))
                    raise FieldError(f"field {text}: {self.name} has none: expected one such as {known}")
                kind = fields[part]
            elif number in (3, 4) and isinstance(part, int):
                if number == 3 and part >= detail[1]:
                    raise FieldError(f"field {text}: the array has {detail[1]} entries, counted from 0")
                kind = detail[0]
            else:
                wanted = "an index such as [0]" if number in (3, 4) else "a field"
                raise FieldError(f"field {text}: expected {wanted} in the place of {part!r} in {self.name}")
        if int(kind[0]) != 1:
            inner = (
                [f"{text}.{name}" for name, _ in leaves(self._types, kind[1])] if int(kind[0]) == 2 else [f"{text}[0]"]
            )
            raise FieldError(f"field {text}: expected a single number, such as {listed(inner, 6)}")

    def _fields(self, name: str) -> Fields:
        if name not in self._types:
            raise FieldError(f"type {name}: the bag has no definition of it, which {self.name} needs")
        return self._types[name][1]

    def read(self, batch: Batch, chosen: IntArray) -> tuple[dict[str, AnyArray], IntArray]:
        """Of messages of a batch, by path: float64, int64 for whole numbers, str for texts; and those that are there.

        A message that ends before a field, or whose sequence is too short, is left out.
        """
        sizes, starts = batch.size[chosen], batch.start[chosen]
        found: dict[str, list[AnyArray]] = {text: [] for text in self.paths}
        kept: list[IntArray] = []
        left, rounds = np.arange(len(chosen)), 0
        octets = np.frombuffer(batch.data, np.uint8)
        while len(left):
            data = batch.message(int(chosen[left[0]]))
            try:
                layout = self._layout(data)
            except FieldError:
                left = left[1:]
                continue
            same = sizes[left] >= layout.end
            if rounds > LAYOUTS:
                same &= np.arange(len(left)) == 0
            at, order = starts[left], "<" if data[1] else ">"
            same[same] = octets[at[same] + 1] == data[1]
            for offset, length in layout.lengths:
                same[same] = gather(batch.data, at[same] + offset, 4).view(f"{order}u4") == length
            here = at[same]
            for text, path in self.paths.items():
                offset, code = layout.places[path]
                found[text].append(self._values(batch.data, here + offset, code, order))
            kept.append(left[same])
            left, rounds = left[~same], rounds + 1
        index = np.concatenate(kept) if kept else np.empty(0, np.int64)
        sort = np.argsort(index)
        arrays = {text: np.concatenate(parts)[sort] if parts else np.empty(0) for text, parts in found.items()}
        return arrays, chosen[index[sort]]

    @staticmethod
    def _values(data: bytes, at: IntArray, code: str, order: str) -> AnyArray:
        if code == "s":
            texts = []
            for start in at.tolist():
                (length,) = struct.unpack_from(f"{order}I", data, start)
                texts.append(data[start + 4 : start + 4 + length].rstrip(b"\0").decode("utf-8", "replace"))
            return np.array(texts, dtype=object)
        kind = np.dtype(order + code)
        values = gather(data, at, kind.itemsize).view(kind)
        large = code == "Q" and len(values) and values.max() >= 2**63
        with np.errstate(invalid="ignore"):  # of a signalling NaN
            return np.asarray(values.astype(np.float64 if code in "fd" or large else np.int64))

    def _layout(self, data: bytes) -> _Layout:
        """Where the fields are in a message; FieldError: it is too short, or of another encoding."""
        if len(data) < HEADER or data[0] != 0 or data[1] > 1:
            raise FieldError(f"{self.name}: expected a CDR header 00 01 00 00")
        layout = _Layout(end=HEADER)
        wanted = set(self.paths.values())
        walk = _Walk(data, "<" if data[1] else ">", self, layout, wanted)
        walk.message(self.name, (), 0)
        if layout.places.keys() != wanted:
            raise FieldError(f"{self.name}: a sequence is too short")
        return layout


@dataclass(slots=True)
class _Walk:
    """One walk through a message, which ends when all wanted fields are found."""

    data: bytes
    order: str
    reader: FieldReader
    layout: _Layout
    wanted: set[Path]

    def _take(self, size: int, count: int = 1) -> int:
        layout = self.layout
        start = layout.end + (HEADER - layout.end) % size if count else layout.end
        layout.end = start + size * count
        if layout.end > len(self.data):
            raise FieldError(f"{self.reader.name}: a message ends too early")
        return start

    def _length(self) -> int:
        start = self._take(4)
        (length,) = struct.unpack_from(f"{self.order}I", self.data, start)
        self.layout.lengths.append((start, length))
        return int(length)

    def message(self, name: str, path: Path, depth: int) -> bool:
        """Pass a message; whether all wanted fields are found."""
        if depth > DEEPEST:
            raise FieldError(f"type {name}: more than {DEEPEST} types within each other")
        fields = self.reader._fields(name)
        if not fields:
            self._take(1)  # ROS 2 gives an empty message a byte
        return any(self._value(kind, (*path, each), depth) for each, kind in fields)

    def _value(self, kind: tuple[Any, Any], path: Path, depth: int) -> bool:
        number, detail = int(kind[0]), kind[1]
        if number == 1:
            return self._base(detail[0], path)
        if number == 2:
            return self.message(detail, path, depth + 1)
        inner, count = detail[0], detail[1] if number == 3 else self._length()
        if count > len(self.data):
            raise FieldError(f"{self.reader.name}: a sequence of {count} entries in {len(self.data)} bytes")
        base = int(inner[0]) == 1 and _CODES.get(inner[1][0])
        if base:
            size = struct.calcsize(base)
            start = self._take(size, count)
            for each in self.wanted:
                if each[:-1] == path and isinstance(each[-1], int) and each[-1] < count:
                    self.layout.places[each] = start + size * each[-1], base
            return self.layout.places.keys() == self.wanted
        return any(self._value(inner, (*path, index), depth + 1) for index in range(count))

    def _base(self, name: str, path: Path) -> bool:
        if name == "string":
            start = self.layout.end + (HEADER - self.layout.end) % 4
            self._take(1, self._length())
            if path in self.wanted:
                self.layout.places[path] = start, "s"
        elif name in _CODES:
            start = self._take(struct.calcsize(_CODES[name]))
            if path in self.wanted:
                self.layout.places[path] = start, _CODES[name]
        else:
            raise FieldError(f"{self.reader.name}: fields of type {name} are not read")
        return self.layout.places.keys() == self.wanted
