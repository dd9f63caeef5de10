"""Hand-packed messages equal those of the generated classes; round trips are lossless."""

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from hypothesis import example, given
from hypothesis import strategies as st
from observed import OBSERVATIONS, WRONG, wrong

from companion.recording import codec, fields, schemas
from companion.values import Frame, Observation, Reason, Rejection, Source

TIMES = st.integers(0, 2**63 - 1)
BYTE = st.integers(0, 255)
FRAMES = st.builds(
    Frame,
    t_ns=TIMES,
    link=st.text(max_size=200),
    source=st.builds(Source, BYTE, BYTE),
    msgid=st.integers(0, 2**24 - 1),
    raw=st.binary(max_size=300),
    doubt_ns=st.just(0) | st.integers(0, 2**63 - 1),
)
REJECTIONS = st.builds(
    Rejection,
    t_ns=TIMES,
    source=st.text(),
    reason=st.sampled_from(Reason),
    count=st.integers(0, 2**40),
    msgid=st.none() | st.integers(0, 2**24 - 1),
    detail=st.text(),
)


@given(FRAMES)
@example(Frame(t_ns=1, link="x" * 200, source=Source(0, 255), msgid=2**24 - 1, raw=b"\xfd" * 200))
@example(Frame(t_ns=0, link="", source=Source(0, 0), msgid=0, raw=b"\xfd" * 127))
@example(Frame(t_ns=0, link="", source=Source(0, 0), msgid=0, raw=b"\xfd" * 128))
def test_hand_packed_frame_equals_the_generated_class(frame: Frame) -> None:
    generated = schemas.message_class("Frame")(
        t_ns=frame.t_ns,
        link=frame.link,
        sysid=frame.source.sysid,
        compid=frame.source.compid,
        msgid=frame.msgid,
        raw=frame.raw,
        doubt_ns=frame.doubt_ns,
    )
    encoder = schemas.FrameEncoder()
    encoder.encode(frame._replace(t_ns=7, raw=b"another"))  # its header is cached
    assert encoder.encode(frame) == generated.SerializeToString(deterministic=True)


def test_frame_encoder_cache_is_bounded() -> None:
    encoder = schemas.FrameEncoder()
    for number in range(schemas.HEADS_MAX + 10):
        frame = Frame(t_ns=1, link=f"udp:{number}", source=Source(1, 1), msgid=0, raw=b"\xfe")
        assert codec.to_frame(encoder.encode(frame), {}) == frame
    assert len(encoder._heads) == 10


@given(FRAMES)
def test_frame_round_trip_is_lossless(frame: Frame) -> None:
    assert codec.to_frame(schemas.FrameEncoder().encode(frame), {}) == frame


@given(REJECTIONS)
def test_rejection_round_trip_is_lossless(rejection: Rejection) -> None:
    data = schemas.encode("Rejection", fields.RecordedRejection(rejection, True))
    assert codec.to_event(schemas.REJECTIONS_TOPIC, data) == rejection
    output = schemas.encode("Rejection", fields.RecordedRejection(rejection, False))
    assert codec.to_event(schemas.REJECTIONS_TOPIC, output) is None


@given(OBSERVATIONS)
def test_observation_round_trip_is_lossless(observation: Observation) -> None:
    assert (
        codec.to_event(schemas.OBSERVATIONS_TOPIC, schemas.encode("Observation", observation))
        == observation
    )


NOT_REPRESENTABLE = {
    "early arrival", "early measurement", "time bound below 0", "beam below 0", "update below 0",
    "update",
}  # fmt: skip
"""Invalid values that the unsigned fields of the message cannot hold."""


@pytest.mark.parametrize("name", sorted(WRONG.keys() - NOT_REPRESENTABLE))
def test_invalid_observation_is_rejected(name: str) -> None:
    observation = wrong(name)
    with pytest.raises(ValueError, match="invalid observation: "):
        codec.to_event(schemas.OBSERVATIONS_TOPIC, schemas.encode("Observation", observation))


def test_every_schema_is_self_contained() -> None:
    ours = ("Frame", "Tick", "Rejection", "Track", "Observation", "Weights")
    for schema in (*map(schemas.schema, ours), schemas.LOCATION_FIX, schemas.LOG):
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.descriptor_set).file:
            pool.Add(file)  # raises if a dependency does not precede its user
        assert pool.FindMessageTypeByName(schema.name).full_name == schema.name


def test_optional_fields_are_marked_in_the_descriptor() -> None:
    file = FileDescriptorSet.FromString(schemas.schema("Track").descriptor_set).file[0]
    [track] = [message for message in file.message_type if message.name == "Track"]
    optional = [field.name for field in track.field if field.proto3_optional]
    assert optional == [
        "dt_s",
        "latency_s",
        "gamma",
        "innovation_m",
        "error_p95_m",
        "speed_mps",
        "climb_rate_mps",
    ]


def test_event_field_numbers_are_unchanged() -> None:
    """Old recordings stay readable: these field numbers are stored in files."""
    numbers = {
        (name, field.name): field.number
        for message, name in (
            (schemas.message_class("Frame"), "Frame"),
            (schemas.message_class("Rejection"), "Rej"),
        )
        for field in message.DESCRIPTOR.fields
    }
    assert numbers == {
        ("Frame", "t_ns"): 1, ("Frame", "link"): 2, ("Frame", "sysid"): 3, ("Frame", "compid"): 4,
        ("Frame", "msgid"): 5, ("Frame", "raw"): 6, ("Frame", "doubt_ns"): 7,
        ("Rej", "t_ns"): 1, ("Rej", "source"): 2,
        ("Rej", "reason"): 3, ("Rej", "count"): 4, ("Rej", "msgid"): 5, ("Rej", "detail"): 6,
        ("Rej", "is_event"): 7,
    }  # fmt: skip


NUMBERS = {
    "Frame": ("t_ns=1 link=2 sysid=3 compid=4 msgid=5 raw=6 doubt_ns=7"),
    "Tick": ("t_ns=1 in_two=2"),
    "Tock": ("t_ns=1"),
    "Rejection": ("t_ns=1 source=2 reason=3 count=4 msgid=5 detail=6 is_event=7"),
    "RoundTrip": ("t_ns=1 sysid=2 compid=3 sent_ns=4 remote_ns=5"),
    "Track": (
        "uav=1 state=2 valid_at_ns=3 age_s=4 position_ned_m=5 velocity_ned_mps=6 "
        "unknown_input_mps=7 bound_m=8 dt_s=9 latency_s=10 gamma=11 innovation_m=12 "
        "reports=13 t_ns=14 acceleration_ned_mps2=15 horizontal_bound_m=16 "
        "vertical_bound_m=17 clock_bound_s=18 set_center_ned_m=19 set_radius_m=20 "
        "speed_max_mps=21 acceleration_max_mps2=22 limits_source=23 error_p95_m=24 "
        "speed_mps=25"
    ),
    "Beam": (
        "uav=1 azimuth_rad=2 elevation_rad=3 range_m=4 pointing_bound_rad=5 gain_db=6 "
        "azimuth_rate_radps=7 elevation_rate_radps=8 range_rate_mps=9 loss_db=10 group=11 "
        "widened=12 pointing_p95_rad=13"
    ),
    "LeftOut": ("uav=1 reason=2"),
    "Weights": (
        "t_ns=1 valid_at_ns=2 uavs=3 elements=4 weights_complex64=5 method=6 "
        "condition_number=7 beam=8 left_out=9 normalisation=10 exact=11 regularised=12 "
        "groups=13"
    ),
    "Duty": ("t_ns=1 serves=2 spares=3"),
    "Offer": ("uav=1 sure_db=2 likely_db=3 sinr_db=4 heard_s=5"),
    "ClockSet": ("t_ns=1 utc_offset_ns=2"),
    "Observation": (
        "t_ns=1 measured_ns=2 time_bound_ns=3 uav=4 azimuth_rad=5 elevation_rad=6 bound_rad=7 "
        "update=8 beams=9 powers_db=10 power_bound_db=11"
    ),
}
"""The number of each field that a version has written. A number keeps its meaning for good."""


def test_published_field_numbers_keep_their_fields() -> None:
    for message, written in NUMBERS.items():
        now = {one.name: one.number for one in fields.fields(message)}
        then = {name: int(number) for name, number in (one.split("=") for one in written.split())}
        assert {name: now.get(name) for name in then} == then, message
        assert len(set(now.values())) == len(now), message
