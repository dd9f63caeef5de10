"""Settings of the senders' clocks and of the observer."""

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from companion.settings.section import Section
from companion.values import UserError


class ClockSettings(Section):
    """How senders' boot clocks are put on the node's timeline.

        constant_delay_s  the link's smallest latency where it is known, seconds: one-way
                          observation cannot show it. TIMESYNC or trusted GNSS time takes its place
        drift_max_ppm     greatest drift of a boot clock against the node's that is taken for
                          possible; grows for a sender whose messages prove more
        window_s          how far back latencies are sampled, seconds
        trust_gnss        believe SYSTEM_TIME where it passes its checks
        node_utc_error_s  bound on the error of the node's own UTC, seconds; needed by
                          ``trust_gnss``
        apart_s           most that all times of a UAV may be off beside those of others, seconds,
                          by its id: a replay of vehicles' own logs says it of each

    By how much a position is older or newer than its own stamp is ``observer.lag_s``. See
    docs/math.md 6.
    """

    constant_delay_s: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.0
    drift_max_ppm: Annotated[FiniteFloat, Field(ge=0, le=20_000)] = 250.0
    window_s: Annotated[float, Field(ge=5, le=3600)] = 60.0
    trust_gnss: bool = False
    node_utc_error_s: Annotated[float, Field(ge=0, le=10)] | None = None
    apart_s: dict[str, Annotated[float, Field(ge=0, le=10)]] = Field(default_factory=dict)


Lag = tuple[
    Annotated[FiniteFloat, Field(ge=-1, le=10)], Annotated[FiniteFloat, Field(ge=-1, le=10)]
]


class LimitSettings(Section):
    """What is assumed of some aircraft; what is not given is as for the others.

    speed_max_mps          greatest speed, norm of a 3-vector
    acceleration_max_mps2  greatest acceleration, norm of a 3-vector
    lag_s                  least and greatest time by which a reported position is older than its
                           stamp, seconds; negative: it is where the aircraft will be
    """

    speed_max_mps: Annotated[float, Field(gt=0, le=1e5)] | None = None
    acceleration_max_mps2: Annotated[float, Field(gt=0, le=1e5)] | None = None
    lag_s: Lag | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.lag_s is not None and self.lag_s[0] > self.lag_s[1]:
            raise UserError("lag_s is the least and the greatest lag, in this order")
        return self


AirframeName = Literal["copter", "aeroplane", "vtol", "helicopter", "rover", "unknown", "adsb"]


class ObserverSettings(LimitSettings):
    """The observer and the bounds that it relies on.

    Where reports refute a bound it is raised for their UAV, and that is said.

    model                  "kinematic" (acceleration unknown) or "position" (velocity unknown)
    alpha                  decay rate of the position model's certificate, or "auto"
    feedthrough_s          position model: time by which a report leads the position, seconds
    velocity_lead_s        position model: least lead made from a reported velocity, seconds
    feed_forward           kinematic model: feed an estimated acceleration forward
    design                 kinematic model: file of gains written by ``companion design --model
                           kinematic --out``
    speed_max_mps          greatest speed, norm of a 3-vector; None: by the type of aircraft
    acceleration_max_mps2  greatest acceleration, norm of a 3-vector; None: likewise
    lag_s                  least and greatest lag of positions, seconds; None: by autopilot and type
    types                  the same three for one type of aircraft, by its HEARTBEAT: copter,
                           aeroplane, vtol, helicopter, rover, unknown; adsb without one
    uav                    the same three for one UAV, by its id
    position_noise_m       greatest error of a reported position, norm of a 3-vector
    velocity_noise_mps     greatest error of a reported velocity, norm of a 3-vector
    follow_accuracy        where the autopilot states its accuracy (GPS_RAW_INT), use
    accuracy_factor        this many times that accuracy as the noise instead
    geoid_m                height of mean sea level above the ellipsoid where this flies, metres
                           (the undulation, by EGM96 or EGM2008): heights above the ellipsoid are
                           brought to mean sea level by it; None: they stay, with wider bounds
    geoid_error_m          most that it is off, over all of the area
    """

    model: Literal["kinematic", "position"] = "kinematic"
    alpha: Literal["auto"] | Annotated[float, Field(gt=0, lt=1)] = "auto"
    feedthrough_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    velocity_lead_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    feed_forward: bool = True
    design: str | None = None
    types: dict[AirframeName, LimitSettings] = Field(default_factory=dict)
    uav: dict[str, LimitSettings] = Field(default_factory=dict)
    position_noise_m: Annotated[float, Field(gt=0, le=1e5)] = 3.0
    velocity_noise_mps: Annotated[float, Field(gt=0, le=1e4)] = 0.5
    follow_accuracy: bool = True
    accuracy_factor: Annotated[float, Field(gt=0, le=1000)] = 3.0
    geoid_m: Annotated[float, Field(ge=-120, le=100)] | None = None
    geoid_error_m: Annotated[float, Field(ge=0, le=120)] = 5.0
