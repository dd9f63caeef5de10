"""Aircraft with transponders, and the ADS-B receivers that relay them: who is heard when.

An aircraft squitters about once a second. A receiver misses some squitters, and sometimes all for
several seconds. It sends what it heard last again and again, with unchanged content but for the
whole seconds since (``tslc``), until that is too old. The figures come from docs/field-notes.md 1,
"ADSB_VEHICLE". Pure: the chances come from the seed, the aircraft and the receiver.
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
MISSED_SHARE: Final = 0.15  # share of squitters that are missed one at a time
DEAF_SHARE: Final = 0.02  # share of squitters that begin a time in which none is heard
DEAF_S: Final = (3.0, 5.0)  # shortest and longest such time
RELAY_INTERVAL_S: Final = (0.2, 2.6)  # shortest and longest time between two relayed messages
OLDEST_S: Final = 3.0
"""Age beyond which content is not sent again.

With the rest, a receiver is never silent for 10 s.
"""
GARBAGE_OCTETS: Final = 38  # length of the payload of ADSB_VEHICLE


class Valid(IntFlag):
    """ADSB_FLAGS: which fields of ADSB_VEHICLE count."""

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
    """An aircraft: how it flies (NED from the carrier) and what its transponder says of that.

        placeless_share  share of squitters without a position (only altitude and squawk), as Mode S
                         replies are

    ``str`` gives the UAV id.
    """

    icao: int  # 24-bit address
    callsign: str  # its callsign
    emitter_type: int  # ADSB_EMITTER_TYPE
    trajectory: Callable[[float], Motion]  # position and velocity at a time
    datum: AltitudeDatum  # pressure or geometric altitude
    says: Valid = EVERYTHING  # flags of the fields that it fills
    placeless_share: float = 0.0
    squawk: int = 7000  # its squawk

    def __str__(self) -> str:
        return UavKind.ADSB.uav(f"{self.icao:06X}")


class Contact(NamedTuple):
    """A squitter that was heard: when, which fields count, and what stands in the others."""

    aircraft: Aircraft
    t_s: float
    valid: Valid
    garbage: bytes


class Relayed(NamedTuple):
    """A contact that is relayed at ``t_s``, ``tslc_s`` whole seconds after it was heard."""

    t_s: float
    contact: Contact
    tslc_s: int


def squitters(aircraft: Aircraft, seed: int) -> Iterator[Contact]:
    """The squitters of an aircraft, without end: the same for every receiver."""
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
    """The squitters of an aircraft that a receiver hears, without end.

    After a miss, and after a deaf time, the next squitter is heard.
    """
    rng = random.Random(f"{seed} {receiver} hears {aircraft}")
    deaf_until_s = 0.0
    certain = True
    for contact in squitters(aircraft, seed):
        if contact.t_s < deaf_until_s:
            continue
        chance = rng.random()
        if certain or chance >= MISSED_SHARE + DEAF_SHARE:
            certain = False
            yield contact
            continue
        certain = True
        if chance < DEAF_SHARE:
            deaf_until_s = contact.t_s + rng.uniform(*DEAF_S)


def relayed(aircraft: Aircraft, receiver: str, seed: int) -> Iterator[Relayed]:
    """The messages that a receiver relays of an aircraft, without end, in order of time."""
    rng = random.Random(f"{seed} {receiver} relays {aircraft}")
    contacts = heard(aircraft, receiver, seed)
    last, after = next(contacts), next(contacts)
    t_s = last.t_s
    while True:
        t_s += rng.uniform(*RELAY_INTERVAL_S)
        while after.t_s <= t_s:
            last, after = after, next(contacts)
        age_s = t_s - last.t_s
        if age_s <= OLDEST_S:
            yield Relayed(t_s, last, int(age_s))
