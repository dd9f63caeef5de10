"""Verdicts on the links to all UAVs; ``verdict_notices`` announces their changes.

Once a second, the guaranteed and the likely gain of each beam are compared with the gain that the
link needs. Links are assessed in batches, one per update, so that no update is delayed; those that
fell below their need are assessed at once. A verdict falls at once, and rises after a hold time and
with a gain margin, so that it does not flap.
"""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from companion.pipeline import blame
from companion.pipeline.angle_parts import AngleParts, angle_parts
from companion.pipeline.blame import LinkEvidence
from companion.pipeline.link_gains import GainMeter, LinkGains, Site
from companion.pipeline.verdict_notices import VerdictNotices
from companion.settings.beams import NeedSettings
from companion.values import (
    BeamSet,
    Blame,
    Cause,
    Level,
    Notice,
    Track,
    TrackState,
    Update,
    Verdict,
)

EVERY_NS: Final = 1_000_000_000
"""Least interval between two assessments of a link; a round through all links takes as long."""
AT_ONCE: Final = 16
"""Least number of links assessed per update; more if there are more in a round."""
LOOK_NS: Final = 90_000_000
"""Least time between two searches for links that fell below their need: each update at 10 Hz."""
FALLEN_AT_ONCE: Final = 32  # most links assessed per update because they fell below their need
HOLD_BETTER_NS: Final = 3_000_000_000  # hold time before a verdict gets better
MARGIN_DB: Final = 0.25
"""Gain above the need that a link must have for its level to rise, dB."""
GOOD_KEPT_NS: Final = 30_000_000_000
"""Time for which the smallest bound of a good link is kept, to find what has grown since."""
COASTING_S: Final = 2.0
"""Age of the newest report of a coasting UAV beyond which its link is not good, seconds."""


class LinkBatch(NamedTuple):
    """Batch of links to assess.

    begins   whether it starts a round
    looks    whether links were searched for those that fell below their need
    waiting  UAVs still queued in the round
    links    the links, with their gains
    """

    begins: bool
    looks: bool
    waiting: list[str]
    links: list[LinkGains]


@dataclass(slots=True)
class _LinkRecord:
    """What is kept of a link between its assessments.

    better_since_ns  since when it has been better than its level
    good             time and parts of the smallest bound with which it was good of late
    why              cause of its newest assessment that was not good
    """

    better_since_ns: int | None = None
    good: tuple[int, AngleParts] | None = None
    why: Blame | None = None


class HealthMonitor:
    """Monitor of the links. ``verdicts`` holds the current verdict of each target, by its id.

    ``update_hz`` is the rate of updates at which a round takes ``EVERY_NS``. If they come later, it
    takes longer: larger batches would delay them further.
    """

    def __init__(self, need: NeedSettings, site: Site, update_hz: float) -> None:
        self.verdicts: dict[str, Verdict] = {}
        self._meter = GainMeter(need, site)
        self._round_start_ns: int | None = None  # start of the current round
        self._looked_ns: int | None = None  # when links were last searched for fallen ones
        self._updates = max(1.0, EVERY_NS * 1e-9 * update_hz)  # in a round
        self._waiting: list[str] = []  # UAVs still queued in this round
        self._links_kept: defaultdict[str, _LinkRecord] = defaultdict(_LinkRecord)
        self._notices = VerdictNotices()

    def next_batch(self, update: Update) -> LinkBatch | None:
        """Return the next batch of links to assess, with their gains; None if none is due.

        Changes nothing. Takes milliseconds, and may run on any thread.
        """
        beams = update.beams.beams
        begun_ns = self._round_start_ns
        is_due = begun_ns is None or not 0 <= update.t_ns - begun_ns < EVERY_NS
        begins = is_due and not self._waiting
        waiting = [beam.uav for beam in beams] if begins else self._waiting
        looked_ns = self._looked_ns
        looks = looked_ns is None or not 0 <= update.t_ns - looked_ns < LOOK_NS
        looks &= update.carrier is not None
        if not begins and not waiting and not looks:
            return None
        many = max(AT_ONCE, math.ceil(len(beams) / self._updates))
        whole = begins and many >= len(beams)  # all links are assessed, fallen or not
        fallen = self._fallen(update.beams)[:FALLEN_AT_ONCE] if looks and not whole else []
        chosen = frozenset((*waiting[:many], *fallen))
        which = [i for i, beam in enumerate(beams) if beam.uav in chosen]
        links = (
            [] if update.carrier is None or not which else self._meter.gains(update.beams, which)
        )
        return LinkBatch(begins=begins, looks=looks, waiting=waiting[many:], links=links)

    def _fallen(self, beam_set: BeamSet) -> list[str]:
        """Return UAVs whose gain is now below the need of their level."""
        held = [self.verdicts.get(beam.uav) for beam in beam_set.beams]
        which = [i for i, one in enumerate(held) if one is not None and one.level is not Level.NONE]
        if not which:
            return []
        usual = [one is not None and one.level is Level.WEAK for one in held]
        is_short = self._meter.is_short(beam_set, which, [usual[i] for i in which])
        return [beam_set.beams[i].uav for i, short in zip(which, is_short, strict=True) if short]

    def judge(
        self, update: Update, weighed: LinkBatch | None, evidence: Callable[[str], LinkEvidence]
    ) -> list[Notice]:
        """Assess one batch of links; return notices of changes at the end of a round.

        ``evidence`` returns what is known about a UAV in addition to its track.
        """
        begins = weighed is not None and weighed.begins
        tracks = {track.uav: track for track in update.tracks}
        fresh = self._of_left_out(update, tracks, evidence, all_of_them=begins)
        if weighed is None and not fresh:
            return []
        if weighed is not None:
            self._waiting = weighed.waiting
            for link in weighed.links:
                fresh[link.beam.uav] = self._judge_link(update, link, tracks, evidence)
        if begins:
            self._round_start_ns = update.t_ns
        if weighed is not None and weighed.looks:
            self._looked_ns = update.t_ns
        held = self.verdicts | {
            uav: self._with_hold_time(verdict) for uav, verdict in fresh.items()
        }
        names = dict.fromkeys((*tracks, *(out.uav for out in update.beams.left_out)))
        self.verdicts = {uav: held[uav] for uav in names if uav in held}
        if begins:
            for uav in [uav for uav in self._links_kept if uav not in tracks]:
                del self._links_kept[uav]
        if self._waiting:
            return []
        rising = {uav for uav, one in self._links_kept.items() if one.better_since_ns is not None}
        return self._notices.due(update, self.verdicts, rising)

    def _judge_link(
        self,
        update: Update,
        link: LinkGains,
        tracks: dict[str, Track],
        evidence: Callable[[str], LinkEvidence],
    ) -> Verdict:
        uav, carrier = link.beam.uav, update.carrier
        level = self._level(uav, link.needed_db, link.guaranteed_db, link.likely_db)
        why = None
        if carrier is not None:
            track, known = tracks[uav], evidence(uav)
            parts = angle_parts(link.beam, track, carrier, known.carrier.attitude, known.waited_s)
            coasting = track.state is TrackState.COASTING and track.age_s > COASTING_S
            held = self.verdicts.get(uav)
            if known.is_contradicted:
                follows = link.beam.pointing_bound_rad is not None  # the direction that is seen
                level = min(level, Level.WEAK if follows else Level.NONE, key=lambda one: one.rank)
            if level is not Level.GOOD:
                good = self._links_kept[uav].good
                why = blame.of_beam(
                    link.beam,
                    track,
                    link.needed_db,
                    known,
                    parts,
                    carrier=carrier,
                    when_good=None if good is None else good[1],
                    before=self._links_kept[uav].why if held and held.blame else None,
                )
            elif coasting:
                level, why = Level.WEAK, blame.of_coasting(track, known)
            else:
                self._note_good(uav, update.t_ns, parts)
        return Verdict(
            uav=uav,
            level=level,
            blame=why,
            since_ns=update.t_ns,
            needed_gain_db=link.needed_db,
            guaranteed_gain_db=link.guaranteed_db,
            likely_gain_db=link.likely_db,
        )

    def _note_good(self, uav: str, t_ns: int, parts: AngleParts) -> None:
        """Note the parts of the bound of a good link: the smallest bound of the last while."""
        record = self._links_kept[uav]
        if (
            record.good is None
            or t_ns - record.good[0] > GOOD_KEPT_NS
            or sum(parts.values()) <= sum(record.good[1].values())
        ):
            record.good = (t_ns, parts)

    def _level(
        self, uav: str, needed_db: float, sure_db: float | None, likely_db: float | None
    ) -> Level:
        """Return a link's level by its gains; a level rises only with ``MARGIN_DB``."""
        held = self.verdicts.get(uav)
        rank = held.level.rank if held else Level.GOOD.rank

        def enough(gain_db: float | None, level: Level) -> bool:
            margin_db = 0.0 if rank >= level.rank else MARGIN_DB
            return gain_db is not None and gain_db >= needed_db + margin_db

        if enough(sure_db, Level.GOOD):
            return Level.GOOD
        return Level.WEAK if enough(likely_db, Level.WEAK) else Level.NONE

    def _with_hold_time(self, fresh: Verdict) -> Verdict:
        """Return the new verdict; with the current level until a better one has been held."""
        held, record = self.verdicts.get(fresh.uav), self._links_kept[fresh.uav]
        record.why = fresh.blame or record.why
        if held is not None and fresh.level.rank > held.level.rank:
            if record.better_since_ns is None:
                record.better_since_ns = fresh.since_ns
            if fresh.since_ns - record.better_since_ns < HOLD_BETTER_NS:
                why = fresh.blame or (
                    record.why and blame.of_past(record.why, HOLD_BETTER_NS * 1e-9)
                )
                return replace(fresh, level=held.level, blame=why, since_ns=held.since_ns)
        record.better_since_ns = None
        if held is None or fresh.level is not held.level:
            return fresh
        if fresh.needed_gain_db is held.needed_gain_db is None and fresh.blame == held.blame:
            return held  # still without a beam; there may be thousands
        return replace(fresh, since_ns=held.since_ns)

    def _of_left_out(
        self,
        update: Update,
        tracks: dict[str, Track],
        evidence: Callable[[str], LinkEvidence],
        *,
        all_of_them: bool,
    ) -> dict[str, Verdict]:
        """Return verdicts on UAVs without a beam: all, or only those that had a link before."""
        found = dict[str, Verdict]()
        for out in update.beams.left_out:
            held = self.verdicts.get(out.uav)
            if not all_of_them and (held is None or held.needed_gain_db is None):
                continue
            refused = None
            if update.unfit is not None:
                refused = evidence(out.uav).carrier.refused
            elif out.cause is Cause.SILENT:
                refused = evidence(out.uav).refused
            found[out.uav] = Verdict(
                uav=out.uav,
                level=Level.NONE,
                blame=blame.of_left_out(out, tracks.get(out.uav), update.unfit, refused),
                since_ns=update.t_ns,
            )
        return found
