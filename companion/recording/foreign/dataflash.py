"""Parser of ArduPilot's DataFlash log: bytes to columns, skipping damage.

A message is A3 95, its type, and a body whose length and fields are described by an FMT message
(type 128) of that type (https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html,
AP_Logger/LogStructure.h). There is no checksum: a message counts only if another one, or the end of
the file, follows directly, so that lost bytes cost only the message around them.

The first two bytes of messages are searched in the whole file at once; then each message leads to
the next. Fields are read in place, for the requested messages only.
"""

import re
from array import array
from collections.abc import Collection, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.recording.foreign.columns import Bytes, Columns
from companion.recording.foreign.thinned import Thinned
from companion.values import IntArray

MAGIC: Final = b"\xa3\x95"
FORMAT: Final = 128
_HEAD: Final = 3
_FORMAT_LENGTH: Final = 89
_LONGEST: Final = 256
_BLOCK: Final = 1 << 22
_TYPES: Final = {
    "a": ("<i2", 32), "b": ("i1", 0), "B": ("u1", 0), "h": ("<i2", 0), "H": ("<u2", 0),
    "i": ("<i4", 0), "I": ("<u4", 0), "f": ("<f4", 0), "d": ("<f8", 0), "n": ("S4", 0),
    "N": ("S16", 0), "Z": ("S64", 0), "c": ("<i2", 0), "C": ("<u2", 0), "e": ("<i4", 0),
    "E": ("<u4", 0), "L": ("<i4", 0), "M": ("u1", 0), "q": ("<i8", 0), "Q": ("<u8", 0),
    "g": ("<f2", 0),
}  # fmt: skip
_HUNDREDTHS: Final = frozenset("cCeE")
_NAME: Final = re.compile(rb"[A-Z0-9_]{1,4}\0*\Z")
_formats = re.compile(re.escape(MAGIC + bytes([FORMAT]))).finditer


class Format(NamedTuple):
    """Layout of one type of DataFlash message: its fields, and which are in hundredths."""

    name: str
    length: int
    fields: np.dtype[np.void]
    hundredths: frozenset[str]


class DataflashIndex(NamedTuple):
    """Index of the messages in a DataFlash log.

    formats  by type
    at       offsets of the messages of each wanted type, in the order of the file; of very many
             only every n-th
    lost     bytes outside of messages
    refused  invalid descriptions of messages: inconsistent length, or repeated with a difference
    rest     bytes of a message in which the file ends
    """

    formats: dict[int, Format]
    at: dict[int, IntArray]
    lost: int
    refused: int
    rest: int


class DataflashTable(Columns):
    """Messages of one type in a DataFlash log, as columns; empty if the log has none."""

    def __init__(self, data: Bytes, layout: Format | None, at: IntArray) -> None:
        super().__init__(data, None if layout is None else layout.fields, at + _HEAD)
        self._layout = layout

    def numbers(self, column: str) -> NDArray[np.float64]:
        """Return a column as numbers, (N,), in the units of the log; NaN if missing."""
        found = self.values(column, "iuf")
        if found is None or self._layout is None:
            return np.full(len(self), np.nan)
        values = found.astype(np.float64)
        return values / 100.0 if column in self._layout.hundredths else values


def walk(data: Bytes, wanted: Collection[str]) -> DataflashIndex:
    """Index the messages of a log, with the offsets of those named in ``wanted``.

    If several types have one name, the first counts.
    """
    formats, refused = _describe(data)
    first = {layout.name: number for number, layout in reversed(formats.items())}
    lengths = np.zeros(256, dtype=np.int64)
    asked = np.zeros(256, dtype=bool)
    for number, layout in formats.items():
        lengths[number] = layout.length
        asked[number] = layout.name in wanted and first[layout.name] == number
    found = {n: Thinned(array("q")) for n in formats if asked[n]}
    covered = end = 0
    for at, types in _chains(data, lengths):
        covered += int(lengths[types].sum())
        if len(at):
            end = int(at[-1] + lengths[types[-1]])
        for number in np.unique(types[asked[types]]).tolist():
            found[number].extend(at[types == number].tolist())
    places = {number: np.array(each.kept, dtype=np.int64) for number, each in found.items()}
    is_message = bytes(data[end : end + 2]) == MAGIC[: data.size - end]
    return DataflashIndex(
        formats=formats,
        at=places,
        lost=data.size - covered,
        refused=refused,
        rest=data.size - end if is_message else 0,
    )


def table(data: Bytes, walked: DataflashIndex, name: str) -> DataflashTable:
    """Return the messages of one name in a DataFlash log."""
    for number, layout in walked.formats.items():
        if layout.name == name and number in walked.at:
            return DataflashTable(data, layout, walked.at[number])
    return DataflashTable(data, None, np.zeros(0, dtype=np.int64))


# --- descriptions ---------------------------------------------------------------------------------


def _describe(data: Bytes) -> tuple[dict[int, Format], int]:
    """Return the message layouts in a log by type, and the number of rejected descriptions.

    The first description of a type counts, as its messages were written with it.
    """
    whole = memoryview(data.data)
    found: dict[int, Format] = {FORMAT: _OWN}
    refused = 0
    for match in _formats(whole):
        body = bytes(whole[match.start() + _HEAD : match.start() + _FORMAT_LENGTH])
        if len(body) < _FORMAT_LENGTH - _HEAD or not _NAME.match(body[2:6]):
            continue  # these bytes are inside another message
        layout = _format(body)
        if layout is None or found.setdefault(body[0], layout) != layout:
            refused += 1
    return found, refused


def _format(body: bytes) -> Format | None:
    """Return the message layout in the body of an FMT message; None if inconsistent."""
    length, name = body[1], body[2:6].rstrip(b"\0").decode("ascii")
    letters = body[6:22].rstrip(b"\0").decode("latin-1")
    columns = body[22:86].rstrip(b"\0").decode("latin-1").split(",")
    columns = columns[: len(letters)]
    if not set(letters) <= set(_TYPES) or len(columns) != len(letters):
        return None
    if len(set(columns)) != len(columns) or not all(columns):
        return None
    described: list[tuple[str, str, tuple[int, ...]]] = []
    for column, letter in zip(columns, letters, strict=True):
        kind, count = _TYPES[letter]
        described.append((column, kind, (count,) if count else ()))
    fields = np.dtype(described)
    if fields.itemsize != length - _HEAD:
        return None
    hundredths = (
        column for column, each in zip(columns, letters, strict=True) if each in _HUNDREDTHS
    )
    return Format(name=name, length=length, fields=fields, hundredths=frozenset(hundredths))


_OWN: Final = Format(
    name="FMT",
    length=_FORMAT_LENGTH,
    fields=np.dtype(
        [("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")]
    ),
    hundredths=frozenset(),
)


# --- offsets of messages --------------------------------------------------------------------------


def _chains(data: Bytes, lengths: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the offsets of messages, and the types of the messages, by block of the file."""
    resume = 0
    for begin in range(0, data.size, _BLOCK):
        at, types = _candidate_headers(data, begin, min(begin + _BLOCK, data.size), lengths)
        inside = at >= resume
        at, types = at[inside], types[inside]
        chosen = _chained(at, at + lengths[types])
        if len(chosen):
            resume = int(at[chosen[-1]] + lengths[types[chosen[-1]]])
        yield at[chosen], types[chosen]


def _candidate_headers(
    data: Bytes, begin: int, end: int, lengths: IntArray
) -> tuple[IntArray, IntArray]:
    """Return offsets in [begin, end) of messages that another one, or the end, follows."""
    ahead = data[begin : end + 2 * _LONGEST + _HEAD]
    if ahead.size < _HEAD:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    looks = (ahead[:-2] == MAGIC[0]) & (ahead[1:-1] == MAGIC[1])
    looks[looks] = lengths[ahead[2:][looks]] > 0
    (at,) = np.nonzero(looks)
    at = at[at < end - begin]
    types = ahead[at + 2].astype(np.int64)
    behind = at + lengths[types]
    goes_on = np.zeros(len(at), dtype=bool)
    inside = behind < len(looks)
    goes_on[inside] = looks[behind[inside]]
    goes_on |= begin + behind == data.size
    return at[goes_on] + begin, types[goes_on]


def _chained(at: IntArray, behind: IntArray) -> IntArray:
    """Return the rows of a block that are reached from the first by following each message.

    The next row is nearly always the next message; it is searched only if not.
    """
    if not len(at):
        return np.zeros(0, dtype=np.int64)
    breaks = np.flatnonzero(at[1:] != behind[:-1])
    parts, row = [], 0
    while row < len(at):
        nearest = int(np.searchsorted(breaks, row))
        last = int(breaks[nearest]) if nearest < len(breaks) else len(at) - 1
        parts.append(np.arange(row, last + 1))
        row = int(np.searchsorted(at, behind[last]))
    return np.concatenate(parts)
