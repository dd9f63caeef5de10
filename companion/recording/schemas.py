"""Messages of a recording: protobuf on every channel.

Positions, log lines and the scene are Foxglove's own messages, which viewers display directly
(docs/field-notes.md 4). The fields of the others are the described values of their classes
(``companion.values.described``), with their numbers; a number once written never changes its
meaning. A ``Schema`` contains the complete ``FileDescriptorSet``, so that a recording can be
decoded with nothing but the file.

``FrameEncoder`` packs the most frequent message by hand; the bytes equal those of the generated
class (a test compares them).
"""

import functools
import struct
from typing import Any, Final, NamedTuple

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from companion.recording import fields
from companion.values import Frame

RESERVED: Final = "reserved"  # replaces a removed field
_FLEET: Final[dict[str, list[str]]] = {
    "SharedFrame": ["uint64 after_ns", "bytes raw"],
    "Shared": ["fixed64 first_ns", "repeated SharedFrame frame", "repeated RoundTrip trip",
               "fixed64 told_ns"],
    "Served": ["string uav", "double worth_db"],
    "Handing": ["string uav", "string to"],
    "Standing": ["string node", RESERVED, RESERVED, "repeated double place",
                 "optional double reach_m", "uint32 most", "repeated Served serves",
                 "repeated Handing handing"],
    "Offers": ["repeated Offer offer"],
    "Tracks": ["repeated Track track"],
}  # fmt: skip
"""Messages that nodes of a fleet exchange (docs/fleet.md); they are not recorded.

A field is "[repeated|optional] type name"; its number is its index in the list, so fields are only
ever appended.
"""

_TYPES: Final = {
    "fixed64": FieldDescriptorProto.TYPE_FIXED64,
    "sfixed64": FieldDescriptorProto.TYPE_SFIXED64,
    "uint64": FieldDescriptorProto.TYPE_UINT64,
    "uint32": FieldDescriptorProto.TYPE_UINT32,
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "string": FieldDescriptorProto.TYPE_STRING,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
    "bool": FieldDescriptorProto.TYPE_BOOL,
}


def message(name: str, value: Any) -> Any:
    """Return a described value as a protobuf message of this name."""
    return message_class(name)(**fields.values(name, value))


def encode(name: str, value: Any) -> bytes:
    """Return a described value as the bytes of a protobuf message of this name."""
    data: bytes = message(name, value).SerializeToString()
    return data


def _describe_field(into: DescriptorProto, number: int, declared: str) -> None:
    *label, kind, name = declared.split()
    field = into.field.add(name=name, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
    if kind in _TYPES:
        field.type = _TYPES[kind]
    else:
        field.type = FieldDescriptorProto.TYPE_MESSAGE
        field.type_name = f".companion.{kind}"
    if label == ["repeated"]:
        field.label = FieldDescriptorProto.LABEL_REPEATED
    elif label == ["optional"]:
        # proto3 distinguishes a missing value from 0 by a separate oneof for each such field.
        field.proto3_optional = True
        field.oneof_index = len(into.oneof_decl)
        into.oneof_decl.add(name=f"_{name}")


def _describe() -> FileDescriptorProto:
    file = FileDescriptorProto(
        name="companion/recording.proto", package="companion", syntax="proto3"
    )
    declared = {
        name: [(one.number, one.declared) for one in fields.fields(name)] for name in fields.CLASSES
    }
    declared |= {name: list(enumerate(listed, start=1)) for name, listed in _FLEET.items()}
    for name, numbered in declared.items():
        described = file.message_type.add(name=name)
        for number, text in numbered:
            if text == RESERVED:
                described.reserved_range.add(start=number, end=number + 1)
            else:
                _describe_field(described, number, text)
    return file


_POOL: Final = DescriptorPool()  # separate, so that names cannot clash with other protobuf users
_POOL.Add(_describe())


@functools.cache
def message_class(name: str) -> Any:
    """Return the class of a protobuf message of this program."""
    return GetMessageClass(_POOL.FindMessageTypeByName(f"companion.{name}"))


LocationFixMessage: Final[Any] = LocationFix
LogMessage: Final[Any] = Log
FrameTransformMessage: Final[Any] = FrameTransform
PointCloudMessage: Final[Any] = PointCloud
SceneEntityMessage: Final[Any] = SceneEntity
SceneUpdateMessage: Final[Any] = SceneUpdate


class Schema(NamedTuple):
    """Schema of a message type, as in MCAP: full name, serialised ``FileDescriptorSet``."""

    name: str
    descriptor_set: bytes


def _with_dependencies(message: Any) -> Schema:
    """Return the schema of a message class: its file and all imports, dependencies first."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(files.file.add())

    add(message.DESCRIPTOR.file)
    return Schema(message.DESCRIPTOR.full_name, files.SerializeToString())


@functools.cache
def schema(name: str) -> Schema:
    """Return the schema of a message of this program."""
    return _with_dependencies(message_class(name))


LOCATION_FIX: Final = _with_dependencies(LocationFixMessage)
LOG: Final = _with_dependencies(LogMessage)
FRAME_TRANSFORM: Final = _with_dependencies(FrameTransformMessage)
SCENE_UPDATE: Final = _with_dependencies(SceneUpdateMessage)
POINT_CLOUD: Final = _with_dependencies(PointCloudMessage)

FRAMES_TOPIC: Final = "/mavlink/frames"
TICKS_TOPIC: Final = "/ticks"
TOCKS_TOPIC: Final = "/tocks"
REJECTIONS_TOPIC: Final = "/rejections"
ROUND_TRIPS_TOPIC: Final = "/timesync"
DUTIES_TOPIC: Final = "/fleet/duty"
CLOCK_TOPIC: Final = "/clock"
OBSERVATIONS_TOPIC: Final = "/observations"
TRACKS_TOPIC: Final = "/tracks"
WEIGHTS_TOPIC: Final = "/beams/weights"
LOG_TOPIC: Final = "/log"
TF_TOPIC: Final = "/tf"
SCENE_TOPIC: Final = "/scene"

TOPICS: Final = {
    "Frame": FRAMES_TOPIC, "Tick": TICKS_TOPIC, "Tock": TOCKS_TOPIC,
    "Rejection": REJECTIONS_TOPIC, "RoundTrip": ROUND_TRIPS_TOPIC, "Duty": DUTIES_TOPIC,
    "ClockSet": CLOCK_TOPIC, "Observation": OBSERVATIONS_TOPIC, "Track": TRACKS_TOPIC,
    "Weights": WEIGHTS_TOPIC,
}  # fmt: skip
"""Topic of each message of this program that is recorded."""

# Tag bytes: field number << 3 | wire type (0 varint, 1 eight bytes, 2 length-delimited).
RAW_MAX: Final = 280
"""Largest frame in bytes: 10 header, 255 payload, 2 checksum, 13 signature."""
_TIME = struct.Struct("<BQ")
_T_NS, _LINK, _SYSID, _COMPID, _MSGID, _RAW, _DOUBT_NS = (
    0x09, 0x12, 0x18, 0x20, 0x28, 0x32, 0x38,
)  # fmt: skip


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(tag: int, value: int) -> bytes:
    return bytes([tag]) + _varint(value) if value else b""


_RAW_HEADS: Final = (b"", *(bytes((_RAW,)) + _varint(size) for size in range(1, RAW_MAX + 1)))
"""Tag and length that precede a frame's bytes, by their number; empty for no bytes."""


HEADS_MAX: Final = 10_000  # limit on cached heads of frames


class FrameEncoder:
    """Encoder of ``companion.Frame`` messages; caches the packed head of each (link, source, id).

    Hours of traffic contain only a few hundred distinct heads, so that for each frame only its time
    and its bytes are packed.
    """

    def __init__(self) -> None:
        self._heads: dict[tuple[str, tuple[int, int], int], bytes] = {}

    def encode(self, frame: Frame) -> bytes:
        """Return the message's bytes, equal to those of the generated class."""
        key = (frame.link, frame.source, frame.msgid)
        head = self._heads.get(key)
        if head is None:
            if len(self._heads) >= HEADS_MAX:  # only a cache: ids and links may be forged
                self._heads.clear()
            head = self._heads[key] = self._head(frame)
        t_ns, raw = frame.t_ns, frame.raw
        size = len(raw)
        length = _RAW_HEADS[size] if size <= RAW_MAX else bytes((_RAW,)) + _varint(size)
        time = _TIME.pack(_T_NS, t_ns) if t_ns else b""
        if frame.doubt_ns:
            return b"".join((time, head, length, raw, _number(_DOUBT_NS, frame.doubt_ns)))
        return b"".join((time, head, length, raw))

    @staticmethod
    def _head(frame: Frame) -> bytes:
        link = frame.link.encode()
        return (
            (bytes([_LINK]) + _varint(len(link)) + link if link else b"")
            + _number(_SYSID, frame.source.sysid)
            + _number(_COMPID, frame.source.compid)
            + _number(_MSGID, frame.msgid)
        )
