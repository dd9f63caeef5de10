"""Verdicts on the links to all UAVs, and notices when they change.

Once a second, the guaranteed and the likely gain of each beam are compared with the gain that the
link needs. Links are assessed in batches, one per update, so that no update is delayed. A verdict
changes only after a hold time and with a gain margin, so that it does not flap.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from companion.beams.aim import directions
from companion.beams.array.coverage import Coverage
from companion.beams.array.geometry import Array
from companion.beams.worth import guarantee, link_budget
from companion.beams.worth.link_budget import LinkBudget
from companion.pipeline import blame
from companion.pipeline.blame import LinkEvidence
from companion.settings.beams import NeedSettings
from companion.values import (
    Beam,
    BeamSet,
    Cause,
    FloatArray,
    Level,
    Notice,
    Severity,
    Track,
    Update,
    Verdict,
)

EVERY_NS: Final = 1_000_000_000
"""Interval between two assessments of a link; a round through all links takes as long."""
AT_ONCE: Final = 16
"""Least number of links assessed per update; more if the round would take too long."""
HOLD_WORSE_NS: Final = 1_000_000_000  # hold time before a verdict gets worse
HOLD_BETTER_NS: Final = 3_000_000_000  # hold time before a verdict gets better
HYSTERESIS_DB: Final = 1.0
"""Gain margin by which a link may fall below its need before its level changes, dB."""
NAMED: Final = 6  # largest number of UAVs named in one notice
RANK: Final = {Level.NONE: 0, Level.WEAK: 1, Level.GOOD: 2}  # levels from the worst to the best


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Properties common to all beams: the array, its coverage, its radio."""

    array: Array
    coverage: Coverage
    budget: LinkBudget
    uav_antennas: int


class _Link(NamedTuple):
    """Link to assess: beam, needed gain, guaranteed and likely gain (None: no such gain)."""

    beam: Beam
    needed_db: float
    guaranteed_db: float | None
    likely_db: float | None


class LinkBatch(NamedTuple):
    """Batch of links to assess: whether it starts a round, the UAVs still queued, the links.

    ``left_out`` are the verdicts on UAVs without a beam, at the start of a round.
    """

    begins: bool
    waiting: list[str]
    links: list[_Link]
    left_out: dict[str, Verdict]


class HealthMonitor:
    """Monitor of the links. ``verdicts`` holds the current verdict of each target, by its id."""

    def __init__(self, need: NeedSettings, site: Site) -> None:
        self.verdicts: dict[str, Verdict] = {}
        self._need = need
        self._site = site
        self._round_start_ns: int | None = None  # start of the current round
        self._last_ns: int | None = None  # time of the previous update
        self._waiting: list[str] = []  # UAVs still queued in this round
        self._noticed: dict[str, Verdict] = {}  # verdicts at the last notice
        self._pending: dict[str, tuple[bool, int]] = {}  # pending change: better?, since when
        self._unfit: str | None = None

    def next_batch(self, update: Update) -> LinkBatch | None:
        """Return the next batch of links to assess, with their gains; None if none is due.

        Changes nothing. Takes milliseconds, and may run on any thread.
        """
        begun_ns, last_ns = self._round_start_ns, self._last_ns
        begins = begun_ns is None or not 0 <= update.t_ns - begun_ns < EVERY_NS
        waiting = [beam.uav for beam in update.beams.beams] if begins else self._waiting
        if not begins and not waiting:
            return None
        elapsed_ns = 0 if last_ns is None else update.t_ns - last_ns
        share = len(update.beams.beams) * min(max(elapsed_ns / EVERY_NS, 0.0), 1.0)
        many = max(AT_ONCE, math.ceil(share))
        chosen = frozenset(waiting[:many])
        which = [i for i, beam in enumerate(update.beams.beams) if beam.uav in chosen]
        links = [] if update.carrier is None or not which else self._links(update.beams, which)
        left_out = _of_left_out(update) if begins else {}
        return LinkBatch(begins=begins, waiting=waiting[many:], links=links, left_out=left_out)

    def _links(self, beam_set: BeamSet, which: Sequence[int]) -> list[_Link]:
        towards = directions(beam_set)
        needed_db = _needed_db(self._need, self._site, beam_set, towards)
        least_db = self._least_db(beam_set, towards, which)
        return [
            _Link(
                beam=beam_set.beams[i],
                needed_db=needed_db[i],
                guaranteed_db=sure_db,
                likely_db=likely_db,
            )
            for i, sure_db, likely_db in zip(which, *least_db, strict=True)
        ]

    def judge(
        self, update: Update, weighed: LinkBatch | None, evidence: Callable[[str], LinkEvidence]
    ) -> list[Notice]:
        """Assess one batch of links; return notices of changes at the end of a round.

        ``evidence`` returns what is known about a UAV in addition to its track; it is called for
        UAVs whose link is not good.
        """
        self._last_ns = update.t_ns
        if weighed is None:
            return []
        self._waiting = weighed.waiting
        tracks = {track.uav: track for track in update.tracks}
        fresh = dict(weighed.left_out)
        if weighed.begins:
            self._round_start_ns = update.t_ns
        for link in weighed.links:
            fresh[link.beam.uav] = self._judge_link(update, link, tracks, evidence)
        held = self.verdicts | {
            uav: self._with_hold_time(verdict) for uav, verdict in fresh.items()
        }
        names = dict.fromkeys((*tracks, *(out.uav for out in update.beams.left_out)))
        self.verdicts = {uav: held[uav] for uav in names if uav in held}
        self._pending = {uav: kept for uav, kept in self._pending.items() if uav in tracks}
        return [] if self._waiting else self._notices(update)

    def _judge_link(
        self,
        update: Update,
        link: _Link,
        tracks: dict[str, Track],
        evidence: Callable[[str], LinkEvidence],
    ) -> Verdict:
        uav, carrier = link.beam.uav, update.carrier
        level = self._level(uav, link.needed_db, link.guaranteed_db, link.likely_db)
        why = None
        if level is not Level.GOOD and carrier is not None:
            known = tracks[uav], carrier, link.needed_db, evidence(uav)
            why = blame.of_beam(link.beam, *known)
        return Verdict(
            uav=uav,
            level=level,
            blame=why,
            since_ns=update.t_ns,
            needed_gain_db=link.needed_db,
            guaranteed_gain_db=link.guaranteed_db,
            likely_gain_db=link.likely_db,
        )

    def _least_db(
        self, beam_set: BeamSet, towards: FloatArray, which: Sequence[int]
    ) -> tuple[Sequence[float | None], Sequence[float | None]]:
        """Return each beam's least gain within its UAV's bound, and within the usual error."""
        array, beams = self._site.array, [beam_set.beams[i] for i in which]
        both = np.tile(towards[which], (2, 1))
        angles = [beam.pointing_bound_rad for beam in beams]
        angles += [beam.pointing_p95_rad for beam in beams]
        bounds = guarantee.covered_bounds(array, self._site.coverage, both, angles)
        weights = np.tile(beam_set.weights[:, which], 2)
        gains = guarantee.guaranteed_gains_db(array, both, bounds, weights)
        return gains[: len(beams)], gains[len(beams) :]

    def _level(
        self, uav: str, needed_db: float, sure_db: float | None, likely_db: float | None
    ) -> Level:
        """Return a link's level by its gains; a level is kept within ``HYSTERESIS_DB``."""
        held = self.verdicts.get(uav)
        rank = RANK[held.level] if held else RANK[Level.NONE]

        def enough(gain_db: float | None, level: Level) -> bool:
            hysteresis_db = HYSTERESIS_DB if rank >= RANK[level] else 0.0
            return gain_db is not None and gain_db >= needed_db - hysteresis_db

        if enough(sure_db, Level.GOOD):
            return Level.GOOD
        return Level.WEAK if enough(likely_db, Level.WEAK) else Level.NONE

    def _with_hold_time(self, fresh: Verdict) -> Verdict:
        """Return the new verdict; until its hold time ends, with the current level."""
        uav, held = fresh.uav, self.verdicts.get(fresh.uav)
        if held is None:
            return fresh
        if fresh.level is held.level:
            self._pending.pop(uav, None)
            if fresh.needed_gain_db is held.needed_gain_db is None and fresh.blame == held.blame:
                return held  # still without a beam; there may be thousands
            return replace(fresh, since_ns=held.since_ns)
        better = RANK[fresh.level] > RANK[held.level]
        was_better, since_ns = self._pending.get(uav, (better, fresh.since_ns))
        if was_better is not better:
            since_ns = fresh.since_ns
        self._pending[uav] = (better, since_ns)
        # Without a beam no gain can fluctuate, so the verdict changes at once.
        wait_ns = (
            HOLD_BETTER_NS if better else HOLD_WORSE_NS if fresh.needed_gain_db is not None else 0
        )
        if fresh.since_ns - since_ns >= wait_ns:
            del self._pending[uav]
            return fresh
        why = None if held.level is Level.GOOD else fresh.blame or held.blame
        return replace(fresh, level=held.level, blame=why, since_ns=held.since_ns)

    def _notices(self, update: Update) -> list[Notice]:
        """Return notices of changed verdicts; one for all links if the carrier is the cause."""
        before, self._noticed = self._noticed, self.verdicts
        was, self._unfit = self._unfit, update.unfit
        if update.unfit is not None:
            text = f"no links: {update.unfit}"
            news = before and was is None
            return (
                [Notice(t_ns=update.t_ns, severity=Severity.WARNING, subject="beams", text=text)]
                if news
                else []
            )
        changed = dict[tuple[Level, Cause | None], list[Verdict]]()
        for uav, verdict in self.verdicts.items():
            held = before.get(uav)
            if held is None or held.level is verdict.level:
                continue
            cause = verdict.blame.cause if verdict.blame else None
            # A UAV that is stale or lost, and therefore without a beam, has its own notice.
            if cause is not Cause.SILENT or verdict.needed_gain_db is not None:
                changed.setdefault((verdict.level, cause), []).append(verdict)
        return [_notice(update.t_ns, alike) for alike in changed.values()]


def _notice(t_ns: int, alike: Sequence[Verdict]) -> Notice:
    """Return one notice for all links that changed to the same level for the same cause."""
    names = ", ".join(verdict.uav for verdict in alike[:NAMED])
    rest = f" and {len(alike) - NAMED} more" if len(alike) > NAMED else ""
    one, links = alike[0], "links" if len(alike) > 1 else "link"
    text = f"{links} to {names}{rest}: {one.level}"
    if one.blame is None:
        return Notice(t_ns=t_ns, severity=Severity.INFO, subject=one.uav, text=text)
    text += f" – {one.blame.reason}; {one.blame.remedy}"
    return Notice(t_ns=t_ns, severity=Severity.WARNING, subject=one.uav, text=text)


def _of_left_out(update: Update) -> dict[str, Verdict]:
    tracks = {track.uav: track for track in update.tracks}
    return {
        out.uav: Verdict(
            uav=out.uav,
            level=Level.NONE,
            blame=blame.of_left_out(out, tracks.get(out.uav), update.unfit),
            since_ns=update.t_ns,
        )
        for out in update.beams.left_out
    }


def _needed_db(
    need: NeedSettings, site: Site, beam_set: BeamSet, towards: FloatArray
) -> list[float]:
    """Return the array gain that each link needs, dB.

    With ``needed_sinr_db`` that is the beam's gain less the excess of its SINR.
    """
    beams = beam_set.beams
    if need.needed_sinr_db is None:
        return [need.needed_db] * len(beams)
    sinr_db = link_budget.sinr_of_beams_db(
        site.array, beam_set, towards, site.budget, site.uav_antennas
    )
    spare_db = sinr_db - need.needed_sinr_db
    return [beam.gain_db - spare for beam, spare in zip(beams, spare_db.tolist(), strict=True)]
