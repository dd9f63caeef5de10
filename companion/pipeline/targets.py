"""Targets: the UAVs for which beams are wanted, and notices when their states change."""

from collections.abc import Iterable, Mapping
from functools import lru_cache

from companion.settings.model import Settings
from companion.tracking.identity import Identities
from companion.values import Duty, Notice, Severity, TrackState, kind_of


@lru_cache(maxsize=4096)
def _reports_itself(uav: str) -> bool:
    return kind_of(uav).reports_itself


class Targets:
    """Selection of the UAVs for which beams are wanted.

    ``identities`` maps relayed aircraft to better tracks of the same aircraft: two beams on one
    aircraft would make zero forcing nearly singular.

    Beams are wanted for UAVs that report themselves, for relayed aircraft only if the settings say
    so, and never for the carrier (``carrier`` is its id, None for a station). In a fleet, they are
    limited to this node's ``duty``; None: no fleet.
    """

    def __init__(self, settings: Settings, carrier: str | None) -> None:
        self._carrier = carrier
        self._all = settings.beams.targets == "all"
        self._dropped_s = settings.tracks.dropped_s
        self.identities = Identities()
        self._states: dict[str, TrackState] = {}
        self.duty: Duty | None = None

    def wants(self, uav: str) -> bool:
        """Return whether a beam is wanted for this UAV."""
        return bool(self._wanted((uav,)))

    def among(self, uavs: Iterable[str]) -> list[str]:
        """Return the UAVs for which beams are wanted, in the order given."""
        wanted = self._wanted(uavs)
        if self.duty is None:
            return wanted
        served = frozenset(self.duty.serves)
        return [uav for uav in wanted if uav in served]

    def _wanted(self, uavs: Iterable[str]) -> list[str]:
        """Return the UAVs for which beams are wanted by any node; of thousands at every tick."""
        merged, carrier, all_kinds = self.identities.merged, self._carrier, self._all
        return [
            uav
            for uav in uavs
            if uav not in merged and (all_kinds or _reports_itself(uav)) and uav != carrier
        ]

    def protected(self, uavs: Iterable[str]) -> list[str]:
        """Return the UAVs of other nodes to be protected by nulls, in the order given."""
        if self.duty is None or not self.duty.spares:
            return []
        spares = frozenset(self.duty.spares)
        return [uav for uav in uavs if uav in spares and self.wants(uav)]

    def unmerged(self, uavs: Iterable[str]) -> list[str]:
        """Return those of some UAVs that are not merged into a better track."""
        return [uav for uav in uavs if uav not in self.identities.merged]

    def forget(self, uav: str) -> None:
        """Forget a dropped UAV: its state, and its comparisons if it is relayed."""
        self.identities.forget(uav)
        self._states.pop(uav, None)

    # --- notices ----------------------------------------------------------------------------

    def changes(self, now_ns: int, states: Mapping[str, TrackState]) -> list[Notice]:
        """Note the states of targets and the carrier; return notices of those that changed.

        Aircraft that were taken for one that is now too old for a beam are separated from it.
        """
        changed = [uav for uav, state in states.items() if self._states.get(uav) is not state]
        elsewhere = (
            {} if self.duty is None else self._states
        )  # UAVs that other nodes served meanwhile
        self._states = {**elsewhere, **states}
        notices = []
        for uav in changed:
            bad = states[uav] in (TrackState.STALE, TrackState.LOST)
            if bad:
                self.identities.separate(uav)
            severity = Severity.WARNING if bad else Severity.INFO
            notices.append(
                Notice(t_ns=now_ns, severity=severity, subject=uav, text=f"{uav} is {states[uav]}")
            )
        return notices

    def dropped(self, now_ns: int, silent: Iterable[str]) -> list[Notice]:
        """Return a notice for each dropped target; none for other traffic."""
        return [
            Notice(
                t_ns=now_ns,
                severity=Severity.INFO,
                subject=uav,
                text=f"{uav} is dropped: no usable report for {self._dropped_s:.0f} s",
            )
            for uav in self.among(silent)
        ]
