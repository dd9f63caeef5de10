"""Settings of the senders' clocks and of the observer."""

from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, PositiveFloat

from companion.settings.section import Section


class ClockSettings(Section):
    """How senders' boot clocks are put on the node's timeline.

        constant_delay_s  least age of a report on arrival, seconds: the link's smallest latency,
                          which one-way observation cannot show. Used only while the envelope of the
                          arrivals is all there is: TIMESYNC or trusted GNSS time takes its place
        window_s          how far back the lower envelope of the arrivals looks, seconds
        trust_gnss        believe SYSTEM_TIME where it passes its checks
        node_utc_error_s  bound on the error of the node's own UTC, seconds; needed by
                          ``trust_gnss``

    By how much a position is older or newer than its own stamp is covered by none of these.
    Simulated ArduPilot copters lag by 28 ms, aeroplanes lead by about 29 ms (docs/field-notes.md
    1); ``observer.position_noise_m`` has to hold that. See docs/math.md 6.
    """

    constant_delay_s: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.01
    window_s: Annotated[float, Field(ge=5, le=3600)] = 60.0
    trust_gnss: bool = False
    node_utc_error_s: Annotated[float, Field(ge=0, le=10)] | None = None


class ObserverSettings(Section):
    """The observer and the bounds that it relies on, which must never be exceeded.

    model                  "kinematic" (acceleration unknown) or "position" (velocity unknown)
    alpha                  decay rate of the position model's certificate, or "auto"
    feedthrough_s          position model: time by which a report leads the position, seconds
    velocity_lead_s        position model: least lead made from a reported velocity, seconds
    feed_forward           kinematic model: feed an estimated acceleration forward
    design                 kinematic model: file of gains written by ``companion design --model
                           kinematic --out``, which is read into ``design_json``
    design_json            the gains themselves
    speed_max_mps          greatest speed, norm of a 3-vector
    acceleration_max_mps2  greatest acceleration, norm of a 3-vector
    position_noise_m       greatest error of a reported position, norm of a 3-vector
    velocity_noise_mps     greatest error of a reported velocity, norm of a 3-vector
    follow_accuracy        where the autopilot states its accuracy (GPS_RAW_INT), use
    accuracy_factor        this many times that accuracy as the noise instead
    """

    model: Literal["kinematic", "position"] = "kinematic"
    alpha: Literal["auto"] | Annotated[float, Field(gt=0, lt=1)] = "auto"
    feedthrough_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    velocity_lead_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    feed_forward: bool = True
    design: str | None = None
    design_json: str | None = None
    speed_max_mps: PositiveFloat = 60.0
    acceleration_max_mps2: PositiveFloat = 5.0
    position_noise_m: PositiveFloat = 3.0
    velocity_noise_mps: PositiveFloat = 0.5
    follow_accuracy: bool = True
    accuracy_factor: PositiveFloat = 3.0
