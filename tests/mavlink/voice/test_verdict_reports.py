"""Verdicts as STATUSTEXT and NAMED_VALUE_FLOAT, read by pymavlink."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.voice.verdict_reports import VALUES_MOST, VerdictReports
from companion.mavlink.wire.encode import Outgoing, pack
from companion.values import Blame, Cause, Level, Source, Verdict

S = 1_000_000_000
SERVICE = Source(5, 191)


def verdict(uav: str, level: Level, spare_db: float | None = 1.0) -> Verdict:
    why = None if level is Level.GOOD else Blame(Cause.RATE, "reports 1.1 s apart", "ask for 10 Hz")
    sure_db = None if spare_db is None else 5.0 + spare_db
    return Verdict(
        uav=uav, level=level, blame=why, since_ns=0, needed_gain_db=5.0, guaranteed_gain_db=sure_db
    )


def read(messages: list[Outgoing], version: int = 2) -> list[Any]:
    parser = dialect.MAVLink(None)
    raw = b"".join(pack(one, seq, version) for seq, one in enumerate(messages))
    return list(parser.parse_buffer(raw) or ())


def texts(messages: list[Outgoing]) -> list[tuple[int, str]]:
    return [(one.severity, one.text) for one in read(messages) if one.get_type() == "STATUSTEXT"]


def test_each_change_is_reported_once_and_at_most_one_a_second() -> None:
    reports = VerdictReports(SERVICE)
    good = {f"{n}:1": verdict(f"{n}:1", Level.GOOD) for n in range(1, 6)}
    assert texts(reports.due(0, good)) == []
    bad = good | {uav: verdict(uav, Level.WEAK) for uav in list(good)[:4]}
    bad["5:1"] = verdict("5:1", Level.NONE, None)
    assert texts(reports.due(S // 10, bad)) == [(3, "Link 5:1 none: rate")]
    assert texts(reports.due(S, bad)) == []
    assert texts(reports.due(2 * S, bad)) == [(4, "Link 1:1,2:1,3:1+1 weak: rate")]
    assert texts(reports.due(9 * S, bad)) == []
    assert texts(reports.due(10 * S, good)) == [(6, "Link 1:1,2:1,3:1+2 good")]
    assert texts(reports.due(20 * S, {})) == []
    assert texts(reports.due(30 * S, bad)) == [(3, "Link 5:1 none: rate")]  # it was gone


@pytest.mark.parametrize("version", [1, 2])
def test_spare_gains_are_sent_each_second_the_worst_first(version: int) -> None:
    reports = VerdictReports(SERVICE)
    many = {f"{n}:1": verdict(f"{n}:1", Level.GOOD, n - 3.0) for n in range(1, 31)}
    many["200:191"] = verdict("200:191", Level.NONE, None)
    found = read(reports.due(4_000_000_000 * S, many), version)
    assert [one.get_srcSystem() for one in found[1:]] == [5] * (len(found) - 1)
    values = {one.name: one.value for one in found if one.get_type() == "NAMED_VALUE_FLOAT"}
    assert list(values)[:4] == ["linksgood", "dB1:1", "dB2:1", "dB3:1"]
    assert (values["linksgood"], values["dB1:1"]) == (30.0, -2.0)
    assert len(values) == 1 + VALUES_MOST
    assert read(reports.due(4_000_000_000 * S + S // 2, many)) == []
    assert reports.due(4_000_000_001 * S, many)


def test_text_and_name_fit_their_fields() -> None:
    reports = VerdictReports(SERVICE)
    many = {f"{n}:191": verdict(f"{n}:191", Level.WEAK) for n in range(100, 250)}
    (text,) = texts(reports.due(0, many))
    assert text == (4, "Link 100:191,101:191,102:191+147 weak: rate")
    names = [one.name for one in read(VerdictReports(SERVICE).due(0, many))[1:]]
    assert max(map(len, names)) <= 10
