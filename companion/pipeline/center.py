"""Carrier of the array, and the local frame, whose origin is fixed or the first report.

Over 300 lines: position, attitude and frame of the carrier change together.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.beams.aim import AIMABLE
from companion.pipeline import assembly
from companion.pipeline.senders import PlacedAttitude, PlacedReport
from companion.settings.center import (
    CenterPlace,
    FixedCenter,
    HomeCenter,
    VehicleCenter,
    parse_center,
)
from companion.settings.model import Settings
from companion.tracking import carrier, extrapolated, noise
from companion.tracking.attitude_evidence import AttitudeTrust
from companion.tracking.attitude_jumps import DOUBT_S, AttitudeJumps
from companion.tracking.extrapolated import ExtrapolatedAttitude
from companion.tracking.geodesy import LocalFrame
from companion.values import (
    AltitudeDatum,
    Attitude,
    AttitudeEvidence,
    Carrier,
    Estimate,
    Fix,
    Notice,
    Refuted,
    Report,
    SenderTime,
    Severity,
    Track,
)

HOME_SETTLING_S: Final = 120.0
"""Time after a track's first report in which its restart may move ``home``, seconds."""
HOME_HEIGHT_M: Final = 20.0  # least error of the first height for which ``home`` moves
ORIGIN_MAX_M: Final = 50_000.0
"""Largest distance of the carrier's first position from the origin.

Farther away, "horizontal" in the local frame and at the carrier differ by more than 0.45 degrees.
"""
NOTICE_RATIO: Final = 1.25
"""Ratio to the attitude bound last reported above which the bound is reported again."""
MIN_CONSISTENT_SAMPLES: Final = 4  # older-stamped attitudes in a row that replace the newest
CONSISTENT_TIME_NS: Final = 500_000_000
"""Least duration of a run of consistent attitudes; resent ones arrive all at once."""
STEP_MISMATCH_MAX_NS: Final = (
    250_000_000  # largest difference between the steps of arrivals and of stamps
)


@dataclass(frozen=True, slots=True)
class _AttitudeRun:
    """Run of consistent attitudes: arrival of the first, arrival and stamp of the last."""

    began_ns: int
    last: tuple[int, int]
    count: int


class CarrierTracker:
    """Tracker of the array's position and attitude.

    place    the fixed station, or the vehicle that is tracked; ``home`` until the first report
    local    the local frame; None before the first report, unless the station is fixed
    vehicle  id of the carrier; None for a station
    """

    def __init__(self, settings: Settings) -> None:
        self.place: CenterPlace = parse_center(settings.center.source or "home")
        self.local: LocalFrame | None = None
        self.vehicle = str(self.place) if isinstance(self.place, VehicleCenter) else None
        self._home_from: tuple[str, int] | None = None  # UAV and time of the first report
        self._attitude: tuple[int, Attitude] | None = None  # sender's time, attitude
        self._before: tuple[int, Attitude] | None = None  # the previous one
        self._jumps = AttitudeJumps()
        self._angular_acceleration = carrier.AngularAcceleration()
        self._older_run: _AttitudeRun | None = None  # attitudes stamped earlier than the newest
        self._least_bound_rad = math.radians(settings.center.attitude_bound_deg)
        self._trust = AttitudeTrust(assembly.attitude_assumptions(settings))
        self._doubted_rad = self._least_bound_rad  # largest bound reported so far
        self._attitude_kept_s = settings.tracks.coasting_s
        self._accuracy_factor = assembly.noise(settings).factor
        self._geoid_m = settings.observer.geoid_m
        self._geoid_error_m = settings.observer.geoid_error_m
        if isinstance(self.place, FixedCenter):
            self._begin(self.place)

    @property
    def needs_home(self) -> bool:
        """Whether the next report sets ``home``."""
        return self.local is None and isinstance(self.place, HomeCenter)

    # --- input ------------------------------------------------------------------------------

    def fix(self, placed: PlacedReport) -> tuple[Fix, tuple[Notice, ...]]:
        """Convert a report to the local frame.

        The first report sets its origin; a notice says where.
        """
        report = self._above_sea_level(placed.report)
        said = (self._set_origin(report),) if self.local is None else ()
        assert self.local is not None
        there = None
        if report.velocity_ne_mps is not None and report.velocity_down_mps is not None:
            there = (*report.velocity_ne_mps, report.velocity_down_mps)
        position, velocity = self.local.localise(
            report.lat_deg, report.lon_deg, report.alt_m, there
        )
        errors = placed.noise
        if errors is None:
            errors = noise.relayed(
                velocity,
                report.alt_age_s,
                speed_max_mps=placed.limits.speed_max_mps,
                accuracy=report.accuracy,
                datum=report.alt_datum,
                factor=self._accuracy_factor,
                geoid_error_m=self._geoid_error_m,
            )
        made = Fix(
            uav=report.uav,
            sender_ns=placed.sender_ns,
            t_ns=placed.t_ns,
            arrival_ns=report.t_ns,
            position_ned_m=position,
            velocity_ned_mps=velocity,
            noise=errors,
            report=report,
            limits=placed.limits,
        )
        return made, said

    def _above_sea_level(self, report: Report) -> Report:
        """Return the report with its height above mean sea level, if the undulation is known."""
        if self._geoid_m is None or report.alt_datum is not AltitudeDatum.GEOMETRIC:
            return report
        above_sea_m = report.alt_m - self._geoid_m
        return report._replace(alt_m=above_sea_m, alt_datum=AltitudeDatum.MSL)

    def turn(
        self, placed: PlacedAttitude, turn_degps2: float
    ) -> tuple[Refuted | None, list[Notice]]:
        """Process an attitude of the carrier, unless it is older than the newest one.

        Returns the refutation of ``turn_degps2``, the largest assumed angular acceleration, if any,
        and a notice of a jump.
        """
        if self._attitude is not None and placed.sender_ns <= self._attitude[0]:
            if not self._is_newest_stamp_wrong(placed):
                return None, []
            self._angular_acceleration = carrier.AngularAcceleration()
            self._attitude = None
        self._older_run = None
        newest = (placed.sender_ns, placed.attitude)
        bounds = self._attitude_bounds(placed.sender_ns, turn_degps2)
        jumped_rad = self._jumps.look(self._attitude, newest, bounds)
        self._before, self._attitude = self._attitude, newest
        self._trust.turned(placed.attitude)
        refuted = self._angular_acceleration.look(placed.attitude, placed.sender_ns, turn_degps2)
        return refuted, [] if jumped_rad is None else [self._jump_notice(jumped_rad)]

    def _jump_notice(self, jumped_rad: float) -> Notice:
        assert self._attitude is not None
        text = (
            f"the attitude of the carrier jumped by {math.degrees(jumped_rad):.0f}°; it is"
            f" uncertain by as much for {DOUBT_S:.0f} s"
        )
        return Notice(
            t_ns=self._attitude[1].t_ns,
            severity=Severity.WARNING,
            subject=self.vehicle or "",
            text=text,
        )

    def _attitude_bounds(self, sender_ns: int, turn_degps2: float) -> carrier.AttitudeBounds:
        limit_degps2 = self._angular_acceleration.limit_degps2(turn_degps2, sender_ns)
        return carrier.AttitudeBounds(self.attitude_bound_rad, math.radians(limit_degps2))

    @property
    def attitude_bound_rad(self) -> float:
        """Bound on the error of the carrier's reported attitudes."""
        return self._trust.bound_rad

    def attitude_age_s(self, now: SenderTime) -> float | None:
        """Return the age of the carrier's newest attitude; None if there is none."""
        return None if self._attitude is None else (now.sender_ns - self._attitude[0]) * 1e-9

    def attitude_parts(
        self, at: SenderTime, turn_degps2: float, waited_s: float
    ) -> carrier.AttitudeParts:
        """Return the parts of the bound on the carrier's attitude at the time ``at``.

        Frames waited ``waited_s`` for this machine. All parts are zero for a station.
        """
        if self._attitude is None:
            return carrier.AttitudeParts()
        made_ns, attitude = self._attitude
        age_s = (at.sender_ns - made_ns) * 1e-9
        rates = (attitude.rollspeed_radps, attitude.pitchspeed_radps, attitude.yawspeed_radps)
        against = self._jumps.against
        return self._attitude_bounds(at.sender_ns, turn_degps2).parts(
            math.hypot(*rates),
            age_s,
            at.bound_s,
            waited_s=waited_s,
            conflict_rad=0.0 if against is None else against.at(abs(age_s) + at.bound_s),
        )

    def trust(self, said: AttitudeEvidence) -> Refuted | None:
        """Process evidence of the error of the carrier's attitudes.

        Returns a refutation if the bound grew.
        """
        self._trust.add(said)
        if self.attitude_bound_rad <= NOTICE_RATIO * self._doubted_rad:
            return None
        self._doubted_rad = self.attitude_bound_rad
        least_deg, doubted_deg = map(math.degrees, (self._least_bound_rad, self._doubted_rad))
        name = "center.attitude_bound_deg"
        return Refuted(
            t_ns=said.t_ns,
            uav=str(said.source),
            setting=name,
            limit=least_deg,
            proven=doubted_deg,
            raised_to=doubted_deg,
        )

    def _is_newest_stamp_wrong(self, placed: PlacedAttitude) -> bool:
        """Return whether a run of older-stamped attitudes shows that the newest has a wrong stamp.

        A newest attitude stamped in the future must not block all later ones. Attitudes from a
        slower link are also older, but then the newest keeps advancing meanwhile.
        """
        at = (placed.attitude.t_ns, placed.sender_ns)
        run = self._older_run
        if run is not None:
            step_ns, sender_step_ns = at[0] - run.last[0], at[1] - run.last[1]
            if sender_step_ns <= 0 or abs(step_ns - sender_step_ns) > STEP_MISMATCH_MAX_NS:
                run = None
        began_ns, count = (at[0], 0) if run is None else (run.began_ns, run.count)
        self._older_run = _AttitudeRun(began_ns, at, count + 1)
        return at[0] - began_ns >= CONSISTENT_TIME_NS and count + 1 >= MIN_CONSISTENT_SAMPLES

    def restarted(self, uav: str) -> None:
        """Discard the carrier's attitude if the carrier rebooted, since its stamps start again."""
        if uav == self.vehicle:
            self._attitude = self._before = None
            self._jumps = AttitudeJumps()
            self._trust.clear()
            self._older_run = None
            self._angular_acceleration = carrier.AngularAcceleration()

    def _set_origin(self, report: Report) -> Notice:
        """Make the first position the origin of the local frame, and ``home``."""
        home = FixedCenter(lat_deg=report.lat_deg, lon_deg=report.lon_deg, alt_m=report.alt_m)
        self._begin(home)
        place = f"{home.lat_deg:.6f}, {home.lon_deg:.6f}, {home.alt_m:.1f} m"
        if self.vehicle is not None:
            text = f"local frame: origin set to {place}"
            return Notice(t_ns=report.t_ns, severity=Severity.INFO, subject="origin", text=text)
        self.place, self._home_from = home, (report.uav, report.t_ns)
        text = f"home set to the first report of {report.uav}: {place}; level, facing north"
        return Notice(t_ns=report.t_ns, severity=Severity.INFO, subject="home", text=text)

    def move_origin(self, report: Report) -> Notice | None:
        """Move the origin to the carrier if its track begins far away; None if it stays.

        The origin was the first report of anybody.
        """
        if self.local is None or report.uav != self.vehicle:
            return None
        there, _ = self.local.localise(report.lat_deg, report.lon_deg, report.alt_m, None)
        away_m = math.hypot(*there)
        if away_m <= ORIGIN_MAX_M:
            return None
        said = self._set_origin(report)
        text = f"{said.text}, {away_m / 1e3:.0f} km from the first report; all tracks restart"
        return Notice(t_ns=said.t_ns, severity=Severity.WARNING, subject="origin", text=text)

    def moved(self, placed: PlacedReport, anew: Estimate) -> Notice | None:
        """Move ``home`` if the track that set it restarts soon at a very different height.

        An autopilot's first height may be wrong. Returns None if home stays.
        """
        if self._home_from is None or anew.fix.uav != self._home_from[0]:
            return None
        if anew.fix.arrival_ns - self._home_from[1] > HOME_SETTLING_S * 1e9:
            self._home_from = None
            return None
        if abs(anew.fix.position_ned_m[2]) < HOME_HEIGHT_M:
            return None
        said = self._set_origin(placed.report)
        text = f"home moved, because the first height was wrong: {said.text}"
        return Notice(t_ns=said.t_ns, severity=Severity.WARNING, subject="home", text=text)

    def _begin(self, at: FixedCenter) -> None:
        self.local = LocalFrame(at.lat_deg, at.lon_deg, at.alt_m)

    @property
    def has_attitude(self) -> bool:
        """Whether an attitude was reported."""
        return self._attitude is not None

    @property
    def is_contradicted(self) -> bool:
        """Whether the newest attitude contradicts the previous one."""
        return self._jumps.newest is not None

    def newest_attitude_ns(self, now: SenderTime) -> int | None:
        """Return when the newest attitude was measured, node time; None without one."""
        if self.vehicle is None:
            return now.node_ns
        return None if self._attitude is None else self._attitude[0] + now.node_ns - now.sender_ns

    def fixed_pose(self, at_ns: int) -> ExtrapolatedAttitude | None:
        """Return the attitude of a fixed station; None while its place is unknown."""
        found = self.station(at_ns)
        return None if isinstance(found, str) else extrapolated.of_station(found.body_from_local)

    def pose(
        self, newest: Fix | None, at: SenderTime, turn_degps2: float, *, nearest: bool
    ) -> ExtrapolatedAttitude | None:
        """Return the reported attitude at a time on the vehicle's timeline; None if unknown.

        ``nearest``: by whichever of the two newest reports is nearer; else by the newest.
        """
        if self.local is None or self._attitude is None or newest is None:
            return None
        made_ns, attitude = self._attitude
        against = self._jumps.against
        if nearest and self._before is not None:
            before_ns = self._before[0]
            if abs(at.sender_ns - before_ns) < abs(at.sender_ns - made_ns):
                made_ns, attitude = self._before
        return extrapolated.extrapolated(
            attitude,
            age_s=(at.sender_ns - made_ns) * 1e-9,
            doubt_s=at.bound_s,
            bounds=self._attitude_bounds(at.sender_ns, turn_degps2),
            contradicted=against,
            local_from_ned=self.local.local_from_ned(newest.report.lat_deg, newest.report.lon_deg),
        )

    # --- pose of the array ------------------------------------------------------------------

    def station(self, valid_at_ns: int) -> Carrier | str:
        """Return the carrier for a fixed station, or the reason why its position is unknown."""
        at = self.place
        if self.local is None or not isinstance(at, FixedCenter):
            return "no report yet"
        place = (at.lat_deg, at.lon_deg, at.alt_m)
        return carrier.fixed(valid_at_ns, self.local, place, math.radians(at.heading_deg))

    def on_vehicle(
        self,
        track: Track | None,
        newest: Fix | None,
        now: SenderTime,
        at: SenderTime,
        turn_degps2: float,
    ) -> Carrier | str:
        """Return the carrier aboard the vehicle, or the reason why its pose is unknown.

            track        the carrier's track at the time ``at``; None if it has none
            newest       its newest accepted report
            now          the present
            at           the requested time
            turn_degps2  largest assumed angular acceleration

        Times are on the vehicle's timeline.
        """
        if self.local is None:
            return "no report yet"
        if track is None or newest is None:
            return f"no position from the carrier {self.vehicle}"
        if track.state not in AIMABLE:
            return f"the carrier {self.vehicle} is {track.state}"
        if self._attitude is None:
            return f"no attitude from the carrier {self.vehicle}"
        made_ns, attitude = self._attitude
        if now.sender_ns - made_ns > self._attitude_kept_s * 1e9:
            return f"the attitude of the carrier {self.vehicle} is too old"
        bounds = self._attitude_bounds(at.sender_ns, turn_degps2)
        since_ns = at.sender_ns - made_ns
        return carrier.moving(
            self.local,
            track,
            newest,
            attitude=attitude,
            since_ns=since_ns,
            doubt_s=at.bound_s,
            bounds=bounds,
            contradicted=self._jumps.against,
        )
