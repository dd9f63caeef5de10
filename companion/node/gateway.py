"""The links, their signing, and the service's own messages.

Received frames are passed on as events, in order of arrival. Only what ``[presence]`` allows is
sent.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from companion.mavlink.links.daemon_threads import in_daemon_thread
from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.signing_store import Timestamps, key_warning, load_key
from companion.mavlink.links.transport import Link, receivers_budget
from companion.mavlink.links.urls import LinkError, parse_link
from companion.mavlink.trust.admission import admission
from companion.mavlink.trust.known_peers import KnownPeers
from companion.mavlink.trust.newcomers import Newcomers
from companion.mavlink.voice.component import ACCEPTED_IDS, ComponentSpec, ServiceComponent
from companion.mavlink.voice.rate_watch import MessageRate
from companion.mavlink.voice.verdict_reports import VerdictReports
from companion.mavlink.wire.encode import Outgoing
from companion.recording.background import STALLED_S
from companion.settings.center import VehicleCenter, parse_center
from companion.settings.model import Settings
from companion.settings.section import ConfigError
from companion.values import (
    Event,
    Frame,
    Notice,
    Reason,
    Rejection,
    Severity,
    Source,
    UserError,
    Verdict,
)

SETUP_SIGNING: Final = 256  # message that carries a signing key in plain; it is never recorded
UNANSWERED: Final = (
    "the signing timestamps are not saved: the disk has not answered for {:.0f} s; if the service"
    " is killed now, frames of this time can be replayed to the next one"
)
NOTICE_EVERY_NS: Final = 60_000_000_000  # least time between two notices of too many senders
SAVE_EVERY_S: Final = 0.25  # interval of checks whether signing timestamps must be saved


class Gateway:
    """All MAVLink links of the service.

    Call ``open`` for early errors, ``run`` until cancelled, then ``close``.

        step    takes each event
        notify  takes messages for the operator
        now_ns  the node's timeline

    Raises ``ConfigError`` if the settings enable presence without a system id.
    """

    def __init__(
        self,
        *,
        settings: Settings,
        step: Callable[[Event], None],
        notify: Callable[[Notice], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._step = step
        self._notify = notify
        self._now_ns = now_ns
        self._component = component(settings)
        self._verdict_reports = (
            VerdictReports(self._component.source)
            if self._component and settings.presence.verdicts
            else None
        )
        self._hear = ACCEPTED_IDS if self._component else frozenset()
        self._timestamps: Timestamps | None = None
        signed = set(settings.signing.keys) - set(settings.signing.allow_unsigned)
        self._known_peers = KnownPeers({*settings.links.routers, *signed})
        self._newcomers = Newcomers(_named(settings))
        self._receivers_s = receivers_budget()
        self._refusal_notice_ns = -NOTICE_EVERY_NS
        self._settings = settings
        self.links: list[Link] = []
        self.lag = ArrivalLag()  # delay from the arrival of datagrams to their processing

    def open(self) -> None:
        """Open the links and bind their addresses.

        Raises ``LinkError`` if a link, or the key or timestamps of a signed one, is unusable.
        """
        signing = self._settings.signing
        unknown = [url for url in signing.keys if url not in self._settings.links.urls]
        if unknown:
            raise LinkError(f"signing.keys: {unknown[0]} is not in links.urls; add or remove it")
        if signing.keys:
            self._timestamps = Timestamps(Path(signing.timestamps))
        for number, url in enumerate(self._settings.links.urls):
            link = self._link(number, url)
            link.open()
            self.links.append(link)
            if link.url.scheme == "udpout" and self._component is None:
                self._warn(
                    url,
                    f"{url} sends nothing, so no peer can answer: set `[presence] enabled = true`",
                )

    def _link(self, number: int, url: str) -> Link:
        parsed, signing, guard = parse_link(url), self._settings.signing, None
        if url in signing.keys:
            assert self._timestamps is not None
            path = Path(signing.keys[url])
            key, now_ns = load_key(path), self._now_ns()
            warning = key_warning(path)
            if warning:
                self._warn(url, warning)
            unsigned = url in signing.allow_unsigned
            guard = self._timestamps.guard(url, key, number % 256, now_ns, allow_unsigned=unsigned)
        return Link(
            url=parsed,
            receive=self._received,
            now_ns=self._now_ns,
            notify=self._notify,
            guard=guard,
            lag=self.lag,
            known_peers=self._known_peers,
            newcomers=self._newcomers,
            receivers_s=self._receivers_s,
        )

    async def run(self) -> None:
        """Serve all links until cancelled."""
        async with asyncio.TaskGroup() as group:
            for link in self.links:
                group.create_task(link.run(), name=link.status.url)
            if self._timestamps is not None:
                group.create_task(self._save(self._timestamps), name="signing timestamps")

    def close(self) -> None:
        """Save the signing timestamps, after ``run`` has ended.

        Raises ``LinkError`` if that fails.
        """
        if self._timestamps is not None:
            self._timestamps.close(self._now_ns())

    async def _save(self, timestamps: Timestamps) -> None:
        """Save signing timestamps on another thread than the event loop's.

        A disk error, or a disk that does not answer, is reported once, and saving is retried.
        """
        failing = False
        while True:
            await asyncio.sleep(SAVE_EVERY_S)
            if not timestamps.due(self._now_ns()):
                continue
            write = partial(timestamps.write, timestamps.snapshot(self._now_ns()))
            writing = asyncio.create_task(in_daemon_thread(write))
            _, unfinished = await asyncio.wait([writing], timeout=STALLED_S)
            if unfinished and not failing:
                self._warn("signing", UNANSWERED.format(STALLED_S), Severity.ERROR)
            failing |= bool(unfinished)
            try:
                await writing
            except LinkError as error:
                if not failing:
                    self._warn("signing", str(error), Severity.ERROR)
                failing = True
            else:
                failing = False

    def _received(self, items: list[Frame | Rejection]) -> None:
        for item in items:
            if isinstance(item, Frame) and item.msgid == SETUP_SIGNING:
                who = str(item.source)
                self._step(
                    Rejection(t_ns=item.t_ns, source=who, reason=Reason.SECRET, msgid=SETUP_SIGNING)
                )
                continue
            self._step(item)
            if self._component and isinstance(item, Frame) and item.msgid in self._hear:
                for found in self._component.hear(item):
                    if isinstance(found, Notice):
                        self._notify(found)
                    else:
                        self._step(found)
        self._notify_strangers()
        self._notify_newcomers()

    def _notify_strangers(self) -> None:
        for one in self._known_peers.notices:
            self._warn(one.who, one.text)
        self._known_peers.notices.clear()

    def _notify_newcomers(self) -> None:
        """Publish a notice while frames are not admitted, at most once a minute."""
        now_ns = self._now_ns()
        if self._newcomers.refused and now_ns - self._refusal_notice_ns >= NOTICE_EVERY_NS:
            self._refusal_notice_ns = now_ns
            self._newcomers.refused = 0
            self._warn(
                "links",
                "more frames arrive than this machine can process: those of new senders, and of"
                " senders that flood, are dropped; name the vehicles in `[tracks] allow`, or sign"
                " the links",
            )

    def _warn(self, subject: str, text: str, severity: Severity = Severity.WARNING) -> None:
        self._notify(Notice(t_ns=self._now_ns(), severity=severity, subject=subject, text=text))

    @property
    def has_component(self) -> bool:
        """Whether this service sends messages of its own."""
        return self._component is not None

    def speak(self, fit: bool, uavs: Iterable[Source], verdicts: Mapping[str, Verdict]) -> None:
        """Send the messages that are due. Call it about ten times a second.

        fit       whether the service is ready
        uavs      UAVs whose positions matter
        verdicts  current verdicts on links, by UAV
        """
        if self._component is None:
            return
        if self._verdict_reports is not None:
            for message in self._verdict_reports.due(self._now_ns(), verdicts):
                for link in self.links:
                    link.send(message)
        for message, target in self._component.due(self._now_ns(), fit, uavs):
            if target is None:
                for link in self.links:
                    link.send(message)
            else:
                self._send_to(target, message)

    def _send_to(self, target: Source, message: Outgoing) -> None:
        """Send over the link on which the target was last received."""
        heard = [
            (link.status.components[target].heard_ns, number)
            for number, link in enumerate(self.links)
            if target in link.status.components
        ]
        if heard:
            self.links[max(heard)[1]].send_to(target, message)

    def rates(self) -> list[MessageRate]:
        """Return the requested message rates and the state of each request."""
        return self._component.rates() if self._component else []


def _named(settings: Settings) -> Callable[[str], bool]:
    """Return a function that says whether the settings name a vehicle: the carrier, or allowed."""
    place, tracks = parse_center(settings.center.source or "home"), settings.tracks
    carrier = str(place.source) if isinstance(place, VehicleCenter) else None
    allows = admission(tracks.allow, tracks.deny) if tracks.allow else None
    return lambda uav: uav == carrier or (allows is not None and allows(uav))


def component(settings: Settings) -> ServiceComponent | None:
    """Return the service as a MAVLink component; None without presence. Raises ``ConfigError``."""
    given, center = settings.presence, settings.center.source
    if not given.enabled:
        return None
    at = parse_center(center or "home")
    carrier = at.source if isinstance(at, VehicleCenter) else None
    sysid = given.system_id or (carrier.sysid if carrier else None)
    if sysid is None:
        raise ConfigError(
            "presence.system_id is missing: a fixed array has no vehicle's system id; set one,"
            " such as 200"
        )
    try:
        return ServiceComponent(
            ComponentSpec(
                source=Source(sysid, given.component_id),
                carrier=carrier,
                position_hz=given.position_hz,
                attitude_hz=given.attitude_hz,
            )
        )
    except UserError as error:
        raise ConfigError(f"presence: {error}") from error
