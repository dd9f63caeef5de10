"""Check of this machine and site for ``companion check``.

First the requirements of the settings are checked on this machine (``companion.node.machine``);
then the service listens for a while without recording, and its state is assessed.
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
from companion.views.health import shown_verdicts
from companion.views.state import overload

TIMED_UPDATES: Final = 5  # number of timed computations of beams
BUSY: Final = 0.3
"""Fraction of the update interval for computing beams above which it is reported."""
NOISY: Final = 0.01  # share of frames with a wrong checksum from which on a link is noisy
FORMATS: Final = {
    "sbs": "BaseStation lines (30003)",
    "readsb": "Beast (30005), or aircraft.json",
    "rid": "Remote ID in JSON",
    "cot": "Cursor on Target",
}
"""Name of each receiver format other than MAVLink, by the scheme of its links."""
NAMED_MAX: Final = 8  # largest number of vehicles named in a line


def check(
    settings: Settings,
    seconds: float,
    *,
    token: str | None = None,
    insecure: bool = False,
    show: Callable[[str], None] = lambda _: None,
) -> Iterator[Finding]:
    """Yield findings, static ones first; then listen for ``seconds`` over the usable links.

    ``show`` is called with the current activity. Sends what ``[presence]`` allows, like a run.
    Raises ``KeyboardInterrupt`` if a signal ends the listening.
    """
    faulty = set[str]()
    for finding in machine.look(settings, token=token, insecure=insecure):
        if finding.grade is Grade.FAULT:
            faulty.add(finding.subject.removeprefix("link "))
        yield finding
    yield _capacity(settings, show)
    urls = [url for url in settings.links.urls if url not in faulty]
    if not settings.links.urls:
        yield Finding.fault(
            "links", "none is set", "give --link udpin:0.0.0.0:14550, or set `[links] urls`"
        )
    if urls and seconds > 0:
        show(f"listening for {seconds:g} s")
        service = _listen(_listening_settings(settings, urls), seconds)
        yield from _reception(service, settings)


def _capacity(settings: Settings, show: Callable[[str], None]) -> Finding:
    def done(work: float) -> None:
        show(f"measuring the capacity of this machine: {work * 100:.0f} %")

    done(0.0)
    try:
        share = machine.processor_share()
        found = capacity.measure(embedded(settings), processor=share, done=done)
    except UserError as error:
        return Finding.fault(
            "settings", str(error), "correct this setting, or the file that it names"
        )
    most = f"more than {capacity.MOST}" if found.uavs is None else f"about {found.uavs}"
    text = (
        f"{most} UAVs at {capacity.RATE_HZ} reports a second each"
        f" (a report takes {found.report_s * 1e3:.2f} ms,"
        f" an update of {capacity.MORE} beams {found.update_s * 1e3:.1f} ms)"
    )
    if share < 1:
        text += f"; this process may use {share * 100:.0f} % of a processor"
    if found.uavs is not None and found.uavs < capacity.FEW:
        return Finding.doubt("capacity", text, "lower `[beams] update_hz`")
    return Finding.ok("capacity", text)


def _listening_settings(settings: Settings, urls: list[str]) -> Settings:
    """Return run settings with these links, but without recording or other outputs."""
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
    with bind("127.0.0.1:0", token=None, insecure=False) as http:
        service = Service(settings=settings, say=lambda _: None)
        if run_until_stopped(lambda until: service.run(http, None, until), seconds):
            raise KeyboardInterrupt  # too short to be assessed
    return service


def _reception(service: Service, settings: Settings) -> Iterator[Finding]:
    yield from _links(service)
    pipeline = service.pipeline
    update = pipeline.last_update
    names = [track.uav for track in update.tracks] if update else []
    own = [uav for uav in names if kind_of(uav).reports_itself]
    if settings.center.source is None:
        heard = f"; received: {', '.join(own[:NAMED_MAX])}" if own else ""
        remedy = f"give --center SYSID:COMPID or LAT,LON,ALT{heard}"
        yield Finding.fault("carrier", "the carrier of the array is not set", remedy)
        return
    subject = f"carrier {settings.center.source}"
    if update is None or update.unfit is not None:
        unfit = "no beam update yet" if update is None else str(update.unfit)
        remedy = (
            f"check its id; received: {', '.join(own[:NAMED_MAX])}"
            if own
            else "check the links: no vehicle is received"
        )
        yield Finding.fault(subject, unfit, remedy)
    else:
        yield Finding.ok(subject, "its position and attitude are known")
    yield from _uavs(service)
    yield from _speed(service, settings.beams.update_hz)


def _links(service: Service) -> Iterator[Finding]:
    for link in service.links():
        subject, heard = f"link {link.url}", sorted(map(str, link.components))
        bad = link.bad_crc
        said = f"{link.frames} frames from {', '.join(heard[:NAMED_MAX]) or 'no component'}"
        scheme = link.url.partition(":")[0]
        if scheme not in MAVLINK and link.frames == 0 and link.bytes > 0:
            yield _not_understood(subject, scheme, link)
        elif link.frames == 0 and link.bytes > 0:
            remedy = "check the baud rate, the signing key, and that the sender speaks MAVLink"
            yield Finding.fault(
                subject, f"{link.bytes} bytes without a valid MAVLink frame", remedy
            )
        elif link.frames == 0:
            yield Finding.fault(subject, "nothing received", _silent(link.url))
        elif bad > NOISY * link.frames:
            yield Finding.doubt(
                subject, f"{said}; {bad} with a wrong checksum", "check the line for noise"
            )
        else:
            yield Finding.ok(subject, said)


def _not_understood(subject: str, scheme: str, link: LinkStatus) -> Finding:
    """Return the finding for a receiver that sent bytes, but no readable position."""
    refused = ", ".join(f"{count} {reason}" for reason, count in link.lost.items())
    if not refused:
        return Finding.doubt(subject, f"{link.bytes} bytes, no aircraft yet")
    said = f"{link.bytes} bytes without usable data ({refused})"
    return Finding.fault(subject, said, f"check that this port sends {FORMATS[scheme]}")


def _silent(url: str) -> str:
    if url.startswith(("rid:udp", "cot:udp")):
        return f"send {FORMATS[url.partition(':')[0]]} to this address"
    if url.startswith(("udpin", "tcpin")):
        port = url.rpartition(":")[2]
        return f"send MAVLink to this machine and port; MAVProxy: --out udp:THIS_MACHINE:{port}"
    if url.startswith("zenoh"):
        return f"check that a node publishes {url.partition(':')[2].partition('?')[0]}/out"
    if url.startswith("serial"):
        return "enable MAVLink on the autopilot's port (SERIALn_PROTOCOL = 2) at this baud rate"
    return "check the address, and that a program serves it"


def _uavs(service: Service) -> Iterator[Finding]:
    verdicts = shown_verdicts(service.pipeline.health, overload(service, service.now_ns()))
    shown = [one for one in uav_state.states(service, service.now_ns()) if one.target]
    if not shown:
        remedy = "check that the UAVs have a GNSS fix, and that `[tracks]` allows them"
        yield Finding.fault("UAVs", "no report of a UAV that is a target of beams", remedy)
    for one in shown:
        track = one.track
        name, dt_s = track.uav, track.dt_s
        pace = "one report" if dt_s is None else f"a report every {dt_s:.2f} s"
        text = f"{track.state}, {pace}, bound {track.bound_m:.1f} m"
        yield _assessed(name, text, verdicts.get(name))


def _assessed(name: str, text: str, verdict: Verdict | None) -> Finding:
    found = Finding.ok(f"UAV {name}", text)
    if verdict is None:
        return replace(found, grade=Grade.DOUBT, text=f"not assessed: {text}")
    text = f"{verdict.level}: {text}"
    if verdict.level is Level.GOOD or verdict.blame is None:
        return replace(found, text=text)
    blame = verdict.blame
    return replace(found, grade=Grade.DOUBT, text=f"{text}; {blame.reason}", remedy=blame.remedy)


def _speed(service: Service, update_hz: float) -> Iterator[Finding]:
    took_s = sorted(
        _update_time_s(service.pipeline, service.now_ns()) for _ in range(TIMED_UPDATES)
    )[TIMED_UPDATES // 2]
    share = took_s * update_hz
    text = f"beams take {took_s * 1e3:.1f} ms, {share:.0%} of the update interval"
    if share > BUSY:
        yield Finding.doubt("this machine", text, "lower `[beams] update_hz`")
    else:
        yield Finding.ok("this machine", text)


def _update_time_s(pipeline: Pipeline, now_ns: int) -> float:
    began_s = time.perf_counter()
    pipeline.look(now_ns, 0.0)
    return time.perf_counter() - began_s
