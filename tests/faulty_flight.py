"""Faulty flights into live services, all of them at once, and what came of each."""

import json
import math
import re
import subprocess
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import pymap3d
from mcap.reader import make_reader
from support import BIN, HANG_S, Node, end

from companion.mavlink.wire.decode import DECODED, decode
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.recording import schemas
from companion.recording.reader import read_log
from companion.values import Frame, SystemTime
from sitl_replay.flight import scenario
from sitl_replay.flight.fleet import CARRIER, ORIGIN

SEED = 11
SAMPLES_EVERY_S = 0.6
QUIET_S = 0.6
"""Longer than a flight is ever silent: a link that was not heard for so long has heard all."""
SETTINGS = """[clocks]
{clocks}[observer]
acceleration_max_mps2 = 12.0
lag_s = [0.0, 0.0]
[tracks]
reacquire_s = 3.0
"""
"""Simulated stamps are exact; a fixed wing's turns and gusts exceed what copters do."""
Json = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A flight with faults, and the service that hears it over so many links.

    ``clocks``: further lines of that section of the settings.
    """

    faults: tuple[str, ...] = ()
    scenario: str = "racetrack"
    uavs: int = 4
    seconds: float = 10.0
    links: int = 1
    clocks: str = ""

    @property
    def struck(self) -> set[str]:
        """Whose frames the faults concern; empty where everybody's."""
        named = (re.search(r"@(\d+:\d+)", fault) for fault in self.faults)
        return {found[1] for found in named if found}


@dataclass(frozen=True)
class Moment:
    """What the service said while the flight went on."""

    uavs: dict[str, Json]
    beams: Json
    ready: bool

    @property
    def beamed(self) -> set[str]:
        return {beam["uav"] for beam in self.beams["beams"]}


@dataclass(kw_only=True)
class Outcome:
    """One flight: what was sent, what the service said meanwhile, in the end, and in its record.

    ``sent`` is the summary of ``sitl-replay``, ``moments`` what was asked while the flight went on,
    the last just before its end; ``replayed`` is the summary of ``companion replay``.
    """

    case: Case
    sent: Json
    moments: list[Moment]
    status: Json
    links: list[Json]
    uavs: dict[str, Json]
    events: list[Json]
    exit: tuple[int, str, str]
    recording: Path
    replayed: Json
    flown_log: Path

    @property
    def touched(self) -> dict[str, int]:
        """By fault, the frames that it struck, over all links."""
        found: dict[str, int] = self.sent["faults"]
        return found

    @property
    def rejected(self) -> dict[str, int]:
        """By reason, over all senders and links."""
        found: dict[str, int] = self.status["rejected"]
        return found

    @property
    def last(self) -> Moment:
        """The last that was asked while the flight went on."""
        return self.moments[-1]

    def said(self, subject: str) -> list[str]:
        """The notices about a subject while the flight went on, in order."""
        end_s = self.epoch_s + self.case.seconds + 1.0  # the first track coasts 2 s after the end
        return [
            event["text"]
            for event in self.events
            if event["subject"] == subject and at_s(event["at"]) < end_s
        ]

    @cached_property
    def flown(self) -> list[Frame]:
        """Every frame as its sender sent it."""
        return [event for event in read_log(self.flown_log) if isinstance(event, Frame)]

    @cached_property
    def received(self) -> list[Frame]:
        """Every frame that the service took for one, in the order in which they came."""
        return [event for event in read_log(self.recording) if isinstance(event, Frame)]

    @cached_property
    def reports_flown(self) -> Counter[str]:
        """How many reports each vehicle sent of itself."""
        return Counter(str(one.source) for one in self.flown if one.msgid == GLOBAL_POSITION_INT)

    @cached_property
    def recorded(self) -> dict[str, list[Any]]:
        """What the recording holds of rejections and notices, by topic."""
        kinds = {
            schemas.REJECTIONS_TOPIC: schemas.message_class("Rejection"),
            schemas.LOG_TOPIC: schemas.LogMessage,
        }
        found: dict[str, list[Any]] = {topic: [] for topic in kinds}
        with self.recording.open("rb") as file:
            messages = make_reader(file).iter_messages(topics=list(kinds), log_time_order=False)
            for _, channel, message in messages:
                found[channel.topic].append(kinds[channel.topic].FromString(message.data))
        return found

    @cached_property
    def epoch_s(self) -> float:
        """Unix time at the start of the flight, by the carrier's SYSTEM_TIME as it was flown."""
        for frame in self.flown:
            message = decode(frame) if frame.msgid in DECODED else None
            if isinstance(message, SystemTime) and message.source == CARRIER.source:
                assert message.unix_us is not None
                return message.unix_us * 1e-6 - (message.boot_ms - CARRIER.uptime_ms) * 1e-3
        raise AssertionError(f"no SYSTEM_TIME of the carrier in {self.flown_log}")

    def errors_m(self, uav: str) -> list[tuple[list[float], Json]]:
        """How far off each answer about a UAV was, of each that goes by this id; and the answer."""
        flight = scenario.BUILDERS[self.case.scenario](self.case.uavs, SEED)
        found = []
        for entry in (moment.uavs[uav] for moment in self.moments if uav in moment.uavs):
            here = pymap3d.geodetic2ned(entry["lat_deg"], entry["lon_deg"], entry["alt_m"], *ORIGIN)
            motions = flight.truth(uav, at_s(entry["valid_at"]) - self.epoch_s)
            found.append(([math.dist(here, one.position_ned_m) for one in motions], entry))
        return found


def at_s(time: str) -> float:
    """Unix time of a time as the API writes it."""
    return datetime.fromisoformat(time).timestamp()


def fly_all(cases: Mapping[str, Case], where: Path) -> dict[str, Outcome]:
    """Start a service for each case, fly them all at once, and stop the services."""
    flights = [_Flight(case, where / name) for name, case in cases.items()]
    with ThreadPoolExecutor(len(cases)) as together:
        try:
            list(together.map(_Flight.start, flights))
            outcomes = list(together.map(_Flight.fly, flights))
        finally:
            for flight in flights:
                flight.end()
    return dict(zip(cases, outcomes, strict=True))


class _Flight:
    """One service and one flight, in a folder of their own."""

    def __init__(self, case: Case, where: Path) -> None:
        self._case = case
        self._where = where
        self._node: Node | None = None
        self._sender: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start the service; returns when it listens."""
        self._where.mkdir()
        settings = self._where / "settings.toml"
        settings.write_text(SETTINGS.format(clocks=self._case.clocks), encoding="utf-8")
        links = ["--link", "udpin:127.0.0.1:0"] * self._case.links
        self._node = Node(
            "run", *links, "--listen", "127.0.0.1:0", "--center", str(CARRIER.source),
            "--config", str(settings), "--record", str(self._where / "recordings"),
        )  # fmt: skip

    def fly(self) -> Outcome:
        """Fly, ask meanwhile and at the end, and stop the service."""
        case, node = self._case, self._node
        assert node is not None
        urls = [link["url"].replace("udpin", "udpout") for link in node.json("/v1/links")["links"]]
        command = [BIN / "sitl-replay", "fly", case.scenario, "--uavs", str(case.uavs), "--json"]
        command += ["--seed", str(SEED), "--duration", str(case.seconds)]
        command += ["--record", self._where / "flown.tlog"]
        command += [word for url in urls for word in ("--to", url)]
        command += [word for fault in case.faults for word in ("--fault", fault)]
        self._sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        moments = self._moments(node)
        summary, _ = self._sender.communicate(timeout=HANG_S)
        assert self._sender.returncode == 0, case
        node.wait_until("/v1/links", _are_quiet)
        status, events = node.json("/v1/status"), node.json("/v1/events")["events"]
        links, uavs = node.json("/v1/links")["links"], _by_id(node)
        ended = node.stop()
        (recording,) = (self._where / "recordings").iterdir()
        return Outcome(
            case=case,
            sent=json.loads(summary),
            moments=moments,
            status=status,
            links=links,
            uavs=uavs,
            events=events,
            exit=ended,
            recording=recording,
            replayed=_replayed(recording),
            flown_log=self._where / "flown.tlog",
        )

    def end(self) -> None:
        """Leave nothing behind, whatever happened."""
        started = (self._sender, None if self._node is None else self._node.process)
        for process in started:
            if process is not None:
                end(process)

    def _moments(self, node: Node) -> list[Moment]:
        """What the service says until the flight ends, but not after."""
        assert self._sender is not None
        moments: list[Moment] = []
        while True:
            found = Moment(_by_id(node), node.json("/v1/beams"), node.get("/readyz")[0] == 200)
            if self._sender.poll() is not None:
                return moments
            moments.append(found)
            time.sleep(SAMPLES_EVERY_S)  # between two questions to another process


def _replayed(recording: Path) -> Json:
    command = [BIN / "companion", "replay", recording, "--no-record", "--json"]
    found: Json = json.loads(
        subprocess.run(command, capture_output=True, check=True, timeout=HANG_S).stdout
    )
    return found


def _by_id(node: Node) -> dict[str, Json]:
    return {entry["id"]: entry for entry in node.json("/v1/uavs")["uavs"]}


def _are_quiet(answer: Json) -> bool:
    return all(link["age_s"] is not None and link["age_s"] > QUIET_S for link in answer["links"])
