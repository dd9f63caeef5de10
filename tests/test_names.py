"""Kinds of UAV ids."""

import re

import pytest

from companion.values import UAV_FORMS, UavKind, kind_of

IDS = {
    UavKind.VEHICLE: "3:1",
    UavKind.REMOTE_ID: "rid:1581F5",
    UavKind.ADSB: "icao:4CA7B3",
    UavKind.COT: "cot:ANDROID-1",
}


@pytest.mark.parametrize(("kind", "uav"), IDS.items())
def test_each_uav_id_has_one_kind(kind: UavKind, uav: str) -> None:
    assert kind_of(uav) is kind
    assert [one for one in UavKind if re.fullmatch(one.pattern, uav)] == [kind]
    assert kind.reports_itself == (kind is UavKind.VEHICLE)
    assert kind.prefix in UAV_FORMS


def test_uav_kinds_are_ranked_from_telemetry_to_cot() -> None:
    assert sorted(UavKind, key=lambda kind: kind.rank) == list(IDS)
