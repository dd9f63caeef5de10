"""Parsing of ``--fault``, and its error messages."""

import re
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl_replay.faults.asked import KINDS, Fault, FaultError, described, in_order


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("loss=0.1", Fault(name="loss", values=(0.1,))),
        ("loss=0", Fault(name="loss", values=(0.0,))),
        ("drift@3=-24000", Fault(name="drift", values=(-24000.0,), sysid=3)),
        ("frozen@3:1=20:5", Fault(name="frozen", values=(20.0, 5.0), sysid=3, compid=1)),
        ("glitch=30:25", Fault(name="glitch", values=(30.0, 25.0, 1.0))),
        ("glitch@0:0=30:25:4", Fault(name="glitch", values=(30.0, 25.0, 4.0), sysid=0, compid=0)),
        ("spoof=20:2", Fault(name="spoof", values=(20.0, 2.0, 90.0))),
        ("compass@5:1=-8", Fault(name="compass", values=(-8.0, 0.0), sysid=5, compid=1)),
        ("bit-errors=1e-5", Fault(name="bit-errors", values=(1e-5,))),
        ("loss@3=1/20-50", Fault(name="loss", values=(1.0,), sysid=3, during_s=(20.0, 50.0))),
    ],
)
def test_fault_option_is_parsed(text: str, expected: Fault) -> None:
    fault = Fault.parse(text)
    assert fault == expected
    assert str(fault) == text.partition("=")[0]


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: str(kind.name))
def test_every_fault_example_parses_and_is_described(kind: object) -> None:
    assert Fault.parse(kind.example).name == kind.name  # type: ignore[attr-defined]
    assert f"{kind.form}: " in described()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "'' is not a fault; give drift, reboot, frozen, glitch, spoof, compass, loss,"),
        ("los=0.1", "'los' is not a fault; give "),
        ("loss", "'loss': P is '', allowed: 0 to 1; for example loss=0.1"),
        ("loss=1.1", "'loss=1.1': P is '1.1', allowed: 0 to 1; for example loss=0.1"),
        ("loss=-0.1", "P is '-0.1', allowed: 0 to 1"),
        ("loss=nan", "P is 'nan', allowed: 0 to 1"),
        ("delay=inf", "S is 'inf', allowed: 0 to 600"),
        ("loss=0.1:2", "'loss=0.1:2' is not loss=P, for example loss=0.1"),
        ("burst=0.1", "'burst=0.1' is not burst=P:S, for example burst=0.3:2"),
        ("burst=0.1:0", "S is '0', allowed: 0.001 to 600"),
        ("burst=1:1", "P is '1', allowed: 0 to 0.95"),
        ("bit-errors=0.6", "P is '0.6', allowed: 0 to 0.5"),
        ("glitch=1:2:3:4", "is not glitch=T:M[:N], for example glitch=30:25:4"),
        ("glitch=1:2:1.5", "N is '1.5', allowed: a whole number, 1 to 1e+06"),
        ("loss@=0.1", "'' is not SYSID or SYSID:COMPID, each 0 to 255"),
        ("loss@300=0.1", "'300' is not SYSID or SYSID:COMPID, each 0 to 255; for example loss=0.1"),
        ("loss@3:=0.1", "'3:' is not SYSID"),
        ("loss@x:1=0.1", "'x:1' is not SYSID"),
        ("loss=0.1/20", "'20' is not FROM-TO, in seconds, such as 20-50; for example loss=0.1"),
        ("loss=0.1/", "'' is not FROM-TO"),
        ("loss=0.1/50-20", "'50-20' is not FROM-TO"),
        ("loss=0.1/nan-20", "'nan-20' is not FROM-TO"),
    ],
)
def test_invalid_fault_is_a_one_line_error_with_allowed_values(text: str, complaint: str) -> None:
    with pytest.raises(FaultError, match=re.escape(complaint)) as caught:
        Fault.parse(text)
    assert "\n" not in str(caught.value)


@given(st.text(max_size=30) | st.from_regex(r"(loss|glitch|frozen)(@[0-9:]*)?=[0-9.:e-]*"))
def test_arbitrary_text_is_a_fault_or_a_fault_error(text: str) -> None:
    try:
        fault = Fault.parse(text)
    except FaultError:
        return
    bounds = KINDS[fault.name].bounds
    assert len(fault.values) == len(bounds)
    assert all(b.low <= v <= b.high for b, v in zip(bounds, fault.values, strict=True))


def test_fault_order_is_independent_of_the_command_line() -> None:
    texts = ("garbage=0.1", "delay=1", "frozen=9:1", "frozen=3:1", "loss@2=0.5", "loss=0.1")
    orders = {tuple(map(str, in_order([*map(Fault.parse, one)]))) for one in permutations(texts)}
    assert orders == {("frozen", "frozen", "loss", "loss@2", "delay", "garbage")}
    first, second = in_order([Fault.parse("frozen=9:1"), Fault.parse("frozen=3:1")])
    assert (first.values[0], second.values[0]) == (3.0, 9.0)


def test_duplicate_continuous_fault_is_rejected() -> None:
    different = [Fault.parse(text) for text in ("loss=0.1", "loss@1=0.2", "loss@1:1=0.3")]
    assert len(in_order(different)) == 3
    with pytest.raises(FaultError, match="loss@1 is given 2 times"):
        in_order([*different, Fault.parse("loss@1=0.2")])


def test_fault_applies_to_the_selected_senders() -> None:
    senders = [(3, 1), (3, 2), (4, 1)]
    for text, expected in [
        ("loss=0", senders),
        ("loss@3=0", senders[:2]),
        ("loss@3:1=0", senders[:1]),
    ]:
        assert [one for one in senders if Fault.parse(text).concerns(one, 0.0)] == expected


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: str(kind.name))
def test_every_fault_can_be_limited_to_a_time(kind: object) -> None:
    fault = Fault.parse(f"{kind.example}/20-50")  # type: ignore[attr-defined]
    sender = (fault.sysid or 1, 1)
    times_s = (0.0, 19.9, 20.0, 49.9, 50.0)
    assert [fault.concerns(sender, t_s) for t_s in times_s] == [False, False, True, True, False]


def test_a_fault_can_be_repeated_at_another_time() -> None:
    apart = [Fault.parse("loss=0.1/20-50"), Fault.parse("loss=0.2/50-60")]
    assert in_order(apart) == apart
    with pytest.raises(FaultError, match="loss is given 2 times; allowed: once per system and t"):
        in_order([*apart, Fault.parse("loss=1/59-70")])
