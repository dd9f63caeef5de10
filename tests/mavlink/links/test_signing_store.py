"""Key files and stored timestamps, on a real disk, with a process that is really killed."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path

import pytest
from support import HANG_S, line_of, started

from companion.mavlink.links.signing_store import Timestamps, key_warning, load_key
from companion.mavlink.links.urls import LinkError
from companion.mavlink.trust.signing import EPOCH_NS, LATEST, UNIT_NS, LinkSigning, fingerprint
from companion.mavlink.wire import encode
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Reason, Source

KEY = hashlib.sha256(b"correct horse").digest()
OTHER_KEY = hashlib.sha256(b"battery staple").digest()
URL = "udpin:0.0.0.0:14550"
S = 1_000_000_000
NOW_NS = 1_790_000_000 * S


def sent(t_ns: int, key: bytes = KEY, sysid: int = 1) -> Frame:
    """Return a signed heartbeat with that timestamp."""
    raw = LinkSigning(key=key, link_id=0).sign(
        encode.pack(encode.heartbeat(Source(sysid, 1)), 0), t_ns
    )
    return framed(raw, t_ns)


def framed(raw: bytes, t_ns: int) -> Frame:
    (frame,) = Splitter("a").feed(t_ns, raw)
    assert isinstance(frame, Frame)
    return frame


def one_line(error: pytest.ExceptionInfo[LinkError], path: Path) -> str:
    """Check that the operator's message is one line that names the file."""
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    return text


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "signing.json"


def file_after_kill(path: Path, name: str) -> Path:
    """Return the file as a process killed now would leave it."""
    return shutil.copy(path, path.with_name(name))


# --- keys ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data",
    [
        KEY,
        KEY.hex().encode(),
        KEY.hex().upper().encode() + b"\n",
        b" \t\r\n" + KEY.hex().encode() + b"\r\n\n",
        b" " * 31 + b"k",
    ],
    ids=["raw", "hex", "upper", "white space", "raw, though it looks like text"],
)
def test_key_file_formats_are_read(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "key"
    file.write_bytes(data)
    assert load_key(file) == (data if len(data) == 32 else KEY)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        KEY[:31],
        KEY + b"\n",
        KEY.hex()[:63].encode(),
        KEY.hex().encode() + b"0",
        b"g" + KEY.hex()[1:].encode(),
        KEY.hex(" ").encode(),
        KEY.hex(" ").encode()[:64],
        "é".encode() * 32,
        bytes(32),
        b"0" * 64,
        bytes(1 << 20),
    ],
)
def test_invalid_key_file_is_rejected_without_leaking_it(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "key"
    file.write_bytes(data)
    with pytest.raises(LinkError) as error:
        load_key(file)
    text = one_line(error, file)
    assert ("zeros" in text) if data in (bytes(32), b"0" * 64) else ("sha256sum" in text)
    assert KEY.hex()[2:60] not in text


def test_pipe_in_place_of_a_key_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "key")
    with pytest.raises(LinkError) as error:
        load_key(tmp_path / "key")
    assert one_line(error, tmp_path / "key").endswith("not a file")


@pytest.mark.parametrize("name", ["missing", "."])
def test_unreadable_key_file_is_reported(tmp_path: Path, name: str) -> None:
    with pytest.raises(LinkError, match="cannot read") as error:
        load_key(tmp_path / name)
    one_line(error, tmp_path / name)


def test_suggested_command_creates_the_mavproxy_key(tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.touch()
    with pytest.raises(LinkError) as error:
        load_key(file)
    command = str(error.value).partition("MAVProxy: ")[2].replace("PASSPHRASE", "correct horse")
    subprocess.run(["sh", "-c", command], check=True, timeout=HANG_S)
    ask = (
        "from MAVProxy.modules.mavproxy_signing import SigningModule as module;"
        "print(module.passphrase_to_key(None, 'correct horse').hex())"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ask],
        capture_output=True,
        text=True,
        check=True,
        timeout=HANG_S,
    )
    assert load_key(file).hex() == done.stdout.strip().splitlines()[-1] == KEY.hex()


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640, 0o604, 0o620, 0o644])
def test_world_readable_key_file_gives_a_warning(tmp_path: Path, mode: int) -> None:
    file = tmp_path / "key"
    file.write_bytes(KEY)
    file.chmod(mode)
    warning = key_warning(file)
    if mode & 0o77:
        assert warning is not None
        assert f"chmod 600 {file}" in warning
    else:
        assert warning is None
    assert "cannot check the permissions" in str(key_warning(tmp_path / "missing"))


# --- across runs --------------------------------------------------------------------------------


def test_timestamp_file_exists_at_once_and_holds_no_key(path: Path) -> None:
    timestamps = Timestamps(path)
    assert json.loads(path.read_bytes())["links"] == []
    assert path.stat().st_mode & 0o777 == 0o600
    timestamps.guard(URL, KEY, 0, NOW_NS)
    timestamps.close(NOW_NS)
    (link,) = json.loads(path.read_bytes())["links"]
    assert (link["url"], link["key"]) == (URL, fingerprint(KEY))
    assert KEY.hex() not in path.read_text()
    assert KEY not in path.read_bytes()
    assert {file.name for file in path.parent.iterdir()} == {path.name, path.name + ".lock"}


def test_timestamps_continue_after_a_clean_shutdown(path: Path) -> None:
    now_ns, heard, stamps = NOW_NS, [], []
    raw = encode.pack(encode.heartbeat(Source(5, 191)), 0)
    for _ in range(3):
        timestamps = Timestamps(path)
        guard = timestamps.guard(URL, KEY, 7, now_ns)
        assert [guard.refusal(frame) for frame in heard] == [Reason.REPLAYED] * len(heard)
        for _ in range(2):
            heard.append(sent(now_ns))
            assert guard.refusal(heard[-1]) is None
            stamps.append(guard.sign(raw, now_ns - S)[-12:-6])
            now_ns += UNIT_NS
        timestamps.close(now_ns)
    numbers = [int.from_bytes(stamp, "little") for stamp in stamps]
    assert sorted(set(numbers)) == numbers


def test_new_link_or_key_starts_fresh_and_keeps_the_old_one(path: Path) -> None:
    old = sent(NOW_NS)
    for url, key in ((URL, KEY), ("tcp:h:1", KEY), (URL, OTHER_KEY), (URL, KEY)):
        frame = old if key is KEY else sent(NOW_NS, OTHER_KEY)
        timestamps = Timestamps(path)
        guard = timestamps.guard(url, key, 0, NOW_NS)
        known = len(json.loads(path.read_bytes())["links"])
        expected = Reason.REPLAYED if known == 3 and (url, key) == (URL, KEY) else None
        assert guard.refusal(frame) is expected
        timestamps.close(NOW_NS)
    assert known == 3


def test_links_with_one_key_share_the_newest_timestamps_of_senders(path: Path) -> None:
    """Also with a link of an earlier run; another key has its own."""
    timestamps = Timestamps(path)
    one, other = (timestamps.guard(url, KEY, 0, NOW_NS) for url in (URL, "tcp:h:1"))
    apart = timestamps.guard("tcp:h:2", OTHER_KEY, 0, NOW_NS)
    assert one.refusal(sent(NOW_NS)) is None
    behind_ns = NOW_NS - 11 * S
    assert other.refusal(sent(behind_ns)) is Reason.REPLAYED
    assert apart.refusal(sent(behind_ns, OTHER_KEY)) is None
    timestamps.close(NOW_NS)
    later = Timestamps(path)
    assert later.guard("tcp:h:3", KEY, 0, NOW_NS).refusal(sent(behind_ns)) is Reason.REPLAYED
    later.close(NOW_NS)


def test_signing_settings_are_passed_to_each_link(path: Path) -> None:
    timestamps = Timestamps(path)
    strict = timestamps.guard(URL, KEY, 7, NOW_NS)
    lax = timestamps.guard("tcp:h:1", KEY, 8, NOW_NS, allow_unsigned=True)
    plain = framed(encode.pack(encode.heartbeat(Source(1, 1)), 0), NOW_NS)
    assert (strict.refusal(plain), strict.link_id) == (Reason.UNSIGNED, 7)
    assert (lax.refusal(plain), lax.link_id) == (None, 8)
    with pytest.raises(LinkError, match="two links"):
        timestamps.guard(URL, KEY, 9, NOW_NS)
    timestamps.close(NOW_NS)


def test_running_process_counts_as_unclean_from_the_start(path: Path) -> None:
    """Killed before the first save, whatever the previous run has left."""
    first = Timestamps(path)
    guard = first.guard(URL, KEY, 0, NOW_NS)
    assert guard.refusal(sent(NOW_NS)) is None
    first.close(NOW_NS)
    second = Timestamps(path)
    guard = second.guard(URL, KEY, 0, NOW_NS)
    lost = [sent(NOW_NS + S // 2), sent(NOW_NS + S // 2, sysid=2)]  # one known, one new
    assert [guard.refusal(frame) for frame in lost] == [None, None]
    left = file_after_kill(path, "left")
    second.close(NOW_NS + S)

    third = Timestamps(left)
    guard = third.guard(URL, KEY, 0, NOW_NS + S)
    assert [guard.refusal(frame) for frame in lost] == [Reason.REPLAYED] * 2
    assert guard.refusal(sent(NOW_NS + 6 * S)) is None
    assert guard.refusal(sent(NOW_NS + 6 * S, sysid=2)) is None
    third.close(NOW_NS + 6 * S)


CHILD = """
import sys, time
from pathlib import Path
from companion.mavlink.links.signing_store import Timestamps
from companion.mavlink.trust.signing import LinkSigning
from companion.mavlink.wire import encode
from companion.mavlink.wire.framing import Splitter
from companion.values import Source

path, now_ns, key = Path(sys.argv[1]), int(sys.argv[2]), bytes.fromhex(sys.argv[3])
timestamps = Timestamps(path)
ours = timestamps.guard("udpin:0.0.0.0:14550", key, 7, now_ns)
theirs = [LinkSigning(key=key, link_id=0) for _ in range(3)]
step = 0
while True:
    step += 1
    now_ns += 100_000_000
    for n, sender in enumerate(theirs):
        if n == 2 and step % 70 != 1:  # this one is silent for seven seconds at a time
            continue
        late_ns = (0, 40_000_000_000, 0)[n]  # and this one has a clock that is behind
        raw = sender.sign(encode.pack(encode.heartbeat(Source(n + 1, 1)), 0), now_ns - late_ns)
        (frame,) = Splitter("a").feed(now_ns, raw)
        if ours.refusal(frame) is None:
            print("heard", now_ns, raw.hex(), flush=True)
    raw = ours.sign(encode.pack(encode.heartbeat(Source(5, 191)), 0), now_ns)
    print("sent", now_ns, raw.hex(), flush=True)
    if timestamps.due(now_ns):
        timestamps.write(timestamps.snapshot(now_ns))
"""


def live(path: Path, now_ns: int, lines: int) -> Iterator[tuple[str, int, bytes]]:
    """Return what a process received and sent until it was killed; its time runs fast."""
    command = [sys.executable, "-c", CHILD, path, str(now_ns), KEY.hex()]
    with started(command, stdout=subprocess.PIPE, text=True) as process:
        out = [line_of(process, process.stdout) for _ in range(lines)]
        with pytest.raises(LinkError, match="another process"):
            Timestamps(path)
        process.send_signal(signal.SIGKILL)
        out += process.stdout.readlines()
    assert process.returncode == -signal.SIGKILL
    for line in out:
        if line.endswith("\n"):
            kind, t_ns, raw = line.split()
            yield kind, int(t_ns), bytes.fromhex(raw)


def test_repeated_kills_accept_no_replay_and_reuse_no_timestamp(path: Path) -> None:
    """No received frame is accepted again, no timestamp is reused, and all streams continue within
    seconds."""
    now_ns, heard, stamps = NOW_NS, [], [0]
    for lines in (40, 333, 2, 517):
        before = len(heard)
        for kind, t_ns, raw in live(path, now_ns, lines):
            now_ns = t_ns
            if kind == "heard":
                heard.append(framed(raw, t_ns))
            else:
                stamps.append(int.from_bytes(raw[-12:-6], "little"))
                assert stamps[-1] > stamps[-2]
        assert lines < 100 or len({frame.source for frame in heard[before:]}) == 3

        left = file_after_kill(path, "left")
        timestamps = Timestamps(left)
        guard = timestamps.guard(URL, KEY, 7, now_ns)
        for frame in heard:
            assert guard.refusal(frame._replace(t_ns=now_ns)) is Reason.REPLAYED
        later_ns = now_ns + 6 * S
        assert [guard.refusal(sent(later_ns, sysid=sysid)) for sysid in (1, 3)] == [None, None]
        assert guard.refusal(sent(later_ns - 40 * S, sysid=2)) is None
        timestamps.close(later_ns)


def test_timestamps_are_saved_each_second_or_every_three_when_idle(path: Path) -> None:
    """Every second while timestamps change; every three seconds in silence, because clocks
    advance.
    """
    timestamps = Timestamps(path)
    assert not timestamps.due(NOW_NS + 100 * S)  # no link has a key
    guard = timestamps.guard(URL, KEY, 0, NOW_NS)
    assert not timestamps.due(NOW_NS + 3 * S - 1)
    assert timestamps.due(NOW_NS + 3 * S)
    assert guard.refusal(sent(NOW_NS)) is None
    assert not timestamps.due(NOW_NS + S - 1)
    assert timestamps.due(NOW_NS + S)
    timestamps.write(timestamps.snapshot(NOW_NS + S))
    assert not timestamps.due(NOW_NS + 4 * S - 1)
    guard.sign(encode.pack(encode.heartbeat(Source(5, 191)), 0), NOW_NS)
    assert timestamps.due(NOW_NS + 2 * S)
    timestamps.close(NOW_NS + 2 * S)


def test_highest_timestamp_survives_repeated_kills(path: Path) -> None:
    """It has no room for a margin. Paces of streams are kept, too."""
    latest_ns, left = EPOCH_NS + LATEST * UNIT_NS, path
    for number in range(3):
        timestamps = Timestamps(left)
        guard = timestamps.guard(URL, KEY, 0, NOW_NS)
        if not number:
            for second in range(0, 30, 2):
                counted = sent(NOW_NS + second * UNIT_NS, sysid=2)
                assert guard.refusal(counted._replace(t_ns=NOW_NS + second * S)) is None
        refused = guard.refusal(sent(latest_ns)._replace(t_ns=NOW_NS))
        assert refused is (Reason.REPLAYED if number else None)
        snapshot = timestamps.snapshot(NOW_NS + S)
        ((state, _),) = snapshot.links.values()
        assert {stream[0]: known.pace for stream, known in state.streams.items()} == {1: None, 2: 1}
        timestamps.write(snapshot)
        left = file_after_kill(left, f"left{number}")
        timestamps.close(NOW_NS)


def test_snapshot_never_replaces_a_newer_one(path: Path) -> None:
    timestamps = Timestamps(path)
    guard = timestamps.guard(URL, KEY, 0, NOW_NS)
    first = timestamps.snapshot(NOW_NS + S)
    assert guard.refusal(sent(NOW_NS + S)) is None
    second = timestamps.snapshot(NOW_NS + 2 * S)
    assert guard.refusal(sent(NOW_NS + 2 * S)) is None
    for snapshot, clock_ns, streams in ((first, NOW_NS + S, 0), (second, NOW_NS + 2 * S, 1)):
        timestamps.write(snapshot)
        (link,) = json.loads(path.read_bytes())["links"]
        assert link["clock"] == (clock_ns - EPOCH_NS) // UNIT_NS
        assert len(link["streams"]) == streams
    newest = path.read_bytes()
    for snapshot in (first, second):  # as a delayed thread would
        timestamps.write(snapshot)
        assert path.read_bytes() == newest
    timestamps.close(NOW_NS + 3 * S)


def test_timestamp_file_is_replaced_atomically(path: Path) -> None:
    """The old file stays whole until the new one is complete."""
    timestamps = Timestamps(path)
    timestamps.guard(URL, KEY, 0, NOW_NS)
    before = path.read_bytes()
    with path.open("rb") as old:
        timestamps.write(timestamps.snapshot(NOW_NS + S))
        assert old.read() == before
    assert path.read_bytes() != before
    timestamps.close(NOW_NS + S)


def test_new_file_and_its_folder_are_synced(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power failure cannot be tested, but the system calls can."""
    timestamps = Timestamps(path)
    timestamps.guard(URL, KEY, 0, NOW_NS)
    before, synced = path.read_bytes(), []

    def fsync(descriptor: int) -> None:
        found = os.fstat(descriptor)
        synced.append((found.st_ino, found.st_size, path.read_bytes()))

    monkeypatch.setattr("companion.mavlink.links.signing_store.os.fsync", fsync)
    timestamps.write(timestamps.snapshot(NOW_NS + 60 * S))
    (file, size, then), (folder, _, later) = synced
    assert (file, size) == (path.stat().st_ino, path.stat().st_size)
    assert folder == path.parent.stat().st_ino
    assert then == before  # the old file stays until the new one is complete
    assert later == path.read_bytes() != before
    timestamps.close(NOW_NS + 60 * S)


def test_timestamp_file_stays_whole_under_concurrent_writes(path: Path) -> None:
    """The file is whole at every moment."""
    timestamps = Timestamps(path)
    guard = timestamps.guard(URL, KEY, 0, NOW_NS)
    failures: list[BaseException] = []

    def write(snapshot: object) -> None:
        try:
            timestamps.write(snapshot)  # type: ignore[arg-type]
            json.loads(path.read_bytes())
        except BaseException as error:
            failures.append(error)

    frames = [sent(NOW_NS + n * S // 100, sysid=1 + n % 200) for n in range(600)]
    threads = []
    for n, frame in enumerate(frames):
        assert guard.refusal(frame) is None
        if n % 20 == 0:
            snapshot = timestamps.snapshot(frame.t_ns)
            threads.append(threading.Thread(target=write, args=(snapshot,)))
            threads[-1].start()
    timestamps.close(frames[-1].t_ns)
    ended = path.read_bytes()
    for thread in threads:
        thread.join()
    assert not failures
    assert path.read_bytes() == ended
    again = Timestamps(path)
    guard = again.guard(URL, KEY, 0, frames[-1].t_ns)
    assert {guard.refusal(frame) for frame in frames} == {Reason.REPLAYED}
    again.close(frames[-1].t_ns)


# --- unusable files -----------------------------------------------------------------------------


def refuses(path: Path, said: str) -> None:
    with pytest.raises(LinkError, match=said) as error:
        Timestamps(path)
    one_line(error, path)


def test_damaged_timestamp_file_is_rejected(path: Path) -> None:
    timestamps = Timestamps(path)
    guard = timestamps.guard(URL, KEY, 0, NOW_NS)
    assert guard.refusal(sent(NOW_NS)) is None
    timestamps.close(NOW_NS)
    good = path.read_bytes()
    for at in range(len(good)):
        path.write_bytes(good[:at])
        refuses(path, "damaged.*remove the file")
        path.write_bytes(good[:at] + bytes([good[at] ^ 1 << at % 7]) + good[at + 1 :])
        refuses(path, "damaged.*remove the file")
    path.write_bytes(good)
    Timestamps(path).close(NOW_NS)


@pytest.mark.parametrize(
    "text",
    ["null", "[]", "7", '"x"', "{}", '{"version":1}', "[" * 100_000, "9" * 9999, "\0", "\udcff"],
    ids=lambda text: text[:14].encode("ascii", "backslashreplace").decode(),
)
def test_foreign_file_is_rejected(path: Path, text: str) -> None:
    path.parent.mkdir()
    path.write_bytes(text.encode(errors="surrogateescape"))
    refuses(path, "damaged")


LINK: dict[str, object] = {
    "url": URL, "key": "0123456789abcdef", "clean": True,
    "clock": 1, "local": 1, "sent": 1, "floor": -1, "streams": [[1, 1, 0, 5, 0]],
}  # fmt: skip


def written(path: Path, links: object) -> None:
    """Write a timestamps file with the right digest."""
    digest = sha256(json.dumps(links, separators=(",", ":")).encode()).hexdigest()
    path.parent.mkdir(exist_ok=True)
    content = {"version": 1, "sha256": digest, "links": links}
    path.write_text(json.dumps(content, separators=(",", ":")))


@pytest.mark.parametrize(
    "links",
    [
        {"a": 1},
        "abc",
        [{}],
        [7],
        [LINK | {"streams": None}],
        [LINK | {"streams": [[1, 1, 1]]}],
        [LINK | {"streams": [[1, 1, 1, "a", "b"]]}],
        [LINK | {"streams": [[1, 1, 0, 5]]}],
        [LINK | {"streams": [[1, 1, 0, 5, 0, 0.5]]}],
        [LINK | {"streams": [[1, 1, 0, 5, 0, 1, 1]]}],
        [LINK | {"clock": "x"}],
        [LINK | {"clock": 1.5}],
        [LINK | {"sent": 10**40}],
    ],
    ids=range(13),
)
def test_wrong_content_with_the_right_digest_is_damage(path: Path, links: object) -> None:
    written(path, [LINK])
    Timestamps(path).close(NOW_NS)
    written(path, links)
    refuses(path, "damaged")


def test_large_file_is_not_read_whole(path: Path) -> None:
    path.parent.mkdir()
    with path.open("wb") as file:
        file.truncate(1 << 34)
    refuses(path, "damaged")


def test_file_of_an_unsupported_version_is_rejected(path: Path) -> None:
    Timestamps(path).close(NOW_NS)
    path.write_text(path.read_text().replace('"version":1', '"version":2'))
    refuses(path, "damaged")


def test_unwritable_timestamp_path_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    refuses(tmp_path / "file" / "signing.json", "cannot write the signing timestamps")
    (tmp_path / "folder").mkdir()
    refuses(tmp_path / "folder", "cannot read")
    (tmp_path / "new.new").mkdir()
    refuses(tmp_path / "new", "cannot write the signing timestamps")


def test_second_process_on_the_same_timestamp_file_is_rejected(path: Path) -> None:
    timestamps = Timestamps(path)
    refuses(path, "another process")
    timestamps.close(NOW_NS)
    Timestamps(path).close(NOW_NS)


def test_failed_save_is_reported_and_retried(path: Path) -> None:
    timestamps = Timestamps(path)
    guard = timestamps.guard(URL, KEY, 0, NOW_NS)
    assert guard.refusal(sent(NOW_NS)) is None
    away = path.parent.with_name("away")
    path.parent.rename(away)
    with pytest.raises(LinkError, match="cannot write the signing timestamps") as error:
        timestamps.write(timestamps.snapshot(NOW_NS))
    one_line(error, path)
    away.rename(path.parent)
    timestamps.write(timestamps.snapshot(NOW_NS))
    assert len(json.loads(path.read_bytes())["links"][0]["streams"]) == 1
    timestamps.close(NOW_NS)


def test_no_file_descriptor_is_leaked(path: Path) -> None:
    def count() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    Timestamps(path).close(NOW_NS)
    before = count()
    for _ in range(3):
        timestamps = Timestamps(path)
        refuses(path, "another process")
        timestamps.guard(URL, KEY, 0, NOW_NS)
        timestamps.close(NOW_NS)
    path.write_bytes(b"{}")
    refuses(path, "damaged")
    assert count() == before
