"""Aircraft with transponders, and the ADS-B receivers that relay them.

An aircraft sends a squitter about once a second. A receiver misses single squitters, and at times
all of several seconds. The receiver sends the last squitter repeatedly, with only the whole seconds
since (``tslc``) changed, until it is too old. The numbers come from docs/field-notes.md 1,
"ADSB_VEHICLE". Pure: random numbers depend on the seed, the aircraft and the receiver.
"""

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntFlag
from typing import Final, NamedTuple

from companion.values import AltitudeDatum, UavKind
from sitl_replay.flight.motion import Motion

SQUITTER_INTERVAL_S: Final = 1.0
SQUITTER_JITTER_S: Final = 0.05
MISSED_SHARE: Final = 0.15  # share of squitters that are missed singly
OUTAGE_SHARE: Final = 0.02  # share of squitters that start a time without reception
OUTAGE_S: Final = (3.0, 5.0)  # minimum and maximum of that time
RELAY_INTERVAL_S: Final = (0.2, 2.6)  # minimum and maximum between two relayed messages
CONTENT_AGE_MAX_S: Final = 3.0
"""Age above which content is not sent again; a receiver is then never silent for 10 s."""
GARBAGE_OCTETS: Final = 38  # length of the payload of ADSB_VEHICLE


class Valid(IntFlag):
    """Flags of valid fields in ADSB_VEHICLE (ADSB_FLAGS)."""

    COORDS = 1
    ALTITUDE = 2
    HEADING = 4
    VELOCITY = 8
    CALLSIGN = 16
    SQUAWK = 32
    VERTICAL_VELOCITY = 128


EVERYTHING: Final = Valid(0b1011_1111)


@dataclass(frozen=True, slots=True, kw_only=True)
class Aircraft:
    """Aircraft: its motion (NED from the carrier) and what its transponder reports.

        placeless_share  share of squitters without a position (only altitude and squawk), like
                         Mode S replies

    ``str`` gives the UAV id.
    """

    icao: int  # 24-bit address
    callsign: str  # callsign
    emitter_type: int  # ADSB_EMITTER_TYPE
    trajectory: Callable[[float], Motion]  # position and velocity at a time
    datum: AltitudeDatum  # pressure or geometric altitude
    says: Valid = EVERYTHING  # flags of the fields that it sets
    placeless_share: float = 0.0
    squawk: int = 7000  # squawk

    def __str__(self) -> str:
        return UavKind.ADSB.uav(f"{self.icao:06X}")


class Contact(NamedTuple):
    """Received squitter: time, valid fields, and the content of the other fields."""

    aircraft: Aircraft
    t_s: float
    valid: Valid
    garbage: bytes


class Relayed(NamedTuple):
    """Contact that is relayed at ``t_s``, ``tslc_s`` whole seconds after its reception."""

    t_s: float
    contact: Contact
    tslc_s: int


def squitters(aircraft: Aircraft, seed: int) -> Iterator[Contact]:
    """Yield the squitters of an aircraft (endless), the same for every receiver."""
    rng = random.Random(f"{seed} {aircraft} squitters")
    t_s = rng.uniform(0.0, SQUITTER_INTERVAL_S)
    while True:
        placeless = rng.random() < aircraft.placeless_share
        bare = aircraft.says & (Valid.ALTITUDE | Valid.SQUAWK)
        jittered_s = t_s + rng.uniform(0.0, SQUITTER_JITTER_S)
        garbage = rng.randbytes(GARBAGE_OCTETS)
        yield Contact(
            aircraft=aircraft,
            t_s=jittered_s,
            valid=bare if placeless else aircraft.says,
            garbage=garbage,
        )
        t_s += SQUITTER_INTERVAL_S


def heard(aircraft: Aircraft, receiver: str, seed: int) -> Iterator[Contact]:
    """Yield the squitters of an aircraft that a receiver receives (endless).

    After a missed squitter, and after a time without reception, the next one is received.
    """
    rng = random.Random(f"{seed} {receiver} hears {aircraft}")
    outage_end_s = 0.0
    certain = True
    for contact in squitters(aircraft, seed):
        if contact.t_s < outage_end_s:
            continue
        chance = rng.random()
        if certain or chance >= MISSED_SHARE + OUTAGE_SHARE:
            certain = False
            yield contact
            continue
        certain = True
        if chance < OUTAGE_SHARE:
            outage_end_s = contact.t_s + rng.uniform(*OUTAGE_S)


def relayed(aircraft: Aircraft, receiver: str, seed: int) -> Iterator[Relayed]:
    """Yield the messages about an aircraft that a receiver relays (endless), by time."""
    rng = random.Random(f"{seed} {receiver} relays {aircraft}")
    contacts = heard(aircraft, receiver, seed)
    last, after = next(contacts), next(contacts)
    t_s = last.t_s
    while True:
        t_s += rng.uniform(*RELAY_INTERVAL_S)
        while after.t_s <= t_s:
            last, after = after, next(contacts)
        age_s = t_s - last.t_s
        if age_s <= CONTENT_AGE_MAX_S:
            yield Relayed(t_s, last, int(age_s))
