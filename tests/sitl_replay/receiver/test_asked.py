"""Options of the simulated receiver."""

import math

import pytest

from companion.values import UserError
from sitl_replay.receiver.asked import OPTIONS, receiver_help, receiver_model
from sitl_replay.receiver.model import ReceiverModel


def test_no_option_gives_the_defaults() -> None:
    assert receiver_model([]) == ReceiverModel()


def test_options_set_their_fields() -> None:
    texts = [
        "rate=20", "bound=1.5", "bias=0.5", "mount=1:2:3", "mount-error=-1:0:2.5", "outliers=0.1",
        "swapped=0.2", "lost=0.3", "silent=5:1", "silent=9:2", "latency=0.4", "jitter=0.5",
    ]  # fmt: skip
    rad = math.radians
    assert receiver_model(texts) == ReceiverModel(
        mount_rad=(rad(1), rad(2), rad(3)),
        mount_error_rad=(rad(-1), 0.0, rad(2.5)),
        bound_rad=rad(1.5),
        bias_rad=rad(0.5),
        outliers=0.1,
        swapped=0.2,
        lost=0.3,
        silent_s=((5.0, 1.0), (9.0, 2.0)),
        latency_s=0.4,
        jitter_s=0.5,
        rate_hz=20.0,
    )
    assert {text.partition("=")[0] for text in texts} == set(OPTIONS)


@pytest.mark.parametrize("kind", OPTIONS.values(), ids=lambda kind: str(kind.name))
def test_every_example_changes_the_receiver_and_is_described(kind: object) -> None:
    assert receiver_model([kind.example]) != ReceiverModel()  # type: ignore[attr-defined]
    assert f"{kind.form}: " in receiver_help()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("texts", "complaint"),
    [
        (["nois=1"], "'nois' is not an option; give rate, bound, bias, mount, mount-error"),
        (["bound"], "'bound': DEG is '', allowed: 0.001 to 90; for example bound=1.5"),
        (["lost=2"], "'lost=2': P is '2', allowed: 0 to 1; for example lost=0.2"),
        (["mount=1:2"], "'mount=1:2' is not mount=R:P:Y, for example mount=0:-10:90"),
        (["lost=0", "lost=1"], "'lost=1': lost is given twice; allowed: once"),
        (["bias=3"], "'bias=3': allowed: at most the bound, 2 degrees"),
        (["rate=0"], "HZ is '0', allowed: 0.01 to 1000"),
    ],
)
def test_invalid_option_is_a_one_line_error(texts: list[str], complaint: str) -> None:
    with pytest.raises(UserError) as raised:
        receiver_model(texts)
    assert complaint in str(raised.value)
    assert "\n" not in str(raised.value)
