"""Calibration, limits and device files: the written table radiates the wanted beams."""

import itertools
import math

import numpy as np
import pytest
from device_reading import parse
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.hardware import devices
from companion.beams.hardware.calibration import Calibration, parse_calibration
from companion.beams.hardware.devices import LIMITS, SETTINGS, Beamformer, Mode
from companion.beams.hardware.tables import DeviceTable, WantedBeam, encode, fit
from companion.beams.hardware.unit_gains import UnitGains
from companion.values import ComplexArray

SIZES = {Beamformer.ADAR1000: 8, Beamformer.TMYTEK: 16, Beamformer.SIVERS: 16}
CN0566_ORDER = (6, 7, 4, 5, 2, 3, 0, 1)
"""Element that each channel of the ADALM-PHASER drives, from pyadi-iio's CN0566."""
SEEDS = st.integers(0, 2**32 - 1)


def line(sines: list[float], elements: int) -> ComplexArray:
    """Return the steering matrix of a half-wave line for directions given by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


def wanted(sines: list[float], elements: int) -> list[WantedBeam]:
    """Return zero-forcing beams, each with nulls at the others."""
    steering = line(sines, elements)
    weights = np.linalg.pinv(steering.T)
    return [
        WantedBeam(
            uav=f"{i + 1}:1",
            weights=weights[:, i],
            azimuth_rad=math.asin(sine),
            elevation_rad=0.0,
            steering=steering[:, [i, *(j for j in range(len(sines)) if j != i)]],
        )
        for i, sine in enumerate(sines)
    ]


def measured(seed: int, elements: int) -> Calibration:
    """Return a permuted array whose channels differ by up to 4 dB and any phase."""
    rng = np.random.default_rng(seed)
    return Calibration(
        phase_rad=tuple(rng.uniform(-4, 4, elements).tolist()),
        gain_db=tuple(rng.uniform(-2, 2, elements).tolist()),
        order=tuple(rng.permutation(elements).tolist()),
    )


def written(device: Beamformer, table: DeviceTable) -> str:
    """Return the text of a table, with the additional arguments that the device needs."""
    return encode(table, frequency_hz=60.48e9 if device is Beamformer.SIVERS else None)


# --- calibration --------------------------------------------------------------------------------


def test_calibration_lines_are_accepted_in_any_order() -> None:
    text = "channel,element,phase_deg,gain_db\n1,0,90,-1.5\n\n0,2,-45,0\n 2 , 1 ,1e1,.25\n"
    found = parse_calibration(text)
    assert found.order == (2, 0, 1)
    assert found.phase_rad == pytest.approx((math.pi / 2, math.radians(10), -math.pi / 4))
    assert found.gain_db == (-1.5, 0.25, 0)
    assert found.factors[0] == pytest.approx(10 ** (-1.5 / 20) * 1j)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: ''"),
        ("a,b\n", "line 1: 'a,b'"),
        ("channel,element,phase_deg,gain_db\n", "0 phases"),
        ("channel,element,phase_deg,gain_db\n0,0,1\n", "line 2: '0,0,1' has 3 fields"),
        ("channel,element,phase_deg,gain_db\n0,x,1,1\n", "line 2: element 'x'"),
        ("channel,element,phase_deg,gain_db\n-1,0,1,1\n", "line 2: channel '-1'"),
        ("channel,element,phase_deg,gain_db\n0,0,nan,1\n", "line 2: phase_deg 'nan'"),
        ("channel,element,phase_deg,gain_db\n0,0,1,high\n", "line 2: gain_db 'high'"),
        ("channel,element,phase_deg,gain_db\n0,0,1,1\n0,1,1,1\n", "line 3: channel 0"),
        ("channel,element,phase_deg,gain_db\n0,0,1,1\n1,0,1,1\n", "line 3: element 0"),
        ("channel,element,phase_deg,gain_db\n0,0,1,1\n2,1,1,1\n", "channel 1 of 2"),
        ("channel,element,phase_deg,gain_db\n0,0,1,1\n1,2,1,1\n", "element 1 of 2"),
    ],
)
def test_malformed_calibration_is_rejected_with_its_line_number(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_calibration(text)


@pytest.mark.parametrize(
    ("phase", "gain", "order", "said"),
    [
        ((0.0,), (0.0, 0.0), (0, 1), "1 phases, 2 gains and an order of 2"),
        ((0.0, 0.0), (0.0,), (0, 1), "2 phases, 1 gains"),
        ((0.0, 0.0), (0.0, 0.0), (0, 0), "does not contain each of 0 to 1"),
        ((0.0, 0.0), (0.0, 0.0), (1, 2), "does not contain each of 0 to 1"),
        ((0.0, math.inf), (0.0, 0.0), (0, 1), "phase inf of element 1"),
        ((0.0, 0.0), (math.nan, 0.0), (0, 1), "gain nan of element 0"),
        ((), (), (), "one of each"),
    ],
)
def test_inconsistent_calibration_is_rejected(
    phase: tuple[float, ...], gain: tuple[float, ...], order: tuple[int, ...], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        Calibration(phase_rad=phase, gain_db=gain, order=order)


# --- fitting ------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", list(Beamformer))
def test_table_codes_radiate_the_wanted_beams(device: Beamformer) -> None:
    """Element by element: channel setting times channel response."""
    size = SIZES[device]
    calibration = measured(4, size)
    beams = wanted([-0.5, 0.1, 0.6], size)
    table = fit(device, beams, calibration)
    assert table.uavs == ("1:1", "2:1", "3:1")
    assert table.codes.shape == (3, size, 2)
    factors = calibration.factors
    for k, beam in enumerate(beams):
        for channel, element in enumerate(calibration.order):
            sent = SETTINGS[device].values(table.codes[k, channel]) * factors[element]
            assert table.weights[element, k] == pytest.approx(sent)
        own, *others = np.abs(beam.steering.T @ table.weights[:, k])
        assert max(others) < own * 10 ** (-30 / 20)
    assert table.loss_db is not None
    assert np.abs(table.loss_db).max() < 0.1


def test_table_loss_is_the_loss_of_array_gain() -> None:
    beam = wanted([0.3, -0.4], 16)[0]
    table = fit(Beamformer.TMYTEK, [beam], measured(9, 16))
    sent, own = table.weights[:, 0], beam.steering[:, 0]
    before = abs(own @ beam.weights) ** 2 / np.vdot(beam.weights, beam.weights).real
    after = abs(own @ sent) ** 2 / np.vdot(sent, sent).real
    assert table.loss_db == pytest.approx((10 * math.log10(before / after),))


def test_channel_phase_is_subtracted() -> None:
    """A channel that adds 90 degrees is set back by 90 degrees."""
    ideal = Calibration.ideal(range(16))
    turned = Calibration(
        phase_rad=(math.pi / 2, *ideal.phase_rad[1:]), gain_db=ideal.gain_db, order=ideal.order
    )
    beam = WantedBeam(
        uav="1:1",
        weights=np.ones(16, dtype=complex),
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=line([0.0], 16),
    )
    phases = fit(Beamformer.TMYTEK, [beam], turned).codes[0, :, 0]
    assert (phases[0] - phases[1]) % 360 == 270
    assert len(set(phases[1:].tolist())) == 1


def test_stronger_channels_are_attenuated_to_the_weakest() -> None:
    """The strongest setting is full gain; a channel 3 dB too strong is attenuated by 3 dB."""
    ideal = Calibration.ideal(range(16))
    uneven = Calibration(
        phase_rad=ideal.phase_rad, gain_db=(3.0, *ideal.gain_db[1:]), order=ideal.order
    )
    beam = WantedBeam(
        uav="1:1",
        weights=np.ones(16, dtype=complex),
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=line([0.0], 16),
    )
    assert fit(Beamformer.TMYTEK, [beam], uneven).codes[0, :, 1].tolist() == [6, *[0] * 15]


@pytest.mark.parametrize(
    ("device", "size", "count", "azimuth_deg", "elevation_deg", "said"),
    [
        (Beamformer.TMYTEK, 8, 1, 0, 0, "tmytek drives 16 elements, the array has 8"),
        (Beamformer.SIVERS, 64, 1, 0, 0, "sivers drives 16 elements, the array has 64"),
        (Beamformer.TMYTEK, 16, 65, 0, 0, "stores 1 to 64 beams, not 65"),
        (Beamformer.SIVERS, 16, 0, 0, 0, "stores 1 to 64 beams, not 0"),
        (Beamformer.ADAR1000, 8, 122, 0, 0, "stores 1 to 121 beams, not 122"),
        (Beamformer.TMYTEK, 16, 1, 45.1, 0, "beam for 7:1 is 45.1 degrees off boresight"),
        (Beamformer.TMYTEK, 16, 1, 40, 40, "54.1 degrees off boresight"),
        (Beamformer.TMYTEK, 16, 1, 180, 0, "180.0 degrees off boresight"),
        (Beamformer.TMYTEK, 16, 1, math.nan, 0, "nan degrees off boresight"),
    ],
)
def test_beams_beyond_device_limits_are_rejected(
    *,
    device: Beamformer,
    size: int,
    count: int,
    azimuth_deg: float,
    elevation_deg: float,
    said: str,
) -> None:
    beam = WantedBeam(
        uav="7:1",
        weights=np.ones(size, dtype=complex),
        azimuth_rad=math.radians(azimuth_deg),
        elevation_rad=math.radians(elevation_deg),
        steering=line([0.0], size),
    )
    with pytest.raises(ValueError, match=said):
        fit(device, [beam] * count, Calibration.ideal(range(size)))


def test_beams_at_the_device_limits_are_accepted() -> None:
    beam = WantedBeam(
        uav="7:1",
        weights=np.ones(16, dtype=complex),
        azimuth_rad=math.pi / 4,
        elevation_rad=0.0,
        steering=line([0.7], 16),
    )
    assert fit(Beamformer.TMYTEK, [beam] * 64, Calibration.ideal(range(16))).codes.shape[0] == 64


def test_unequal_or_mismatched_channels_are_rejected() -> None:
    ideal = Calibration.ideal(range(16))
    beam = wanted([0.1], 16)[0]
    wild = Calibration(
        phase_rad=ideal.phase_rad, gain_db=(7.6, *ideal.gain_db[1:]), order=ideal.order
    )
    with pytest.raises(ValueError, match=r"differ by 7\.6 dB, tmytek can equalise 7\.5 dB"):
        fit(Beamformer.TMYTEK, [beam], wild)
    with pytest.raises(ValueError, match=r"beam for 1:1: weights \(16,\)"):
        fit(Beamformer.ADAR1000, [beam], Calibration.ideal(range(8)))
    nowhere = WantedBeam(
        uav="1:1",
        weights=beam.weights,
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=np.empty((16, 0), complex),
    )
    with pytest.raises(ValueError, match="one direction or more"):
        fit(Beamformer.ADAR1000, [nowhere], ideal)


# --- file formats -------------------------------------------------------------------------------


@settings(max_examples=examples(25), deadline=None)
@given(SEEDS, st.sampled_from(list(Beamformer)), st.integers(1, 4))
def test_table_round_trips_through_its_text(seed: int, device: Beamformer, count: int) -> None:
    size = SIZES[device]
    rng = np.random.default_rng(seed)
    sines = np.linspace(-0.6, 0.6, count) + rng.uniform(-0.1, 0.1, count)
    calibration = measured(seed, size)
    table = fit(device, wanted(sines.tolist(), size), calibration)
    found = parse(device, written(device, table), calibration)
    assert np.array_equal(found.codes, table.codes)
    assert found.weights == pytest.approx(table.weights, abs=1e-12)
    assert found.order == calibration.order
    named = device is not Beamformer.TMYTEK
    assert found.uavs == (table.uavs if named else tuple(str(k + 1) for k in range(count)))
    assert found.loss_db is None
    assert written(device, found) == written(device, table) or not named


@settings(max_examples=examples(40), deadline=None)
@given(SEEDS, st.sampled_from(list(Beamformer)))
def test_every_code_round_trips(seed: int, device: Beamformer) -> None:
    """Arbitrary codes, off and lowest among them; one has full gain, as in every beam."""
    rng = np.random.default_rng(seed)
    size, kind = SIZES[device], SETTINGS[device]
    spread = rng.uniform(0, 1, (3, size)) ** 4 * np.exp(1j * rng.uniform(0, 7, (3, size)))
    spread[:, 0] = 1.0
    codes = kind.nearest(spread)
    ideal = Calibration.ideal(range(size))
    table = DeviceTable(
        device=device,
        uavs=("a", "b b", "icao:4CA7B3"),
        codes=codes,
        order=ideal.order,
        weights=spread.T,
        loss_db=None,
    )
    found = parse(device, written(device, table), ideal)
    assert np.array_equal(found.codes, codes)
    assert found.weights == pytest.approx(kind.values(codes).T)


def test_adar1000_table_maps_phaser_channels_to_elements() -> None:
    """Channel 2 of the first chip is element 8 of the CN0566 in pyadi-iio's numbering."""
    calibration = Calibration.ideal(CN0566_ORDER)
    ramp = np.exp(2j * np.pi * 16 / 128 * np.arange(8))  # 45 degrees from element to element
    beam = WantedBeam(
        uav="5:1",
        weights=ramp,
        azimuth_rad=0.2,
        elevation_rad=0.0,
        steering=ramp.conj()[:, np.newaxis],
    )
    header, *lines = encode(fit(Beamformer.ADAR1000, [beam], calibration)).splitlines()
    assert header.startswith("beam,uav,chip,channel,element,phase_code,phase_deg,gain_code,")
    rows = [line.split(",") for line in lines]
    assert [row[:5] for row in rows][:2] == [
        ["0", "5:1", "0", "1", "6"],
        ["0", "5:1", "0", "2", "7"],
    ]
    assert [int(row[4]) for row in rows] == [6, 7, 4, 5, 2, 3, 0, 1]
    assert [int(row[2]) for row in rows] == [0, 0, 0, 0, 1, 1, 1, 1]
    phases = [int(row[5]) for row in rows]
    assert [(phase - phases[6]) % 128 for phase in phases] == [96, 112, 64, 80, 32, 48, 0, 16]
    assert all(float(row[6]) == int(row[5]) * 2.8125 for row in rows)
    assert {(row[7], row[8]) for row in rows} == {("127", "0")}


def test_vector_modulator_matches_the_data_sheet() -> None:
    """Data sheet: sign and magnitude; quarter turns; within 3.2 degrees and 0.45 dB throughout."""
    assert [devices.vector_modulator(k) for k in (0, 16, 32, 64, 96)] == [
        (0x3F, 0x20),
        (0x36, 0x35),
        (0x21, 0x3D),
        (0x1F, 0x20),
        (0x01, 0x1D),
    ]
    assert devices.vector_modulator(127) == (0x3F, 0x01)
    signed = np.array(
        [
            [(1 if byte & 0x20 else -1) * (byte & 0x1F) for byte in devices.vector_modulator(k)]
            for k in range(128)
        ]
    )
    turned = (signed[:, 0] + 1j * signed[:, 1]) * np.exp(-2j * np.pi * np.arange(128) / 128)
    assert np.degrees(np.abs(np.angle(turned))).max() < 3.2
    assert np.ptp(20 * np.log10(np.abs(turned))) < 0.8
    assert all(not byte & 0xC0 for k in range(128) for byte in devices.vector_modulator(k))


def test_adar1000_gain_levels_cover_its_range() -> None:
    """31 dB, every step finer than the 0.5 dB of the data sheet, then off."""
    levels = np.array(
        devices.SETTINGS[Beamformer.ADAR1000]
        .values(np.array([(0, i) for i in range(len(devices.ADAR1000_GAINS))]))
        .real
    )
    assert levels[-1] == 0
    decibels = 20 * np.log10(levels[:-1])
    assert decibels[0] == 0
    assert decibels[-1] == pytest.approx(-31.05, abs=0.01)
    assert np.diff(decibels).min() > -0.5
    assert np.diff(decibels).max() < 0


def test_tmytek_table_format() -> None:
    table = fit(
        Beamformer.TMYTEK,
        [
            WantedBeam(
                uav="1:1",
                weights=np.array([1.0, 0.5, 0.0, 1j] * 4),
                azimuth_rad=0.0,
                elevation_rad=0.0,
                steering=line([0.0], 16),
            )
        ]
        * 2,
        Calibration.ideal(range(16)),
        UnitGains(Mode.RX, 11.5, 7.5),
    )
    header, *lines = encode(table).splitlines()
    assert header == "Mode,BeamID,BeamType,beam_db,beam_theta,beam_phi,ch,ch_sw,ch_db,ch_deg"
    assert len(lines) == 32
    first = [line.split(",") for line in lines[:16]]
    assert all(row[:6] == ["RX", "1", "1", "", "", ""] for row in first)
    assert [row[6] for row in first] == [str(ch) for ch in range(1, 17)]
    assert [row[7] for row in first] == ["0", "0", "1", "0"] * 4
    assert first[0][8] == "11.5"
    assert lines[16].startswith("RX,2,1,,,,1,")


def test_blank_lines_of_a_tmytek_table_are_skipped() -> None:
    """The manufacturer's own examples contain blank lines."""
    ideal = Calibration.ideal(range(16))
    table = fit(Beamformer.TMYTEK, wanted([0.1], 16), ideal)
    text = encode(table).replace("\n", "\n,,,,,,,,,\n", 1)
    assert np.array_equal(parse(Beamformer.TMYTEK, text, ideal).codes, table.codes)


def test_switched_off_channel_is_ignored_for_full_gain() -> None:
    """A table may give any gain for a channel that is switched off."""
    ideal = Calibration.ideal(range(16))
    beam = WantedBeam(
        uav="1:1",
        weights=np.array([0, *[1] * 15], complex),
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=line([0.0], 16),
    )
    table = fit(Beamformer.TMYTEK, [beam], ideal)
    text = encode(table)
    assert ",1,1,-7.5," in text
    found = parse(Beamformer.TMYTEK, text.replace(",1,1,-7.5,", ",1,1,9.0,"), ideal)
    assert np.array_equal(found.codes, table.codes)


def test_sivers_book_loads_like_the_manufacturer_scripts() -> None:
    """The scripts read bytes from the line after the tag, two per word, antenna 15 first."""
    table = fit(Beamformer.SIVERS, wanted([-0.3, 0.4], 16), measured(1, 16))
    lines = encode(table, frequency_hz=60.48e9).splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("START_TABLE FREQ:"))
    head = lines[start]
    assert float(head[len("START_TABLE FREQ:") : head.find("TEMP")].strip()) == 60.48
    flat = [int(v, 16) for v in ",".join(lines[start + 1 : lines.index("END_TABLE")]).split(",")]
    assert len(flat) == 64 * 32
    words = [(q & 0x3F) << 6 | (i & 0x3F) for q, i in zip(flat[::2], flat[1::2], strict=True)]
    for row, antenna in itertools.product(range(2), range(16)):
        word = words[row * 16 + 15 - antenna]
        i, q = (word & 0x3F) - 31, (word >> 6) - 31
        assert table.codes[row, antenna].tolist() == [i, q]
    assert set(words[32:]) == {31 << 6 | 31}
    assert lines[0] == "# row 0: 1:1"


def test_sivers_book_requires_a_frequency() -> None:
    table = fit(Beamformer.SIVERS, wanted([0.1], 16), Calibration.ideal(range(16)))
    for frequency, said in ((None, "give its frequency"), (0.0, "not above 0"), (math.inf, "inf")):
        with pytest.raises(ValueError, match=said):
            encode(table, frequency_hz=frequency)


@pytest.mark.parametrize("name", ["", "a,b", 'a"b', "a\nb", " a", "a\u2028b"])
def test_beam_name_with_a_comma_is_rejected(name: str) -> None:
    beam = WantedBeam(
        uav=name,
        weights=np.ones(8, complex),
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=line([0.0], 8),
    )
    with pytest.raises(ValueError, match="name has a comma"):
        fit(Beamformer.ADAR1000, [beam], Calibration.ideal(range(8)))


BROKEN = [
    (Beamformer.ADAR1000, ("beam,uav", "uav,beam"), "line 1"),
    (Beamformer.ADAR1000, ("0,1:1,0,1,0,", "0,1:1,0,5,0,"), "line 2: channel '5'"),
    (Beamformer.ADAR1000, ("0,1:1,0,2,1,", "0,1:1,0,1,1,"), "line 3: element 1"),
    (Beamformer.ADAR1000, ("0,1:1,0,2,1,", "0,1:1,0,1,0,"), "line 3: beam 0 has this channel"),
    (Beamformer.ADAR1000, ("0,1:1,0,2,1,", "121,1:1,0,2,1,"), "line 3: beam '121'"),
    (Beamformer.ADAR1000, ("0,1:1,0,2,1,", "0,2:1,0,2,1,"), "line 3: uav '2:1'"),
    (Beamformer.ADAR1000, ("0,1:1,0,2,1,", "2,1:1,0,2,1,"), "beam 0 has no line for channel 1"),
    (Beamformer.ADAR1000, (",127,0,", ",3,0,"), "line 2: gain_code 3 with attenuator 0"),
    (Beamformer.ADAR1000, (",127,0,", ",128,0,"), "line 2: gain_code '128'"),
    (Beamformer.ADAR1000, (",0,0.0000,", ",0,2.8125,"), "phase_deg 2.8125"),
    (Beamformer.ADAR1000, (",0,0.0000,127,0,3F,", ",0,0.0000,127,0,3E,"), "vm_i, vm_q"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,1,", "QX,1,1,,,,1,"), "line 2: Mode 'QX'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,", "RX,1,1,,,,2,"), "line 3: Mode 'RX'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,", "TX,1,0,,30,,2,"), "line 3: BeamType '0'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,", "TX,65,1,,,,2,"), "line 3: BeamID '65'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,", "TX,1,1,,,,17,"), "line 3: ch '17'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,", "TX,1,1,,,,1,"), "line 3: beam 1 has channel 1"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,0,0.0,", "TX,1,1,,,,2,2,0.0,"), "line 3: ch_sw '2'"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,0,0.0,", "TX,1,1,,,,2,0,-0.2,"), "line 3: ch_db -0.2"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,0,0.0,", "TX,1,1,,,,2,0,-8.0,"), "line 3: ch_db -8.0"),
    (Beamformer.TMYTEK, ("TX,1,1,,,,2,0,0.0,0", "TX,1,1,,,,2,0,0.0,360"), "line 3: ch_deg '360"),
    (Beamformer.SIVERS, ("START_TABLE", "START"), "one table"),
    (Beamformer.SIVERS, ("END_TABLE", "END"), "one table"),
    (Beamformer.SIVERS, ("# row 0", "# row 1"), "line 1: '# row 1"),
    (Beamformer.SIVERS, ("0x1F", "0x3F"), "line 4: '0x3F'"),
    (Beamformer.SIVERS, ("0x1F,", ""), "line 4: 31 values"),
    (Beamformer.SIVERS, ("END_TABLE", "0x1F\nEND_TABLE"), "65 rows"),
]


@pytest.mark.parametrize(("device", "change", "said"), BROKEN)
def test_malformed_table_is_rejected_with_its_line_number(
    device: Beamformer, change: tuple[str, str], said: str
) -> None:
    size = SIZES[device]
    ideal = Calibration.ideal(range(size))
    beam = WantedBeam(
        uav="1:1",
        weights=np.ones(size, dtype=complex),
        azimuth_rad=0.0,
        elevation_rad=0.0,
        steering=line([0.0], size),
    )
    text = written(device, fit(device, [beam], ideal))
    assert change[0] in text
    with pytest.raises(ValueError, match=said):
        parse(device, text.replace(*change, 1), ideal)


def test_table_for_a_different_array_is_rejected() -> None:
    text = encode(fit(Beamformer.ADAR1000, wanted([0.2], 8), Calibration.ideal(range(8))))
    for other in (Calibration.ideal(CN0566_ORDER), Calibration.ideal(range(12))):
        with pytest.raises(ValueError, match="drives elements"):
            parse(Beamformer.ADAR1000, text, other)


def test_every_device_has_limits_settings_and_a_media_type_of_its_own() -> None:
    assert set(LIMITS) == set(SETTINGS) == set(Beamformer)
