"""Requested receiver: the values of ``--receive``, as ``NAME=VALUE``. Pure."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from companion.values import UserError
from companion.values.errors import shown
from sitl_replay.faults.asked import Bound, Kind, described
from sitl_replay.receiver.model import ReceiverModel

_SHARE: Final = Bound(letter="P", low=0.0, high=1.0)
_ANGLES: Final = tuple(Bound(letter=letter, low=-180.0, high=180.0) for letter in "RPY")

OPTIONS: Final = {
    kind.name: kind
    for kind in (
        Kind(
            name="rate",
            bounds=(Bound(letter="HZ", low=0.01, high=1000.0),),
            meaning="measurements of each UAV per second (default 10)",
            example="rate=20",
        ),
        Kind(
            name="bound",
            bounds=(Bound(letter="DEG", low=0.001, high=90.0),),
            meaning="stated bound on the error of a direction (default 2); the error is random"
            " within it",
            example="bound=1.5",
        ),
        Kind(
            name="bias",
            bounds=(Bound(letter="DEG", low=0.0, high=90.0),),
            meaning="constant part of that error, a rotation about a fixed axis; at most the bound",
            example="bias=1",
        ),
        Kind(
            name="mount",
            bounds=_ANGLES,
            meaning="roll, pitch and yaw of the array on the carrier in degrees, as in the"
            " service's settings",
            example="mount=0:-10:90",
        ),
        Kind(
            name="mount-error",
            bounds=_ANGLES,
            meaning="further rotation of the true array in degrees, which the settings do not have",
            example="mount-error=0.5:-1:2",
        ),
        Kind(
            name="outliers",
            bounds=(_SHARE,),
            meaning="share of measurements that are reflections, from anywhere within 60 degrees",
            example="outliers=0.1",
        ),
        Kind(
            name="swapped",
            bounds=(_SHARE,),
            meaning="share of measurements under the id of another UAV",
            example="swapped=0.05",
        ),
        Kind(
            name="lost",
            bounds=(_SHARE,),
            meaning="share of measurements that are not sent",
            example="lost=0.2",
        ),
        Kind(
            name="silent",
            bounds=(Bound(letter="T", low=0.0, high=1e6), Bound(letter="S", low=0.0, high=1e6)),
            meaning="from T s on, for S s, nothing is measured; can be repeated",
            example="silent=20:5",
            is_event=True,
        ),
        Kind(
            name="latency",
            bounds=(Bound(letter="S", low=0.0, high=60.0),),
            meaning="time from measurement to sending in seconds (default 0.02)",
            example="latency=0.1",
        ),
        Kind(
            name="jitter",
            bounds=(Bound(letter="S", low=0.0, high=60.0),),
            meaning="largest additional time, random",
            example="jitter=0.05",
        ),
    )
}


def receiver_model(texts: Sequence[str]) -> ReceiverModel:
    """Return the receiver that the values of ``--receive`` describe.

    Raises ``UserError`` with the cause and what is allowed.
    """
    found: dict[str, tuple[float, ...]] = {}
    silent_s = []
    for text in texts:
        name, values = _parsed(text)
        if name == "silent":
            silent_s.append((values[0], values[1]))
        elif name in found:
            raise UserError(f"{shown(text)}: {name} is given twice; allowed: once")
        found[name] = values
    made = ReceiverModel(silent_s=tuple(silent_s))
    for name, values in found.items():
        made = replace(made, **_field(name, values))
    if made.bias_rad > made.bound_rad:
        bias_deg, bound_deg = math.degrees(made.bias_rad), math.degrees(made.bound_rad)
        raise UserError(f"'bias={bias_deg:g}': allowed: at most the bound, {bound_deg:g} degrees")
    return made


def receiver_help() -> str:
    """Return the help text of all options, a paragraph each."""
    return described(OPTIONS.values())


def _parsed(text: str) -> tuple[str, tuple[float, ...]]:
    name = text.partition("=")[0]
    kind = OPTIONS.get(name)
    if kind is None:
        raise UserError(f"{shown(name)} is not an option; give {', '.join(OPTIONS)}")
    return name, kind.read(text)


def _field(name: str, values: tuple[float, ...]) -> dict[str, Any]:
    """Return the fields of the model that an option sets."""
    match name:
        case "bound" | "bias":
            return {f"{name}_rad": math.radians(values[0])}
        case "mount" | "mount-error":
            return {f"{name.replace('-', '_')}_rad": tuple(map(math.radians, values))}
        case "latency" | "jitter":
            return {f"{name}_s": values[0]}
        case "rate":
            return {"rate_hz": values[0]}
        case "silent":
            return {}
    return {name: values[0]}
