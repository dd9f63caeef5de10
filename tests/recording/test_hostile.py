"""Hostile recordings: bounded memory and time, and a one-line error for the user."""

import os
import random
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.records import Attachment, Metadata
from observed import wrong
from support import HANG_S

from companion.recording import schemas
from companion.recording.container import LARGEST, MAGIC, Damage, Message, Walk
from companion.recording.mcap_file import McapFile
from companion.recording.parts import EVENTS_MAX, HOLE, HOLES_MAX, Hole, Part, read_recording_info
from companion.recording.reader import LogError, read_log, read_settings, utc_offset_ns
from companion.recording.recover import Recovered, recover, recover_leftovers
from companion.recording.writer import Writer
from companion.values import Event, Frame, Source, Tick

MOST_MB = 300
"""Memory in which any file is read, the program's own 70 MB included."""
ATTACHMENT, CHUNK, METADATA = 9, 6, 12
FRAME = bytes([0xFE, 0, 0, 1, 1, 0, 0, 0])


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def chunk(compression: bytes, packed: bytes, size: int, checksum: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, checksum) + text(compression)
    return record(CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def described(topic: bytes = schemas.FRAMES_TOPIC.encode()) -> bytes:
    """A schema and a channel, both with id 1."""
    schema = struct.pack("<H", 1) + text(b"companion.Frame") + text(b"protobuf") + text(b"")
    channel = struct.pack("<HH", 1, 1) + text(topic) + text(b"protobuf") + text(b"")
    return record(3, schema) + record(4, channel)


def message(data: bytes, t_ns: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, t_ns, t_ns) + data)


def zeros_zstd(size: int, claims: int | None = None) -> bytes:
    """A zstd frame of ``size`` zeros in blocks that repeat one byte: 4 bytes for 128 kB."""
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", size if claims is None else claims)
    while size > 0:
        block = min(size, 1 << 17)
        size -= block
        frame += ((block << 3) | 2 | (size == 0)).to_bytes(3, "little") + b"\0"
    return frame


def no_frame(raw: bytes, t_ns: int = 1) -> bytes:
    return schemas.message_class("Frame")(t_ns=t_ns, sysid=1, compid=1, raw=raw).SerializeToString()


# --- unfinished files ---------------------------------------------------------------------------


def leftovers() -> dict[str, bytes]:
    torn_lz4 = MAGIC + chunk(b"lz4", b"\x04\x22\x4d\x18" + b"x" * 20, 100)
    return {
        "lz4": torn_lz4,
        "zstd": MAGIC + chunk(b"zstd", b"\x28\xb5\x2f\xfd" + b"x" * 20, 100),
        "no-compression": MAGIC + chunk(b"snappy", b"x", 1),
        "attachment": MAGIC + record(ATTACHMENT, b"\0" * 16 + text(b"a") * 2 + b"\xff" * 20),
        "metadata": MAGIC + record(METADATA, text(b"\xff") + text(b"")),
        "no-schema": MAGIC + record(4, struct.pack("<HH", 1, 0) + text(b"/a") + text(b"") * 2)
        + message(b"x"),
        "text": b"hello",
        "nested": MAGIC + chunk(b"", record(CHUNK, b"x") + b"\x05", 11),
    }  # fmt: skip


@pytest.mark.parametrize("name", leftovers())
def test_unfinished_file_is_recovered_or_set_aside_once(tmp_path: Path, name: str) -> None:
    leftover = tmp_path / "x.mcap.active"
    leftover.write_bytes(leftovers()[name])
    (found,) = recover_leftovers(tmp_path)
    assert isinstance(found, Recovered | LogError)
    assert not leftover.exists()
    assert len(list(tmp_path.iterdir())) == 1  # finished, or unchanged under another name
    assert recover_leftovers(tmp_path) == []
    if isinstance(found, LogError):
        assert (tmp_path / "x.mcap.damaged").read_bytes() == leftovers()[name]
        assert str(found).endswith("; kept as x.mcap.damaged")


def test_unfinished_file_with_unexpected_error_is_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(_: object) -> None:
        raise RuntimeError("out of all order")

    for number in range(2):
        (tmp_path / f"{number}.mcap.active").write_bytes(MAGIC)
    (tmp_path / "0.mcap.damaged").write_bytes(b"older")
    monkeypatch.setattr("companion.recording.recover._Copy.run", explode)
    told = recover_leftovers(tmp_path)
    assert [str(one).split(": ", 1)[1] for one in told] == [
        "RuntimeError: out of all order; kept as 0.mcap-1.damaged",
        "RuntimeError: out of all order; kept as 1.mcap.damaged",
    ]
    assert (tmp_path / "0.mcap.damaged").read_bytes() == b"older"


def test_unfinished_entry_that_is_not_a_file_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.mcap.active")
    (found,) = recover_leftovers(tmp_path)
    assert "not a file" in str(found)
    with pytest.raises(LogError, match="not a file"):
        read_log(tmp_path / "x.mcap.damaged")
    with pytest.raises(LogError, match="not a file"):
        read_log(Path("/dev/zero"))


@pytest.mark.full
def test_random_damage_raises_only_log_errors(
    tmp_path: Path, events: Callable[[int], list[Event]]
) -> None:
    """Bytes changed, removed and duplicated, and lengths enlarged, 3000 times."""
    _damaged_at_random(tmp_path, events, range(3000))


def test_random_damage_sample_raises_only_log_errors(
    tmp_path: Path, events: Callable[[int], list[Event]]
) -> None:
    _damaged_at_random(tmp_path, events, range(100_000, 100_150))


def _damaged_at_random(tmp_path: Path, events: Callable[[int], list[Event]], seeds: range) -> None:
    with Writer(
        where=tmp_path / "whole.mcap",
        settings_toml="[a]\n",
        versions={"v": "1"},
        weights_hz=None,
        started_ns=0,
    ) as writer:
        for number, event in enumerate(events(60)):
            writer.event(event)
            if number % 20 == 0:
                writer.flush()
        whole = writer.close({"digest": "d"}).read_bytes()
    folder = tmp_path / "leftovers"
    folder.mkdir()
    for seed in seeds:
        (folder / "x.mcap.active").write_bytes(damaged(whole, random.Random(seed)))
        for read in (read_log, read_settings, read_recording_info):
            try:
                found = read(folder / "x.mcap.active")
                if read is read_log:
                    assert all(event.t_ns >= 0 for event in found)
            except (LogError, ValueError) as error:
                assert isinstance(error, LogError) or read is read_recording_info, (seed, error)
        (told,) = recover_leftovers(folder)
        if isinstance(told, LogError):
            assert "no message can be recovered; kept as x.mcap.damaged" in str(told), (seed, told)
            (folder / "x.mcap.damaged").unlink()
        else:
            told.path.unlink()


def damaged(whole: bytes, rng: random.Random) -> bytes:
    data = bytearray(whole)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(MAGIC), len(data) - 8)
        match rng.randrange(5):
            case 0:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at : at + 8] = struct.pack("<Q", rng.choice((0, 1, 2**31, 2**63, 2**64 - 1)))
            case 2:
                del data[at : at + rng.randint(1, 40)]
            case 3:
                data[at:at] = data[at : at + rng.randint(1, 400)]
            case 4:
                data[at : at + 4] = struct.pack("<I", rng.choice((0, 2**31, 2**32 - 1)))
    return bytes(data)


# --- bounded memory ------------------------------------------------------------------------------


def bombs(folder: Path) -> list[Path]:
    """Files that would expand to gigabytes."""
    made = {
        # 131 kB whose frame holds 4.2 GB; the chunk header omits the size or states it.
        "frame": MAGIC + chunk(b"zstd", zeros_zstd(4_200_000_000), 1000),
        "both": MAGIC + chunk(b"zstd", zeros_zstd(4_200_000_000), 4_200_000_000),
        "claim": MAGIC + chunk(b"zstd", zeros_zstd(1000, 2**62), 2**62),
        "many": MAGIC + chunk(b"zstd", zeros_zstd(LARGEST), LARGEST) * 400,
        "unsized": MAGIC
        + chunk(b"zstd", zstandard.ZstdCompressor(write_content_size=False).compress(b"x"), 2**40),
        "tiny": MAGIC + _packed(described() + message(no_frame(FRAME)) * 500_000),
        "descriptions": MAGIC + b"".join(_packed(_schema(number)) for number in range(1, 60)),
        "holes": MAGIC + record(METADATA, _hole()) * 300_000,
        "channels": MAGIC + described() + b"".join(_channel(number) for number in range(1, 65_000)),
        "channel-pairs": MAGIC + _packed(_channel(1, _pairs(2_300_000))),
        "metadata-pairs": MAGIC + _metadata(_pairs(1_000_000)),
        "metadata": MAGIC + _metadata(b"") * 1_000_000,
        "attachments": MAGIC + record(ATTACHMENT, _attachment()) * 400_000,
    }  # fmt: skip
    paths = []
    for name, data in made.items():
        (folder / f"{name}.mcap").write_bytes(data)
        paths.append(folder / f"{name}.mcap")
    for name, opcode in (("sparse-attachment", ATTACHMENT), ("sparse-chunk", CHUNK), ("sparse", 0)):
        path = folder / f"{name}.mcap"
        with path.open("wb") as file:
            file.write((MAGIC + struct.pack("<BQ", opcode, 8 << 30)) if opcode else b"\xfe\0\0\0")
            file.truncate((8 << 30) + 100)
        paths.append(path)
    return paths


def _packed(contents: bytes) -> bytes:
    packed = zstandard.ZstdCompressor().compress(contents)
    return chunk(b"zstd", packed, len(contents), zlib.crc32(contents))


def _schema(number: int) -> bytes:
    body = struct.pack("<H", number) + text(b"x") + text(b"protobuf") + text(bytes(20_000_000))
    return record(3, body)


def _channel(number: int, pairs: bytes = b"") -> bytes:
    head = struct.pack("<HH", number, 0) + text(b"/mavlink/%d" % number) + text(b"")
    return record(4, head + text(pairs)) + record(5, struct.pack("<HIQQ", number, 0, 1, 1))


def _pairs(count: int) -> bytes:
    return b"".join(text(b"%06x" % number) + text(b"") for number in range(count))


def _metadata(pairs: bytes) -> bytes:
    return record(METADATA, text(b"part") + text(pairs))


def _attachment() -> bytes:
    body = bytes(16) + text(b"a") + text(b"b") + bytes(8)
    return body + struct.pack("<I", zlib.crc32(body))


def _hole() -> bytes:
    pairs = {b"t_ns": b"5", b"events": b"2", b"why": b"x" * 50}
    return text(HOLE.encode()) + text(b"".join(text(k) + text(v) for k, v in pairs.items()))


QUICK = frozenset(("frame", "both", "claim", "unsized", "sparse-attachment", "sparse-chunk"))
SLOW = frozenset(("many", "tiny", "descriptions", "holes", "channels", "sparse"))
PAIRS = frozenset(("channel-pairs", "metadata-pairs", "metadata", "attachments"))
_READ_ALL = r"""
import re, sys
from pathlib import Path
from companion.recording.parts import read_recording_info
from companion.recording.reader import LogError, read_log, read_settings
from companion.recording.recover import recover
for path in map(Path, sys.argv[1:]):
    for work in (read_settings, read_recording_info, lambda p: len(list(read_log(p))), recover):
        try:
            work(path)
        except LogError as error:
            assert "\\n" not in str(error)
    peak_kb = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]
    print(path.name, int(peak_kb) // 1000, flush=True)
"""


@pytest.mark.parametrize(
    "names", [QUICK, *(pytest.param(names, marks=pytest.mark.full) for names in (SLOW, PAIRS))]
)
def test_decompression_bombs_are_read_in_bounded_memory(
    tmp_path: Path, names: frozenset[str]
) -> None:
    """Time is bounded too: each file is read, described and recovered within ``HANG_S``."""
    wanted = [path for path in bombs(tmp_path) if path.stem in names]
    command = [sys.executable, "-c", _READ_ALL, *map(str, wanted)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)
    assert done.returncode == 0, done.stderr
    peaks_mb = {name: int(peak) for name, peak in map(str.split, done.stdout.splitlines())}
    assert len(peaks_mb) == len(names) == len(wanted)
    assert max(peaks_mb.values()) < MOST_MB, peaks_mb


def test_too_many_metadata_pairs_are_damage(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    kept = _metadata(_pairs(3))
    for wide in (_metadata(_pairs(9000)), _packed(_channel(1, _pairs(9000)))):
        path.write_bytes(MAGIC + wide + kept)
        damage, found = Walk(path)
        assert isinstance(damage, Damage)
        assert isinstance(found, Metadata)
        assert len(found.metadata) == 3


def test_metadata_pairs_of_all_channels_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    pairs = _pairs(4000)
    path.write_bytes(MAGIC + b"".join(_packed(_channel(number, pairs)) for number in range(1, 60)))
    walk = Walk(path)
    found = [isinstance(content, Damage) for content in walk]
    assert found == sorted(found)  # beyond the limit, reading stops
    assert 20 < len(walk.channels) < 40
    assert sum(len(channel.metadata) for channel in walk.channels.values()) < 140_000


@pytest.mark.parametrize("each", [_metadata(b""), record(ATTACHMENT, _attachment())])
def test_records_beyond_the_limit_per_kind_are_discarded(tmp_path: Path, each: bytes) -> None:
    torn = tmp_path / "x.mcap.active"
    torn.write_bytes(MAGIC + each * 10_100 + described() + message(no_frame(FRAME)))
    found = recover(torn)
    assert found.lost_bytes == 100 * len(each)
    assert found.messages == {schemas.FRAMES_TOPIC: 1}
    assert sum(isinstance(one, Attachment | Metadata) for one in Walk(found.path)) == 10_000


def test_recording_with_too_many_channels_is_set_aside(tmp_path: Path) -> None:
    torn = tmp_path / "x.mcap.active"
    torn.write_bytes(MAGIC + _packed(b"".join(_channel(number) for number in range(1 << 16))))
    (told,) = recover_leftovers(tmp_path)
    said = "more than 65535 channels; kept as x.mcap.damaged"
    assert str(told) == f"{torn}: {said}"
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap.damaged"]


def test_messages_are_read_lazily(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + _packed(described() + message(b"") * 10_000 + b"\x05"))
    walk = iter(Walk(path))
    assert isinstance(next(walk), Message)
    rest = list(walk)
    assert len(rest) == 10_000  # all messages, then the damage after them
    assert isinstance(rest[-1], Damage)


# --- intact and malformed contents --------------------------------------------------------------


@pytest.mark.parametrize(
    "raw",
    [b"", b"\xfe", b"\xfd" + bytes(10), FRAME + b"\0", b"\xfd\xff" + bytes(12), b"\0" * 20],
    ids=["empty", "magic", "short", "long", "cut", "none"],
)
def test_malformed_frame_is_rejected(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + _packed(described() + message(no_frame(raw))))
    with pytest.raises(LogError, match="not a recording of this program: malformed frame"):
        list(read_log(path))


def test_event_time_out_of_range_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + _packed(described() + message(no_frame(FRAME, 2**63))))
    with pytest.raises(LogError, match="event time out of range"):
        list(read_log(path))


@pytest.mark.parametrize(
    ("topic", "data", "said"),
    [
        (
            schemas.ROUND_TRIPS_TOPIC,
            schemas.message_class("RoundTrip")(
                t_ns=1, sysid=1, compid=2**32 - 1
            ).SerializeToString(),
            "round trip with an invalid source",
        ),
        (
            schemas.DUTIES_TOPIC,
            schemas.message_class("Duty")(t_ns=1, serves=["1:1"] * 10_001).SerializeToString(),
            "duty of more than 10000 UAVs",
        ),
        (
            schemas.DUTIES_TOPIC,
            schemas.message_class("Duty")(t_ns=1, serves=["1"] * 1_000_000).SerializeToString(),
            "event is longer than 2097152 bytes",
        ),
        (
            schemas.OBSERVATIONS_TOPIC,
            schemas.encode("Observation", wrong("azimuth NaN")),
            "invalid observation: azimuth: is not within -180 and 180 degrees",
        ),
        (
            schemas.OBSERVATIONS_TOPIC,
            schemas.message_class("Observation")(
                t_ns=1, uav="1:1", beams=range(300_000)
            ).SerializeToString(),
            "invalid observation: beams: 300000 beams and 0 powers",
        ),
        (schemas.OBSERVATIONS_TOPIC, b"", "invalid observation: uav: '' is not SYSID:COMPID"),
        (schemas.FRAMES_TOPIC, no_frame(FRAME) * 200_000, "event is longer than 2097152 bytes"),
        (
            schemas.FRAMES_TOPIC,
            schemas.message_class("Frame")(t_ns=1, link="x" * 501, raw=FRAME).SerializeToString(),
            "malformed frame",
        ),
        *(
            (
                schemas.REJECTIONS_TOPIC,
                schemas.message_class("Rejection")(
                    t_ns=1, reason="garbage", is_event=True, **{field: "x" * 501}
                ).SerializeToString(),
                "rejection: source or detail has more than 500 characters",
            )
            for field in ("source", "detail")
        ),
    ],
    ids=[
        "ids",
        "names",
        "names without end",
        "observation",
        "beams",
        "no observation",
        "twice and again",
        "link",
        "source",
        "detail",
    ],
)
def test_malformed_event_is_rejected(tmp_path: Path, topic: str, data: bytes, said: str) -> None:
    path = tmp_path / "x.mcap"
    frame = MAGIC + _packed(described() + message(no_frame(FRAME)))
    path.write_bytes(frame + _packed(described(topic.encode()) + message(data)))
    with pytest.raises(LogError, match=f"not a recording of this program: {said}"):
        list(read_log(path))


@pytest.mark.parametrize(
    "data",
    [b"\xff\xff", schemas.message_class("ClockSet")(utc_offset_ns=2**63 - 1).SerializeToString()],
)
def test_invalid_clock_event_is_rejected_by_every_reader(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + _packed(described(schemas.CLOCK_TOPIC.encode()) + message(data)))
    for read in (lambda: list(read_log(path)), lambda: utc_offset_ns([path])):
        with pytest.raises(LogError, match="not a recording of this program"):
            read()


def test_settings_that_are_not_utf8_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        mcap = McapFile(file)
        mcap.attachment(0, 0, "settings.toml", "application/toml", b"\xff\xfe")
        frames = schemas.FRAMES_TOPIC
        channel = mcap.channel(frames, "protobuf", mcap.schema("x", "protobuf", b""))
        mcap.message(channel, 1, 1, 0, no_frame(FRAME))
        mcap.finish()
    with pytest.raises(LogError, match="its settings are not UTF-8 text"):
        read_settings(path)


def test_gaps_beyond_the_limit_are_merged(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(MAGIC + record(METADATA, _hole()) * (HOLES_MAX + 5))
    holes = read_recording_info(path).holes
    assert len(holes) == HOLES_MAX
    assert holes[-1].events == 2 * 6


def test_gap_text_is_sanitised_and_its_count_bounded(tmp_path: Path) -> None:
    hole = Hole.from_metadata({"t_ns": "5", "events": "1", "why": "\x1b[2J\x1b]0;x\x07\ndisk \x9b"})
    assert hole.why == "[2J]0;xdisk "
    for events in ("-1", "", "9" * 19, "9" * 4300, "9" * 5000):
        with pytest.raises(
            ValueError, match=r"hole with too many events|hole with an invalid number"
        ):
            Hole.from_metadata({"t_ns": "5", "events": events, "why": ""})
    path, most = tmp_path / "x.mcap", str(EVENTS_MAX).encode()
    pairs = {b"t_ns": b"5", b"events": most, b"why": b"x"}
    body = text(b"".join(text(key) + text(value) for key, value in pairs.items()))
    path.write_bytes(MAGIC + record(METADATA, text(HOLE.encode()) + body) * (HOLES_MAX + 5))
    assert read_recording_info(path).holes[-1].events == EVENTS_MAX


@pytest.mark.parametrize("number", ["9" * 10, "9" * 5000])
def test_part_number_out_of_range_is_ignored(number: str) -> None:
    assert Part.from_metadata({"run": "r", "number": number}) is None


def test_lz4_chunks_of_other_programs_are_read(tmp_path: Path) -> None:
    import lz4.frame

    contents = described(b"/mavlink/raw") + message(FRAME) * 3
    path = tmp_path / "x.mcap"
    for packed, found in (
        (lz4.frame.compress(contents), 3),
        (lz4.frame.compress(contents)[:-9], 0),
    ):
        path.write_bytes(MAGIC + chunk(b"lz4", packed, len(contents), zlib.crc32(contents)))
        assert sum(isinstance(content, Message) for content in Walk(path)) == found


def test_recovery_keeps_foreign_messages_without_schema(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(leftovers()["no-schema"])
    assert recover(path).messages == {"/a": 1}


def test_intact_recording_is_read_unchanged(tmp_path: Path) -> None:
    driven = [Tick(5), Frame(t_ns=6, link="udp", source=Source(1, 1), msgid=0, raw=FRAME)]
    with Writer(
        where=tmp_path / "x.mcap", settings_toml="", versions={}, weights_hz=None, started_ns=0
    ) as writer:
        for event in driven:
            writer.event(event)
        writer.close({})
    assert list(read_log(tmp_path / "x.mcap")) == driven
