"""Recording status in the API, of a running service and of a served replay."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.node.replay import writer_for
from companion.node.served_replay import ReplayRequest, ServedReplay
from companion.node.service import Service
from companion.settings.model import Settings
from companion.values import Severity
from companion.views.state import RecordingStatus

SETTINGS = Settings().override(center={"source": "5:1"})


def test_running_recording_status_has_its_own_values() -> None:
    service: Any = Service(settings=SETTINGS, say=lambda _: None)
    assert service.recording().state == "off"
    recorder = SimpleNamespace(
        degraded=False,
        file="flight.mcap",
        bytes=4096,
        messages=30,
        dropped=2,
        queued=7,
        written_ns=service.now_ns(),
    )
    service._recorder = recorder
    found = service.recording()
    assert 0 <= found.lag_s < 600
    assert found == RecordingStatus(
        state="recording",
        file="flight.mcap",
        bytes=4096,
        messages=30,
        dropped=2,
        queued=7,
        lag_s=found.lag_s,
    )
    recorder.degraded, recorder.written_ns = True, None
    assert (service.recording().state, service.recording().lag_s) == ("degraded", None)


def test_recorder_messages_become_recording_notices() -> None:
    service: Any = Service(settings=SETTINGS, say=lambda _: None)
    service._notify_recorder_state(
        SimpleNamespace(news=lambda: [(Severity.ERROR, "the disk is full")])
    )
    newest = service.notices[-1]
    assert (newest.severity, newest.subject, newest.text) == (
        Severity.ERROR,
        "recording",
        "the disk is full",
    )


def test_replay_recording_status_has_its_own_values(short_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "replayed.mcap"
    asked = ReplayRequest(
        logs=[short_log],
        settings=SETTINGS,
        speed=None,
        record=lambda: writer_for([short_log], SETTINGS, out),
    )
    node = ServedReplay(asked, lambda _: None)
    writer = node._run.writer
    assert writer is not None
    with writer:
        for event in list(node._events)[:500]:
            node._run.step(event)
        writer.flush()
        found = node.recording()
        assert (found.state, found.file) == ("recording", writer.path.name)
        assert found.bytes == pytest.approx(writer.path.stat().st_size, abs=1000)
        assert 500 <= found.messages < found.bytes / 20
        assert (found.dropped, found.queued) == (0, 0)
