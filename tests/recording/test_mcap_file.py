"""Our MCAP writer against the library's: the same calls give the same bytes."""

import io
import random
import tracemalloc
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as Library

from companion.recording import mcap_file
from companion.recording.mcap_file import McapFile

TOPICS = ("/a", "/b", "/uav/1:1/fix")


def play(seed: int, made: McapFile | Library) -> None:
    """The same calls for both writers: schemas between messages, unordered times, flushes."""
    ours, chance = isinstance(made, McapFile), random.Random(seed)
    calls: Any = made
    attach = calls.attachment if ours else calls.add_attachment
    note = calls.metadata if ours else calls.add_metadata
    attach(5, 5, "settings.toml", "application/toml", b"x = 1\n")
    note("versions", {"companion": "1", "ä": ""})
    channels: dict[str, int] = {}
    for number in range(chance.randrange(400)):
        topic = chance.choice(TOPICS)
        if topic not in channels:
            schema = calls.schema if ours else calls.register_schema
            channel = calls.channel if ours else calls.register_channel
            described = schema(f"companion.{topic}", "protobuf", bytes(50))
            channels[topic] = channel(topic, "protobuf", described, {"of": "a test"})
        t_ns, data = chance.randrange(1 << 60), chance.randbytes(chance.randrange(300))
        if ours:
            calls.message(channels[topic], t_ns, t_ns + 1, number, data)
        else:
            calls.add_message(channels[topic], t_ns, data, t_ns + 1, number)
        if chance.random() < 0.01:
            calls.flush()
            note("hole", {"events": "3"})
    calls.finish()


@pytest.mark.parametrize("seed", range(12))
def test_writer_bytes_equal_the_mcap_library(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    size = (1 << 20, 2000)[seed % 2]
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", size)
    ours, theirs = io.BytesIO(), io.BytesIO()
    play(seed, McapFile(ours))
    library = Library(theirs, chunk_size=size, compression=CompressionType.ZSTD)
    library.start(library="companion")
    play(seed, library)
    assert ours.getvalue() == theirs.getvalue()


def test_messages_are_found_through_the_index(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "CHUNK_BYTES", 500)
    out = io.BytesIO()
    made = McapFile(out)
    channel = made.channel("/a", "protobuf", made.schema("A", "protobuf", b""))
    for number in range(100):
        made.message(channel, 1000 - number, 1000 - number, number, bytes([number]))
    made.finish()
    out.seek(0)
    found = list(make_reader(out).iter_messages(starting_at=950, ending_before=960))
    assert [message.data[0] for _, _, message in found] == list(range(50, 40, -1))


def test_index_of_many_channels_takes_its_bytes_in_memory() -> None:
    """Chunks of a second with 500 channels, as objects, took 2 MB a minute."""
    made = McapFile(io.BytesIO())
    channels = [made.channel(f"/{n}", "protobuf", 0) for n in range(500)]

    def chunk(number: int) -> None:
        for channel in channels:
            made.message(channel, number, number, number, b"")
        made._end_chunk()

    chunk(0)
    made._stream = io.BytesIO()
    tracemalloc.start()
    try:
        for number in range(40):
            made._stream.seek(0)
            chunk(number)
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert made.index_bytes > 41 * 500 * 10
    assert grown < 1.5 * made.index_bytes


def test_more_topics_than_channel_ids_are_an_error_of_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mcap_file, "CHANNELS_MAX", 2)
    file = McapFile(io.BytesIO())
    assert [file.channel(topic, "protobuf", 0) for topic in "ab"] == [1, 2]
    with pytest.raises(OSError, match="at most 2 topics"):
        file.channel("c", "protobuf", 0)
    file.finish()
