"""Notices of changed verdicts: one for all links that changed alike, and none for brief changes."""

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Final, NamedTuple

from companion.values import Cause, Level, Notice, Severity, Update, Verdict

ANNOUNCED_AFTER_NS: Final = 1_000_000_000
"""Time for which a link must have another level than the last announced one for a notice."""
NAMED: Final = 6  # largest number of UAVs named in one notice


class _Announced(NamedTuple):
    """Level that was announced last, and since when the link has had another one."""

    level: Level
    changed_ns: int | None


class VerdictNotices:
    """Notices of the changes since the last call of ``due``."""

    def __init__(self) -> None:
        self._announced: dict[str, _Announced] = {}
        self._was_unfit = False

    def due(
        self, update: Update, verdicts: Mapping[str, Verdict], rising: AbstractSet[str]
    ) -> list[Notice]:
        """Return notices of changed verdicts; one for all links if the carrier is the cause.

        A change is announced once it has lasted for ``ANNOUNCED_AFTER_NS``, unless the link is one
        of the ``rising`` ones, which only their hold time keeps at a level.
        """
        if update.unfit is not None:
            is_news = bool(self._announced) and not self._was_unfit
            self._was_unfit = True
            self._announced = {uav: _Announced(one.level, None) for uav, one in verdicts.items()}
            text = f"no links: {update.unfit}"
            notice = Notice(t_ns=update.t_ns, severity=Severity.WARNING, subject="beams", text=text)
            return [notice] if is_news else []
        self._was_unfit = False
        before, self._announced = self._announced, {}
        changed = dict[tuple[Level, Cause | None], list[Verdict]]()
        for uav, verdict in verdicts.items():
            last = before.get(uav)
            self._announced[uav] = _Announced(verdict.level, None)
            if last is None or last.level is verdict.level:
                continue
            changed_ns = update.t_ns if last.changed_ns is None else last.changed_ns
            is_brief = uav in rising or update.t_ns - changed_ns < ANNOUNCED_AFTER_NS
            if verdict.needed_gain_db is not None and is_brief:
                self._announced[uav] = _Announced(last.level, changed_ns)
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
