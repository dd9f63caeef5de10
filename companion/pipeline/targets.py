"""Targets: the tracks for which beams are wanted, and the notices when their states change."""

from collections.abc import Iterable, Mapping

from companion.settings.model import Settings
from companion.tracking.identity import Identities
from companion.values import Duty, Notice, Severity, TrackState, kind_of


class Targets:
    """Decides for which UAVs beams are wanted.

    ``identities`` tells which relayed aircraft is which better known track: two beams on one
    aircraft would make zero forcing all but singular.

    Wanted are UAVs that report themselves, relayed aircraft only if the settings say so, and never
    the carrier (``carrier`` is its id, None for a station). Of a fleet's node it is those that are
    its ``duty``; None: there is no fleet.
    """

    def __init__(self, settings: Settings, carrier: str | None) -> None:
        self._carrier = carrier
        self._all = settings.beams.targets == "all"
        self._dropped_s = settings.tracks.dropped_s
        self.identities = Identities()
        self._states: dict[str, TrackState] = {}
        self.duty: Duty | None = None

    def wants(self, uav: str) -> bool:
        """Whether a beam is wanted for this UAV."""
        if uav == self._carrier or self.identities.same_as(uav) is not None:
            return False
        return self._all or kind_of(uav).reports_itself

    def among(self, uavs: Iterable[str]) -> list[str]:
        """The UAVs for which beams are wanted, in the order given."""
        wanted = [uav for uav in uavs if self.wants(uav)]
        if self.duty is None:
            return wanted
        served = frozenset(self.duty.serves)
        return [uav for uav in wanted if uav in served]

    def protected(self, uavs: Iterable[str]) -> list[str]:
        """UAVs of other nodes that nulls are to protect, in the order given."""
        spares = frozenset(self.duty.spares if self.duty else ())
        return [uav for uav in uavs if uav in spares and self.wants(uav)]

    def better_known(self, uav: str, others: Iterable[str]) -> list[str]:
        """Those of the others by which a relayed aircraft would rather be known.

        Telemetry before Remote ID, ADS-B and Cursor on Target, in this order; tracks already
        merged into another one are excluded.
        """
        own = kind_of(uav).rank
        same_as = self.identities.same_as
        return [one for one in others if kind_of(one).rank < own and same_as(one) is None]

    def forget(self, uav: str) -> None:
        """Forget a UAV that is dropped: its state, and what it was compared with if relayed."""
        self.identities.forget(uav)
        self._states.pop(uav, None)

    # --- what is said of them ---------------------------------------------------------------

    def changes(self, now_ns: int, states: Mapping[str, TrackState]) -> list[Notice]:
        """One notice for each target, or the carrier, whose state changed since the last call."""
        changed = [uav for uav, state in states.items() if self._states.get(uav) is not state]
        elsewhere = {} if self.duty is None else self._states  # whom another node served meanwhile
        self._states = {**elsewhere, **states}
        notices = []
        for uav in changed:
            bad = states[uav] in (TrackState.STALE, TrackState.LOST)
            severity = Severity.WARNING if bad else Severity.INFO
            notices.append(
                Notice(t_ns=now_ns, severity=severity, subject=uav, text=f"{uav} is {states[uav]}")
            )
        return notices

    def dropped(self, now_ns: int, silent: Iterable[str]) -> list[Notice]:
        """One notice for each target that is dropped.

        Relayed traffic that is no target goes unmentioned.
        """
        return [
            Notice(
                t_ns=now_ns,
                severity=Severity.INFO,
                subject=uav,
                text=f"{uav} is dropped: nothing of it for {self._dropped_s:.0f} s",
            )
            for uav in self.among(silent)
        ]
