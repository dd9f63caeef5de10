"""Whether this machine and this site are ready, and what would hold beams back.          [shell]

What settings ask of the machine is looked at first (``companion.node.machine``); then the service
itself listens for a while, records nothing, and its own words are judged. The first thing to ask
for where something does not work.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.urls import MAVLINK
from companion.node import capacity, machine
from companion.node.machine import Finding, Grade
from companion.node.service import Service
from companion.node.serving import run_until_stopped
from companion.pipeline.fold import Pipeline
from companion.server.access import bind
from companion.settings.files import embedded
from companion.settings.model import Settings
from companion.settings.outlets import DriveSettings, RecordSettings
from companion.values import Level, UserError, Verdict, kind_of
from companion.views import uav_state

TIMED_UPDATES: Final = 5  # times that beams are computed to tell how long that takes
BUSY: Final = 0.3
"""Share of the time between updates that beams may take before that is worth a thought."""
NOISY: Final = 0.01  # share of frames with a wrong checksum from which on a link is noisy
FORMATS: Final = {
    "sbs": "BaseStation lines (30003)",
    "readsb": "Beast (30005), or aircraft.json",
    "rid": "Remote ID in JSON",
    "cot": "Cursor on Target",
}
"""What receivers of other kinds than MAVLink say, by the scheme of their links."""
NAMED_MAX: Final = 8  # most vehicles that a line names


def check(
    settings: Settings,
    seconds: float,
    *,
    token: str | None = None,
    insecure: bool = False,
    show: Callable[[str], None] = lambda _: None,
) -> Iterator[Finding]:
    """Findings, the static ones first; then listens for ``seconds`` over the links that stand.

    ``show`` is told what goes on meanwhile. Sends what ``[presence]`` allows, as a run would.
    """
    faulty = set[str]()
    for finding in machine.look(settings, token=token, insecure=insecure):
        if finding.grade is Grade.FAULT:
            faulty.add(finding.subject.removeprefix("link "))
        yield finding
    show("measuring what this machine carries")
    yield _capacity(settings)
    urls = [url for url in settings.links.urls if url not in faulty]
    if not settings.links.urls:
        yield Finding(
            subject="links", grade=Grade.FAULT, text="none", remedy="say --link udpin:0.0.0.0:14550"
        )
    if urls and seconds > 0:
        show(f"listening for {seconds:g} s")
        service = _listen(_to_listen(settings, urls), seconds)
        yield from _reception(service, settings)


def _capacity(settings: Settings) -> Finding:
    try:
        share = machine.processor_share()
        found = capacity.measure(embedded(settings), processor=share)
    except UserError as error:
        return Finding(
            subject="settings",
            grade=Grade.FAULT,
            text=str(error),
            remedy="correct the settings, or the file that they name",
        )
    most = f"more than {capacity.MOST}" if found.uavs is None else f"some {found.uavs}"
    text = (
        f"carries {most} UAVs at {capacity.RATE_HZ} reports a second each"
        f" (a report takes {found.report_s * 1e3:.2f} ms,"
        f" an update of {capacity.MORE} beams {found.update_s * 1e3:.1f} ms)"
    )
    if share < 1:
        text += f"; this process is allowed {share * 100:.0f} % of a processor"
    if found.uavs is not None and found.uavs < capacity.FEW:
        return Finding(
            subject="capacity", grade=Grade.DOUBT, text=text, remedy="lower [beams] update_hz"
        )
    return Finding(subject="capacity", grade=Grade.OK, text=text)


def _to_listen(settings: Settings, urls: list[str]) -> Settings:
    """The settings of a run that keeps nothing, over those links."""
    source = settings.center.source or "home"
    kept = settings.override(links={"urls": urls}, center={"source": source})
    keys = {url: key for url, key in kept.signing.keys.items() if url in urls}
    return kept.model_copy(
        update={
            "recording": kept.recording.model_copy(update={"directory": None}),
            "server": kept.server.model_copy(update={"foxglove": None}),
            "records": RecordSettings(),
            "drive": DriveSettings(),
            "out": kept.out.model_copy(update={"urls": ()}),
            "signing": kept.signing.model_copy(update={"keys": keys}),
        }
    )


def _listen(settings: Settings, seconds: float) -> Service:
    """A service that ran so long, with nobody to see it but this process."""
    with bind("127.0.0.1:0", token=None, insecure=False) as http:
        service = Service(settings=settings, say=lambda _: None)
        run_until_stopped(lambda until: service.run(http, None, until), seconds)
    return service


def _reception(service: Service, settings: Settings) -> Iterator[Finding]:
    yield from _links(service)
    pipeline = service.pipeline
    update = pipeline.last_update
    names = [track.uav for track in update.tracks] if update else []
    own = [uav for uav in names if kind_of(uav).reports_itself]
    if settings.center.source is None:
        heard = f"; heard: {', '.join(own[:NAMED_MAX])}" if own else ""
        remedy = f"say --center SYSID:COMPID or LAT,LON,ALT{heard}"
        yield Finding(
            subject="carrier",
            grade=Grade.FAULT,
            text="nobody said what carries the array",
            remedy=remedy,
        )
        return
    subject = f"carrier {settings.center.source}"
    if update is None or update.unfit is not None:
        unfit = "no beam update was made" if update is None else str(update.unfit)
        remedy = (
            f"is it one of {', '.join(own[:NAMED_MAX])}?"
            if own
            else "no vehicle is received: check the links"
        )
        yield Finding(subject=subject, grade=Grade.FAULT, text=unfit, remedy=remedy)
    else:
        yield Finding(subject=subject, grade=Grade.OK, text="its place and attitude are known")
    yield from _uavs(service)
    yield from _speed(service, settings.beams.update_hz)


def _links(service: Service) -> Iterator[Finding]:
    for link in service.links():
        subject, heard = f"link {link.url}", sorted(map(str, link.components))
        bad = link.bad_crc
        said = f"{link.frames} frames of {', '.join(heard[:NAMED_MAX]) or 'nobody'}"
        scheme = link.url.partition(":")[0]
        if scheme not in MAVLINK and link.frames == 0 and link.bytes > 0:
            yield _not_understood(subject, scheme, link)
        elif link.frames == 0 and link.bytes > 0:
            remedy = "another baud rate? signed with another key? not MAVLink at all?"
            yield Finding(
                subject=subject,
                grade=Grade.FAULT,
                text=f"{link.bytes} bytes, and no MAVLink in them",
                remedy=remedy,
            )
        elif link.frames == 0:
            yield Finding(
                subject=subject, grade=Grade.FAULT, text="heard nothing", remedy=_silent(link.url)
            )
        elif bad > NOISY * link.frames:
            yield Finding(
                subject=subject,
                grade=Grade.DOUBT,
                text=f"{said}; {bad} with a wrong checksum",
                remedy="is the line noisy?",
            )
        else:
            yield Finding(subject=subject, grade=Grade.OK, text=said)


def _not_understood(subject: str, scheme: str, link: LinkStatus) -> Finding:
    """A receiver of another kind that sent bytes, and no position of anybody."""
    refused = ", ".join(f"{count} {reason}" for reason, count in link.lost.items())
    if not refused:
        return Finding(
            subject=subject,
            grade=Grade.DOUBT,
            text=f"{link.bytes} bytes, and no aircraft in them yet",
        )
    said = f"{link.bytes} bytes, and nothing of use in them ({refused})"
    return Finding(
        subject=subject,
        grade=Grade.FAULT,
        text=said,
        remedy=f"is this the port that says {FORMATS[scheme]}?",
    )


def _silent(url: str) -> str:
    if url.startswith(("rid:udp", "cot:udp")):
        return f"does anybody send {FORMATS[url.partition(':')[0]]} here?"
    if url.startswith(("udpin", "tcpin")):
        port = url.rpartition(":")[2]
        return f"does anybody send here? MAVProxy: --out udp:THIS_MACHINE:{port}"
    if url.startswith("zenoh"):
        return f"does anybody say {url.partition(':')[2].partition('?')[0]}/out there?"
    if url.startswith("serial"):
        return "is MAVLink on that port of the autopilot (SERIALn_PROTOCOL = 2), at this baud rate?"
    return "does anybody answer there?"


def _uavs(service: Service) -> Iterator[Finding]:
    verdicts = service.pipeline.health.verdicts
    shown = [one for one in uav_state.states(service, service.now_ns()) if one.target]
    if not shown:
        remedy = "wait for a position fix; see what /v1/uavs refuses"
        yield Finding(
            subject="UAVs",
            grade=Grade.FAULT,
            text="no UAV that gets a beam was received",
            remedy=remedy,
        )
    for one in shown:
        track = one.track
        name, dt_s = track.uav, track.dt_s
        pace = "one report" if dt_s is None else f"reports each {dt_s:.2f} s"
        text = f"{track.state}, {pace}, bound {track.bound_m:.1f} m"
        yield _judged(name, text, verdicts.get(name))


def _judged(name: str, text: str, verdict: Verdict | None) -> Finding:
    found = Finding(subject=f"UAV {name}", grade=Grade.OK, text=text)
    if verdict is None:
        return replace(found, grade=Grade.DOUBT, text=f"not judged: {text}")
    text = f"{verdict.level}: {text}"
    if verdict.level is Level.GOOD or verdict.blame is None:
        return replace(found, text=text)
    blame = verdict.blame
    return replace(found, grade=Grade.DOUBT, text=f"{text}; {blame.reason}", remedy=blame.remedy)


def _speed(service: Service, update_hz: float) -> Iterator[Finding]:
    took_s = sorted(_look_s(service.pipeline, service.now_ns()) for _ in range(TIMED_UPDATES))[
        TIMED_UPDATES // 2
    ]
    share = took_s * update_hz
    text = f"beams take {took_s * 1e3:.1f} ms, {share:.0%} of the time between updates"
    if share > BUSY:
        yield Finding(
            subject="this machine", grade=Grade.DOUBT, text=text, remedy="lower [beams] update_hz"
        )
    else:
        yield Finding(subject="this machine", grade=Grade.OK, text=text)


def _look_s(pipeline: Pipeline, now_ns: int) -> float:
    began_s = time.perf_counter()
    pipeline.look(now_ns, 0.0)
    return time.perf_counter() - began_s
