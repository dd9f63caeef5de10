"""Settings of the senders' clocks and of the observer."""

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from companion.settings.section import Section, UavName
from companion.values import UserError


class ClockSettings(Section):
    """Settings of how senders' boot clocks are mapped to the node's timeline.

        constant_delay_s  smallest latency of the link if it is known, seconds: one-way traffic
                          cannot show it. TIMESYNC or trusted GNSS time replaces it
        drift_max_ppm     largest assumed drift of a boot clock against the node's; raised for a
                          sender whose messages prove more
        window_s          time over which latencies are sampled, seconds
        trust_gnss        use SYSTEM_TIME if it passes its checks
        node_utc_error_s  bound on the error of the node's own UTC, seconds; needed by
                          ``trust_gnss``
        apart_s           largest error of all times of a UAV relative to other UAVs, seconds, by
                          UAV id; a replay of onboard logs sets it

    ``observer.lag_s`` is the age of a position relative to its own stamp. See docs/math.md 6.
    """

    constant_delay_s: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.0
    drift_max_ppm: Annotated[FiniteFloat, Field(ge=0, le=20_000)] = 250.0
    window_s: Annotated[float, Field(ge=5, le=3600)] = 60.0
    trust_gnss: bool = False
    node_utc_error_s: Annotated[float, Field(ge=0, le=10)] | None = None
    apart_s: dict[UavName, Annotated[float, Field(ge=0, le=10)]] = Field(default_factory=dict)


Lag = tuple[
    Annotated[FiniteFloat, Field(ge=-1, le=10)], Annotated[FiniteFloat, Field(ge=-1, le=10)]
]


class LimitSettings(Section):
    """Assumptions about some aircraft; an unset key has the value for the other aircraft.

    speed_max_mps          largest speed, norm of a 3-vector
    acceleration_max_mps2  largest acceleration, norm of a 3-vector
    lag_s                  least and largest time by which a reported position is older than its
                           stamp, seconds; negative: it is the aircraft's later position
    """

    speed_max_mps: Annotated[float, Field(gt=0, le=1e5)] | None = None
    acceleration_max_mps2: Annotated[float, Field(gt=0, le=1e5)] | None = None
    lag_s: Lag | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.lag_s is not None and self.lag_s[0] > self.lag_s[1]:
            raise UserError("lag_s is out of order: give [least, largest]")
        return self


AirframeName = Literal["copter", "aeroplane", "vtol", "helicopter", "rover", "unknown", "adsb"]


class ObserverSettings(LimitSettings):
    """Settings of the observer, and the bounds that it assumes.

    If a UAV's reports refute a bound, it is raised for this UAV and a notice is published.

    model                  "kinematic" (acceleration unknown) or "position" (velocity unknown)
    alpha                  decay rate of the position model's certificate, or "auto"
    feedthrough_s          position model: time by which a report leads the position, seconds;
                           negative: it lags
    velocity_lead_s        position model: least lead derived from a reported velocity, seconds
    feed_forward           kinematic model: feed an estimated acceleration forward
    design                 kinematic model: file of gains written by ``companion design --model
                           kinematic --out``
    speed_max_mps          largest speed, norm of a 3-vector; None: by the type of aircraft
    acceleration_max_mps2  largest acceleration, norm of a 3-vector; None: likewise
    lag_s                  least and largest lag of positions, seconds; None: by autopilot and type
    types                  these three for one type of aircraft, by its HEARTBEAT: copter,
                           aeroplane, vtol, helicopter, rover, unknown; adsb without one
    uav                    these three for one UAV, by its id
    position_noise_m       largest error of a reported position, norm of a 3-vector
    velocity_noise_mps     largest error of a reported velocity, norm of a 3-vector
    follow_accuracy        if the autopilot reports its accuracy (GPS_RAW_INT), derive the noise
                           from it, for 10 s after each report
    accuracy_factor        noise bound as a multiple of that accuracy
    geoid_m                height of mean sea level above the ellipsoid in the area of flight,
                           metres (the undulation, by EGM96 or EGM2008), which converts heights
                           above the ellipsoid to mean sea level; None: no conversion, wider bounds
    geoid_error_m          largest error of ``geoid_m`` over the whole area
    """

    model: Literal["kinematic", "position"] = "kinematic"
    alpha: Literal["auto"] | Annotated[float, Field(gt=0, lt=1)] = "auto"
    feedthrough_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    velocity_lead_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    feed_forward: bool = True
    design: str | None = None
    types: dict[AirframeName, LimitSettings] = Field(default_factory=dict)
    uav: dict[UavName, LimitSettings] = Field(default_factory=dict)
    position_noise_m: Annotated[float, Field(gt=0, le=1e5)] = 3.0
    velocity_noise_mps: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    follow_accuracy: bool = True
    accuracy_factor: Annotated[float, Field(gt=0, le=1000)] = 3.0
    geoid_m: Annotated[float, Field(ge=-120, le=100)] | None = None
    geoid_error_m: Annotated[float, Field(ge=0, le=120)] = 5.0
