"""Parser of PX4's ULog: bytes to columns, skipping damage.

A file is a header of 16 bytes and then messages: size, type, body (https://docs.px4.io/main/en/
dev_log/ulog_file_format.html). Topics are described by F, named by A, and sampled by D. There is no
checksum: invalid bytes are skipped up to three consecutive valid messages.
"""

import re
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from companion.recording.foreign.columns import Bytes, Columns
from companion.recording.foreign.thinned import Thinned
from companion.values import FloatArray

MAGIC: Final = b"ULog\x01\x12\x35"
_HEADER: Final = 16
_MESSAGE: Final = struct.Struct("<HB")
_FLAGS: Final = struct.Struct("<8s8s3Q")
_TYPES: Final = {
    "int8_t": "i1", "uint8_t": "u1", "bool": "u1", "char": "S1", "int16_t": "<i2",
    "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4", "int64_t": "<i8", "uint64_t": "<u8",
    "float": "<f4", "double": "<f8",
}  # fmt: skip
_FIELD: Final = re.compile(r"(\w+)(?:\[(\d{1,5})\])? (\w+)\Z")
_KNOWN: Final = frozenset(b"BFIMPQARDLCSO")
_LEAST: Final = {ord("B"): 40, ord("A"): 4, ord("R"): 2, ord("D"): 2, ord("S"): 8, ord("O"): 2}
_DATA: Final = ord("D")
_SUBSCRIBED: Final = ord("A")
_FORMAT: Final = ord("F")
_PARAMETER: Final = ord("P")
_FLAG_BITS: Final = ord("B")
_DROPOUT: Final = ord("O")
_LONGEST: Final = 65535
_NESTED_MAX: Final = 8
_FORMATS_BYTES: Final = 1 << 24
"""Limit on all descriptions of topics, in which each has ``_ENTRY`` bytes more than its text.

PX4 writes some 200, of 100 kB in all.
"""
_ENTRY: Final = 256
_PARAMETERS_MAX: Final = 20_000  # PX4 has some 2000
_INSTANCES_MAX: Final = 4
"""Limit on the subscriptions of one topic whose samples are indexed, as the lowest is used."""
_IN_A_ROW: Final = 3
_APPENDED: Final = 0x01
_candidates = re.compile(rb"(?=[\s\S]{2}[BFIMPQARDLCSO])").finditer


class UlogTopic(NamedTuple):
    """Instance of a ULog topic: its fields, and the offsets of its samples.

    Of very many samples only every n-th is kept.
    """

    name: str
    instance: int
    fields: np.dtype[np.void]
    at: "array[int]"
    samples: Thinned[int]


@dataclass(slots=True, kw_only=True)
class UlogIndex:
    """Index of the samples in a ULog."""

    topics: list[UlogTopic] = field(default_factory=list)  # wanted topics
    parameters: dict[str, float] = field(default_factory=dict)  # values at the start
    lost: int = 0  # bytes outside of messages
    rest: int = 0  # those at the end of the file
    refused: int = 0  # inconsistent descriptions and samples
    dropouts: int = 0  # number of dropouts of the logger itself
    unknown: bool = False  # whether the file has unknown incompatibility flags


class UlogTable(Columns):
    """Samples of a ULog topic, as columns; empty if the log has none."""

    def __init__(self, data: Bytes, topic: UlogTopic | None) -> None:
        at = np.array([] if topic is None else topic.at, dtype=np.int64)
        super().__init__(data, None if topic is None else topic.fields, at)

    def numbers(self, column: str, width: int = 1) -> FloatArray:
        """Return a column as numbers: (N,), or (N, ``width``) for an array; NaN if missing."""
        values = self.values(column, "iuf", width)
        if values is None:
            return np.full((len(self),) if width == 1 else (len(self), width), np.nan)
        return values.astype(np.float64)


def table(data: Bytes, walked: UlogIndex, *names: str) -> UlogTable:
    """Return the samples of the first of some topics that the log has, from its lowest instance."""
    for name in names:
        there = [topic for topic in walked.topics if topic.name == name and len(topic.at)]
        if there:
            return UlogTable(data, min(there, key=lambda topic: topic.instance))
    return UlogTable(data, None)


def walk(data: Bytes, wanted: Collection[str]) -> UlogIndex:
    """Index the samples of the wanted topics, and the parameters."""
    return _Walker(data, wanted).walk()


class _Walker:
    """Single pass over a ULog file."""

    def __init__(self, data: Bytes, wanted: Collection[str]) -> None:
        self._data = memoryview(data.data)
        self._wanted = wanted
        self._found = UlogIndex()
        self._formats: dict[str, str] = {}
        self._formats_bytes = 0
        self._sizes_by_name: dict[str, tuple[int, int]] = {}
        self._topics: dict[int, UlogTopic | None] = {}
        self._indexed: Counter[str] = Counter()  # subscriptions of each topic
        self._sizes: dict[int, tuple[int, int]] = {}

    def walk(self) -> UlogIndex:
        begin = _HEADER
        for end in (*self._parts(), len(self._data)):
            if end > begin:
                self._stretch(begin, end)
                begin = end
        self._found.topics = [topic for topic in self._topics.values() if topic is not None]
        return self._found

    def _parts(self) -> Iterator[int]:
        """Yield the offsets of data that were appended to a truncated file (after a crash)."""
        head = self._data[_HEADER : _HEADER + _MESSAGE.size + _FLAGS.size]
        if len(head) < _MESSAGE.size + _FLAGS.size or head[2] != _FLAG_BITS:
            return
        _, needed, *offsets = _FLAGS.unpack_from(head, _MESSAGE.size)
        self._found.unknown = needed[0] > _APPENDED or any(needed[1:])
        if needed[0] & _APPENDED:
            yield from sorted(at for at in offsets if _HEADER < at < len(self._data))

    def _stretch(self, at: int, end: int) -> None:
        """Process the messages in [at, end); skip and count invalid bytes."""
        data, unpack = self._data, _MESSAGE.unpack_from
        while at + 3 <= end:
            size, kind = unpack(data, at)
            stop = at + 3 + size
            if kind == _DATA and stop <= end and size >= 2:
                number = data[at + 3] | data[at + 4] << 8
                sizes = self._sizes.get(number)
                if sizes is not None and sizes[0] <= size <= sizes[1]:
                    topic = self._topics[number]
                    if topic is not None:
                        topic.samples.add(at + 5)
                    at = stop
                    continue
            elif self._fits(at, end) and kind != _DATA:
                self._take(kind, bytes(data[at + 3 : stop]))
                at = stop
                continue
            resume = self._resume(at + 1, end)
            self._found.lost += resume - at
            self._found.rest = resume - at if resume == end else 0
            at = resume
        self._found.lost += end - at
        self._found.rest = end - at or self._found.rest

    def _fits(self, at: int, end: int) -> int:
        """Return the end of a message at ``at``, if a message there is plausible; else 0."""
        if at + 3 > end:
            return 0
        size, kind = _MESSAGE.unpack_from(self._data, at)
        stop = at + 3 + size
        if kind not in _KNOWN or stop > end or size < _LEAST.get(kind, 1):
            return 0
        if kind == _DATA:
            sizes = self._sizes.get(self._data[at + 3] | self._data[at + 4] << 8)
            if sizes is None or not sizes[0] <= size <= sizes[1]:
                return 0
        return int(stop)

    def _resume(self, at: int, end: int) -> int:
        """Return the first offset from ``at`` on of consecutive valid messages; ``end`` if none."""
        for match in _candidates(self._data, at, end):
            start = stop = match.start()
            for _ in range(_IN_A_ROW):
                stop = self._fits(stop, end) if stop < end else stop
                if not stop:
                    break
            else:
                return start
        return end

    # --- messages -------------------------------------------------------------------------------

    def _take(self, kind: int, body: bytes) -> None:
        if kind == _FORMAT:
            name, colon, fields = body.decode("latin-1").partition(":")
            if colon:
                self._found.refused += self._described(name, fields) != fields
        elif kind == _SUBSCRIBED:
            self._subscribe(body[0], body[1] | body[2] << 8, body[3:].decode("latin-1"))
        elif kind == _PARAMETER:
            self._parameter(body)
        elif kind == _DROPOUT:
            self._found.dropouts += 1

    def _described(self, name: str, fields: str) -> str | None:
        """Store a topic's fields; return those that count, which are the first."""
        if name not in self._formats:
            self._formats_bytes += len(name) + len(fields) + _ENTRY
            if self._formats_bytes <= _FORMATS_BYTES:
                self._formats[name] = fields
        return self._formats.get(name)

    def _subscribe(self, instance: int, number: int, name: str) -> None:
        if number in self._topics:
            return  # the first counts: its samples were parsed with it
        least, most = self._size(name, 0)
        if least == 0:
            self._found.refused += 1
            return
        self._sizes[number] = least + 2, most + 2
        layout = None
        if name in self._wanted and self._indexed[name] < _INSTANCES_MAX:
            layout = _layout(self._formats[name])
            self._found.refused += layout is None
            self._indexed[name] += 1
        at = array("q")
        topic = (
            None
            if layout is None
            else UlogTopic(name=name, instance=instance, fields=layout, at=at, samples=Thinned(at))
        )
        self._topics[number] = topic

    def _size(self, name: str, depth: int) -> tuple[int, int]:
        """Return a topic's least size (without final padding) and largest size; 0 if unknown.

        Each is computed once, however often it is nested in others or subscribed.
        """
        fields = self._formats.get(name)
        if fields is None or depth > _NESTED_MAX:
            return 0, 0
        if name not in self._sizes_by_name:
            self._sizes_by_name[name] = self._sum(fields, depth)
        return self._sizes_by_name[name]

    def _sum(self, fields: str, depth: int) -> tuple[int, int]:
        least = most = 0
        for each in filter(None, fields.split(";")):
            match = _FIELD.match(each)
            if match is None or most > _LONGEST:
                return 0, 0
            kind, count, called = match.groups()
            one = (
                np.dtype(_TYPES[kind]).itemsize
                if kind in _TYPES
                else self._size(kind, depth + 1)[1]
            )
            size = one * int(count or 1)
            if not size:
                return 0, 0
            most += size
            if not called.startswith("_padding"):
                least = most
        return (least, most) if most <= _LONGEST else (0, 0)

    def _parameter(self, body: bytes) -> None:
        kind, blank, name = body[1 : 1 + body[0]].decode("latin-1").partition(" ")
        value = body[1 + body[0] :]
        if len(self._found.parameters) >= _PARAMETERS_MAX:
            return
        if blank and kind in ("int32_t", "float") and len(value) == 4:
            (number,) = struct.unpack("<i" if kind == "int32_t" else "<f", value)
            self._found.parameters.setdefault(name, float(number))


def _layout(fields: str) -> np.dtype[np.void] | None:
    """Return a topic's fields up to the final padding; None for nested or repeated fields."""
    described: list[tuple[str, str, tuple[int, ...]]] = []
    kept = 0
    for each in filter(None, fields.split(";")):
        match = _FIELD.match(each)
        if match is None or match.group(1) not in _TYPES:
            return None
        kind, count, called = match.groups()
        described.append((called, _TYPES[kind], (int(count),) if count else ()))
        if not called.startswith("_padding"):
            kept = len(described)
    described = described[:kept]
    if not described or len({called for called, *_ in described}) != len(described):
        return None
    return np.dtype(described)
