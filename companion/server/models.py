"""Models of the API's answers, built from described values, for the OpenAPI document only.

The models do not validate answers. Names and units follow the rules of ``companion.views.as_json``;
a value's description is its meaning and its unit.
"""

import functools
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

import companion
from companion.values import UtcNs
from companion.values.described import (
    DescribedEnum,
    Meaning,
    Member,
    bare,
    is_vector,
    members,
    unit,
)
from companion.views.as_json import FORMER_NAMES, name_in_json


@dataclass(frozen=True, slots=True)
class Problem:
    """Error response (RFC 9457). ``title`` says in one line what is wrong."""

    type: Annotated[Literal["about:blank"], Meaning("kind of problem (RFC 9457)")]
    title: Annotated[str, Meaning("what is wrong, in one line", example="no UAV '9:9' is tracked")]
    status: Annotated[int, Meaning("status of the HTTP answer", example=404)]


@dataclass(frozen=True, slots=True)
class Health:
    """Liveness of the process."""

    status: Annotated[Literal["ok"], Meaning("ok: the process answers")]
    needs_token: Annotated[bool, Meaning("whether other paths need a bearer token")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Description of a web service for BlueOS, which looks for it on every port of its computer.

    Source: BlueOS, development of extensions (https://blueos.cloud/docs/stable/development/extensions).
    """

    name: Annotated[str, Meaning("name in BlueOS's menu")]
    description: Annotated[str, Meaning("what the service does, in one line")]
    icon: Annotated[str, Meaning("name of an icon of Material Design Icons")]
    company: Annotated[str, Meaning("who publishes it")]
    version: Annotated[str, Meaning("version of the program")]
    webpage: Annotated[str, Meaning("path of the documentation")]
    api: Annotated[str, Meaning("path of the OpenAPI document")]
    avoid_iframes: Annotated[
        bool, Meaning("true: BlueOS opens the page in a tab, because no page may frame it")
    ]


REGISTRATION: Final = Registration(
    name="Companion",
    description="Beams of an antenna array towards UAVs, with guaranteed pointing bounds",
    icon="mdi-radio-tower",
    company="companion",
    version=companion.__version__,
    webpage="/docs",
    api="/openapi.json",
    avoid_iframes=True,
)


@dataclass(frozen=True, slots=True)
class Readiness:
    """Whether the service is ready; ``reasons`` say why not."""

    ready: Annotated[bool, Meaning("whether the service is ready")]
    reasons: Annotated[
        list[str], Meaning("why the service is not ready", example=["no link is up"])
    ]


@functools.cache
def model(described: type) -> type[BaseModel]:
    """Return the pydantic model of a described class; it has the same name."""
    fields: dict[str, Any] = {}
    for member in members(described):
        if "api" not in member.meaning.absent:
            fields[name_in_json(member.name)] = _field(member)
    for old, new in FORMER_NAMES.get(described.__name__, {}).items():
        kind, _ = fields[new]
        fields[old] = (kind, Field(description=f"deprecated: use `{new}`", deprecated=True))
    doc = described.__doc__
    return create_model(
        described.__name__, __doc__=doc, __config__=ConfigDict(protected_namespaces=()), **fields
    )


def _field(member: Member) -> tuple[Any, Any]:
    meaning, name = member.meaning, name_in_json(member.name)
    text = meaning.text
    measure = unit(name)
    if measure:
        text = f"{text}, {measure}"
    if meaning.deprecated:
        text = f"deprecated: use {meaning.deprecated}; {text}"
    given: dict[str, Any] = {"description": text}
    if meaning.example is not None:
        given["examples"] = [meaning.example]
    if meaning.deprecated:
        given["deprecated"] = True
    if is_vector(member.type):
        kind: Any = list[float]
        given |= {"min_length": 3, "max_length": 3}
    elif member.name.endswith("_ns"):
        kind, given["examples"] = str, ["2026-11-20T13:00:00.123Z"]
    else:
        kind = outward(member.type)
    return (kind | None if member.optional else kind), Field(**given)


def outward(kind: Any) -> Any:
    """Return a Python type as it is in JSON: described classes as models, tuples as lists."""
    kind, optional = bare(kind)
    if optional:
        return outward(kind) | None
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if kind is UtcNs:
        return str
    if origin is tuple and arguments[-1] is not ...:
        size = len(arguments)
        kind = list[outward(arguments[0])]  # type: ignore[misc]
        return Annotated[kind, Field(min_length=size, max_length=size)]
    if origin in (list, tuple):
        return list[outward(arguments[0])]  # type: ignore[misc]
    if origin is dict:
        return dict[str, outward(arguments[1])]  # type: ignore[misc]
    if origin in (typing.Union, types.UnionType):
        return functools.reduce(lambda one, other: one | other, map(outward, arguments))
    if isinstance(kind, type) and kind.__module__.startswith("companion"):
        if members(kind):
            return model(kind)
        return kind if issubclass(kind, str) else str
    return kind


def describe_enumerations(schemas: dict[str, Any]) -> None:
    """Add the meaning of each value to the enumerations of an OpenAPI document."""
    for kind in DescribedEnum.__subclasses__():
        if kind.__name__ in schemas:
            meanings = [f"{one}: {one.meaning}" for one in kind]
            schemas[kind.__name__]["description"] = f"{kind.__doc__} {'; '.join(meanings)}."
