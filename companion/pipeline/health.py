"""Verdicts on the links to all UAVs, and notices when they change.

Once a second, the guaranteed and the likely gain of each beam are compared with the gain that the
link needs. Links are assessed in batches, one per update, so that no update is delayed; those whose
beam has got worse since are assessed at once. A verdict falls at once, and rises after a hold time
and with a gain margin, so that it does not flap.

Over 300 lines: assessment, hold times and notices are the life of one verdict.
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
from companion.pipeline.angle_parts import AngleParts, angle_parts
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
    TrackState,
    Update,
    Verdict,
)

EVERY_NS: Final = 1_000_000_000
"""Interval between two assessments of a link; a round through all links takes as long."""
AT_ONCE: Final = 16
"""Least number of links assessed per update; more if the round would take too long."""
FALLEN_AT_ONCE: Final = 32  # most links assessed per update because their beams got worse
HOLD_BETTER_NS: Final = 3_000_000_000  # hold time before a verdict gets better
MARGIN_DB: Final = 0.25
"""Gain above the need that a link must have for its level to rise, dB."""
SLACK_RATIO: Final = 1.02  # growth of a bound for which a link is not assessed again at once
SLACK_DB: Final = 0.1  # the same for a loss of gain
GOOD_KEPT_NS: Final = 30_000_000_000
"""Time for which the smallest bound of a good link is kept, to find what has grown since."""
COASTING_S: Final = 2.0
"""Age of the newest report of a coasting UAV beyond which its link is not good, seconds."""
ANNOUNCED_AFTER_NS: Final = 1_000_000_000
"""Time for which a link must have another level than the last announced one for a notice."""
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
    """Batch of links to assess.

    begins   whether it starts a round
    waiting  UAVs still queued in the round
    early    UAVs assessed out of order, because their beams got worse
    links    the links, with their gains
    """

    begins: bool
    waiting: list[str]
    early: frozenset[str]
    links: list[_Link]


class _Assessed(NamedTuple):
    """Beam as it was when its link was assessed: errors of its direction, and its gain."""

    bound_rad: float
    p95_rad: float
    gain_db: float

    def is_worse(self, beam: Beam) -> bool:
        """Return whether a beam is worse than this one by more than the slack."""
        return (
            _or_inf(beam.pointing_bound_rad) > SLACK_RATIO * self.bound_rad
            or _or_inf(beam.pointing_p95_rad) > SLACK_RATIO * self.p95_rad
            or beam.gain_db < self.gain_db - SLACK_DB
        )


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
        self._changed_ns: dict[str, int] = {}  # since when a level is not the announced one
        self._better_since_ns: dict[str, int] = {}  # since when a link has been better
        self._assessed: dict[str, _Assessed] = {}  # the worst beam since the last round
        self._when_good: dict[str, tuple[int, AngleParts]] = {}  # smallest bound while good
        self._unfit: str | None = None

    def next_batch(self, update: Update) -> LinkBatch | None:
        """Return the next batch of links to assess, with their gains; None if none is due.

        Changes nothing. Takes milliseconds, and may run on any thread.
        """
        beams = update.beams.beams
        begun_ns, last_ns = self._round_start_ns, self._last_ns
        begins = begun_ns is None or not 0 <= update.t_ns - begun_ns < EVERY_NS
        waiting = [beam.uav for beam in beams] if begins else self._waiting
        fallen = [beam.uav for beam in beams if self._may_have_fallen(beam)][:FALLEN_AT_ONCE]
        if not begins and not waiting and not fallen:
            return None
        elapsed_ns = 0 if last_ns is None else update.t_ns - last_ns
        share = len(beams) * min(max(elapsed_ns / EVERY_NS, 0.0), 1.0)
        many = max(AT_ONCE, math.ceil(share))
        due = frozenset(waiting[:many])
        early = frozenset(fallen) - due
        which = [i for i, beam in enumerate(beams) if beam.uav in due or beam.uav in early]
        links = [] if update.carrier is None or not which else self._links(update.beams, which)
        return LinkBatch(begins=begins, waiting=waiting[many:], early=early, links=links)

    def _may_have_fallen(self, beam: Beam) -> bool:
        held, before = self.verdicts.get(beam.uav), self._assessed.get(beam.uav)
        if held is None or before is None or held.level is Level.NONE:
            return False
        return before.is_worse(beam)

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
        begins = weighed is not None and weighed.begins
        tracks = {track.uav: track for track in update.tracks}
        fresh = self._of_left_out(update, tracks, evidence, all_of_them=begins)
        if weighed is None and not fresh:
            return []
        if weighed is not None:
            self._waiting = weighed.waiting
            for link in weighed.links:
                self._note_beam(link.beam, is_early=link.beam.uav in weighed.early)
                fresh[link.beam.uav] = self._judge_link(update, link, tracks, evidence)
        if begins:
            self._round_start_ns = update.t_ns
        held = self.verdicts | {
            uav: self._with_hold_time(verdict) for uav, verdict in fresh.items()
        }
        names = dict.fromkeys((*tracks, *(out.uav for out in update.beams.left_out)))
        self.verdicts = {uav: held[uav] for uav in names if uav in held}
        if begins:
            for kept in (self._better_since_ns, self._assessed, self._when_good):
                for uav in [uav for uav in kept if uav not in tracks]:
                    del kept[uav]
        return [] if self._waiting else self._notices(update)

    def _note_beam(self, beam: Beam, *, is_early: bool) -> None:
        """Note how uncertain the beam of an assessed link was; the worst of a round counts."""
        now = _Assessed(
            _or_inf(beam.pointing_bound_rad), _or_inf(beam.pointing_p95_rad), beam.gain_db
        )
        before = self._assessed.get(beam.uav)
        if before is not None and is_early:
            now = _Assessed(
                max(before.bound_rad, now.bound_rad),
                max(before.p95_rad, now.p95_rad),
                min(before.gain_db, now.gain_db),
            )
        self._assessed[beam.uav] = now

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
        if carrier is not None:
            track, known = tracks[uav], evidence(uav)
            parts = angle_parts(link.beam, track, carrier, known.attitude, known.waited_s)
            coasting = track.state is TrackState.COASTING and track.age_s > COASTING_S
            held = self.verdicts.get(uav)
            if level is not Level.GOOD and held and held.blame and _is_enough(link):
                why = held.blame  # only the margin is missing
            elif level is not Level.GOOD:
                when_good = self._when_good.get(uav)
                why = blame.of_beam(
                    link.beam,
                    track,
                    link.needed_db,
                    known,
                    parts,
                    carrier=carrier,
                    when_good=None if when_good is None else when_good[1],
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
        before = self._when_good.get(uav)
        is_old = before is None or t_ns - before[0] > GOOD_KEPT_NS
        if before is None or is_old or sum(parts.values()) <= sum(before[1].values()):
            self._when_good[uav] = (t_ns, parts)

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
        """Return a link's level by its gains; a level rises only with ``MARGIN_DB``."""
        held = self.verdicts.get(uav)
        rank = RANK[held.level] if held else RANK[Level.GOOD]

        def enough(gain_db: float | None, level: Level) -> bool:
            margin_db = 0.0 if rank >= RANK[level] else MARGIN_DB
            return gain_db is not None and gain_db >= needed_db + margin_db

        if enough(sure_db, Level.GOOD):
            return Level.GOOD
        return Level.WEAK if enough(likely_db, Level.WEAK) else Level.NONE

    def _with_hold_time(self, fresh: Verdict) -> Verdict:
        """Return the new verdict; with the current level until a better one has been held."""
        uav, held = fresh.uav, self.verdicts.get(fresh.uav)
        if held is not None and RANK[fresh.level] > RANK[held.level]:
            since_ns = self._better_since_ns.setdefault(uav, fresh.since_ns)
            if fresh.since_ns - since_ns < HOLD_BETTER_NS:
                why = fresh.blame or held.blame
                return replace(fresh, level=held.level, blame=why, since_ns=held.since_ns)
        self._better_since_ns.pop(uav, None)
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
            silent = update.unfit is None and out.cause is Cause.SILENT
            refused = evidence(out.uav).refused if silent else None
            found[out.uav] = Verdict(
                uav=out.uav,
                level=Level.NONE,
                blame=blame.of_left_out(out, tracks.get(out.uav), update.unfit, refused),
                since_ns=update.t_ns,
            )
        return found

    def _notices(self, update: Update) -> list[Notice]:
        """Return notices of changed verdicts; one for all links if the carrier is the cause.

        A change is announced once it has lasted for ``ANNOUNCED_AFTER_NS``, unless the link is
        better again and only its hold time keeps the level.
        """
        was, self._unfit = self._unfit, update.unfit
        if update.unfit is not None:
            text = f"no links: {update.unfit}"
            news = self._noticed and was is None
            self._noticed, self._changed_ns = self.verdicts, {}
            return (
                [Notice(t_ns=update.t_ns, severity=Severity.WARNING, subject="beams", text=text)]
                if news
                else []
            )
        before, self._noticed = self._noticed, dict(self.verdicts)
        changed_ns, self._changed_ns = self._changed_ns, {}
        changed = dict[tuple[Level, Cause | None], list[Verdict]]()
        for uav, verdict in self.verdicts.items():
            held = before.get(uav)
            if held is None or held.level is verdict.level:
                continue
            since_ns = changed_ns.get(uav, update.t_ns)
            is_brief = update.t_ns - since_ns < ANNOUNCED_AFTER_NS or uav in self._better_since_ns
            if verdict.needed_gain_db is not None and is_brief:
                self._noticed[uav], self._changed_ns[uav] = held, since_ns
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


def _is_enough(link: _Link) -> bool:
    return link.guaranteed_db is not None and link.guaranteed_db >= link.needed_db


def _or_inf(angle_rad: float | None) -> float:
    return math.inf if angle_rad is None else angle_rad


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
