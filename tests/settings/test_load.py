"""Settings: accepted values, rejected values, and their error messages."""

import os
import re
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError
from support import HANG_S

from companion.beams.array.coverage import EVERYWHERE
from companion.beams.weights.precoding import Precoder
from companion.beams.worth.link_budget import LinkBudget
from companion.pipeline import assembly
from companion.settings.center import FixedCenter, HomeCenter, VehicleCenter, parse_center
from companion.settings.files import embedded, load, matrix_of
from companion.settings.model import CODEBOOK, COUPLING, BeamSettings, Settings
from companion.settings.section import ConfigError
from companion.settings.tracking import ObserverSettings
from companion.values import Normalisation, Power, Source, Widen, toml


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        Settings.from_toml(text, "there.toml")
    message = str(caught.value)
    assert message.startswith("there.toml: ")
    assert "\n" not in message
    return message.removeprefix("there.toml: ")


# --- errors -------------------------------------------------------------------------------------

# Section, key, value as TOML, value as printed, and allowed values.
WRONG = [
    ("center", "source", '"there"', "there", "SYSID:COMPID"),
    ("center", "source", '"300:1"', "300:1", "at most 255"),
    ("center", "source", '"91,0,0"', "91,0,0", "latitude must be -90..90"),
    ("center", "source", "5", "5", "string"),
    ("links", "urls", '"udpin:0.0.0.0:1"', "udpin", "list"),
    ("links", "urls", "[7]", "7", "string"),
    ("links", "urls", '["udpin:x"]', "udpin:x", "udpin:HOST:PORT"),
    ("presence", "enabled", '"always"', "always", "boolean"),
    ("presence", "system_id", "255", "255", "less than or equal to 254"),
    ("presence", "position_hz", "0", "0", "greater than or equal to 0.1"),
    ("out", "urls", '["udpin:0.0.0.0:1"]', "udpin:0.0.0.0:1", "udpout:, tcp:"),
    ("out", "urls", '["cot:udp:10.0.0.1:0"]', "cot:udp:10.0.0.1:0", "port 0"),
    ("out", "urls", '["sbs:radar:30003"]', "sbs:radar:30003", "cot:"),
    ("records", "udp", '["radio:9000"]', "radio:9000", "IP:PORT"),
    ("records", "udp", '["127.0.0.1:0"]', "127.0.0.1:0", "IP:PORT"),
    ("out", "rate_hz", "51", "51", "less than or equal to 50"),
    ("out", "uavs", '["me"]', "me", "SYSID:COMPID"),
    ("signing", "keys", '{"radio" = "key"}', "radio", "serial:"),
    ("signing", "allow_unsigned", '["tcp:a:1"]', "tcp:a:1", "has no key"),
    ("tracks", "allow", '["one"]', "one", "SYSID:COMPID, icao:HEX, rid:ID or cot:UID"),
    (
        "tracks",
        "deny",
        '["icao:4ca7b3"]',
        "icao:4ca7b3",
        "SYSID:COMPID, icao:HEX, rid:ID or cot:UID",
    ),
    ("clocks", "constant_delay_s", "-0.1", "-0.1", "greater than or equal to 0"),
    ("clocks", "constant_delay_s", "11", "11", "less than or equal to 10"),
    ("observer", "model", '"kinematics"', "kinematics", "'kinematic' or 'position'"),
    ("observer", "feed_forward", '"often"', "often", "boolean"),
    ("observer", "follow_accuracy", "2", "2", "boolean"),
    ("observer", "accuracy_factor", "0", "0", "greater than 0"),
    ("observer", "velocity_noise_mps", "0", "0", "greater than 0"),
    ("center", "attitude_bound_deg", "181", "181", "less than or equal to 180"),
    ("center", "attitude_bound_deg", "-1", "-1", "greater than or equal to 0"),
    ("tracks", "window_s", "0", "0", "greater than 0"),
    ("tracks", "reacquire_reports", "1", "1", "greater than or equal to 2"),
    ("tracks", "reacquire_reports", "61", "61", "less than or equal to 60"),
    ("tracks", "reacquire_s", "61", "61", "less than or equal to 60"),
    ("observer", "feedthrough_s", "11.0", "11.0", "less than or equal to 10"),
    ("observer", "velocity_lead_s", "0.0", "0.0", "greater than 0"),
    ("observer", "speed_max_mps", "-3", "-3", "greater than 0"),
    ("observer", "speed_max_mps", "inf", "inf", "finite"),
    ("observer", "position_noise_m", "nan", "nan", "finite|greater than 0"),
    ("observer", "acceleration_max_mps2", '"fast"', "fast", "number"),
    ("tracks", "lost_s", "0", "0", "greater than 0"),
    ("array", "kind", '"circle"', "circle", "ula"),
    ("array", "elements", "0", "0", "greater than or equal to 1"),
    ("array", "elements", "2.5", "2.5", "integer"),
    ("array", "elements", "5000", "5000", "less than or equal to 4096"),
    ("array", "mount_yaw_deg", "nan", "nan", "finite"),
    ("array", "rows", "0", "0", "greater than or equal to 1"),
    ("array", "spacing_m", "0", "0", "greater than 0"),
    ("array", "element", '"dipole"', "dipole", "'isotropic', 'cosine' or '3gpp'"),
    ("array", "element_exponent", "-1", "-1", "greater than or equal to 0"),
    ("array", "lever_arm_m", "[1, 2]", "1, 2", "too few"),
    ("array", "field_of_view_deg", "361", "361", "less than or equal to 360"),
    ("array", "azimuth_limits_deg", "[30, -30]", "30, -30", "from < to"),
    ("array", "dead", "[-1]", "-1", "greater than or equal to 0"),
    ("hardware", "phase_error_deg", "-1", "-1", "greater than or equal to 0"),
    ("hardware", "device", '"phaser"', "phaser", "'adar1000', 'tmytek' or 'sivers'"),
    ("beams", "method", '"best"', "best", "'zf', 'rzf', 'mmse' or 'mrt'"),
    ("beams", "policy", '"pray"', "pray", "'regularise', 'group' or 'drop'"),
    ("beams", "normalisation", '"max"', "max", "'total' or 'antenna'"),
    ("beams", "loss_limit_db", "0", "0", "greater than 0"),
    ("codebook", "oversampling", "0", "0", "greater than or equal to 1"),
    ("radio", "uav_antennas", "0", "0", "greater than or equal to 1"),
    ("radio", "bandwidth_hz", "-1", "-1", "greater than or equal to 1"),
    ("beams", "update_hz", "1001", "1001", "less than or equal to 1000"),
    ("beams", "targets", '"some"', "some", "'telemetry' or 'all'"),
    ("beams", "condition_limit", "1.0", "1.0", "greater than 1"),
    ("beams", "condition_limit", "1001.0", "1001.0", "less than or equal to 1000"),
    ("beams", "regularisation", "0", "0", "greater than 0"),
    ("beams", "priority", '["1:1", "2:1", "1:1"]', "1:1", "each UAV once"),
    ("array", "frequency_hz", "1e-300", "1e-300", "greater than or equal to 1000"),
    ("array", "frequency_hz", "1e300", "1e+300", "less than or equal to"),
    ("array", "spacing_m", "1e300", "1e+300", "less than or equal to"),
    ("array", "spacing_wavelengths", "1e300", "1e+300", "less than or equal to"),
    ("array", "lever_arm_m", "[1e200, 0, 0]", "1e+200", "less than or equal to"),
    ("recording", "directory", "7", "7", "string"),
    ("server", "listen", "8080", "8080", "string"),
]


@pytest.mark.parametrize(("section", "key", "value", "said", "allowed"), WRONG)
def test_settings_error_names_key_value_and_allowed_range(
    section: str, key: str, value: str, said: str, allowed: str
) -> None:
    message = refusal(f"[{section}]\n{key} = {value}\n")
    assert re.match(rf"{section}\.{key} = .*{re.escape(said)}.*: ", message), message
    assert re.search(allowed, message.split(": ", 1)[1]), message


@pytest.mark.parametrize("value", ["2", "0", "1.0", '"fast"', "-0.5"])
def test_alpha_accepts_auto_or_0_to_1(value: str) -> None:
    """A key with two kinds of value is named as written, and both kinds are listed."""
    message = refusal(f"[observer]\nalpha = {value}\n")
    assert message.startswith("observer.alpha = "), message
    assert "auto" in message
    assert re.search("0|1|number", message.split(": ", 1)[1]), message


@pytest.mark.parametrize("value", ["0", "-1", '"some"'])
def test_weights_hz_accepts_all_or_positive(value: str) -> None:
    message = refusal(f"[recording]\nweights_hz = {value}\n")
    assert message.startswith("recording.weights_hz = "), message
    assert "all" in message
    assert re.search("0|number", message.split(": ", 1)[1]), message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[tracks]\nstale = 4\n", "tracks.stale is not a setting; did you mean tracks.stale_s?"),
        ("[radar]\nrange = 4\n", "radar is not a setting"),
        ("source = '5:1'\n", "source is not a setting; did you mean center.source?"),
    ],
)
def test_unknown_key_is_named(text: str, said: str) -> None:
    assert refusal(text) == said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("links = 3\n", "links = 3: give a table"),
        ("[tracks]\nallow = '3:1'\n", "tracks.allow = '3:1': give a list"),
        ("[observer]\nuav = 3\n", "observer.uav = 3: give a table"),
        ("[array]\nhidden_deg = [[1, 2, 3]]\n", "array.hidden_deg = [1, 2, 3]: too few values"),
    ],
)
def test_wrong_type_is_described_in_the_words_of_toml(text: str, said: str) -> None:
    assert refusal(text) == said


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("[observer.uav.3]\nlag_s = [0, 1]\n", "observer.uav = '3'"),
        ("[clocks.apart_s]\na = 1\n", "clocks.apart_s = 'a'"),
        ('[beams]\npriority = ["1:1", "b"]\n', "beams.priority = 'b'"),
        ("[beams.rate_weights]\nb = 1\n", "beams.rate_weights = 'b'"),
        ('[drive]\nuavs = ["300:1"]\n', "drive.uavs = '300:1'"),
    ],
)
def test_name_that_no_uav_can_have_is_rejected(text: str, name: str) -> None:
    ids = "SYSID:COMPID, icao:HEX, rid:ID or cot:UID"
    assert refusal(text) == f"{name}: not the id of a UAV; give {ids}"


DIGITS = "9" * 5000
HEX = "0x" + "f" * 5000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"[beams]\nupdate_hz = {DIGITS}", "TOML has a number of thousands of digits"),
        (f"[array]\nnone = {'1_' * 5000}1", "TOML has a number of thousands of digits"),
        (f"[beams]\nupdate_hz = {HEX}", "beams.update_hz = a number of thousands of digits: "),
        (f"[array]\nlever_arm_m = [{HEX}, 0, 0]", "a number of thousands of digits: "),
        (f"[array]\nkind = {HEX}", "array.kind = a number of thousands of digits: "),
        ("[array]\nx = " + '"\\' * 500_000, "not TOML: "),
        (('"' + '\\"' * 2000 + "\n") * 200, "not TOML: "),
        ("x = " + "'" * 3 + "..x".replace(".", "'") * 300_000, "not TOML: "),
        ('x = """' + '""x' * 300_000 + "\\", "not TOML: "),
        ("'" * 2_000_000, "not TOML: "),
        ("#\n" * 1_000_000, "TOML is too large"),
        ("x = '" + "x" * (1 << 25) + "'", "TOML is too large"),
        ("[center]\nsource = '" + "9" * 6000 + ":1'", "system and component ids are at most 255"),
    ],
    ids=range(13),
)
def test_expensive_toml_is_rejected_in_one_line(text: str, said: str) -> None:
    began_s = time.process_time()
    assert said in refusal(text)
    assert time.process_time() - began_s < HANG_S  # quadratic time would take hours


@given(st.lists(st.sampled_from(['"', "'", "\\", "a", "#", "\n", "=", "."]), max_size=40))
@example(['"', "a", '"', "#", "a"])
def test_toml_string_scanner_agrees_with_the_parser(parts: list[str]) -> None:
    """The text without its strings has the same keys and types for the parser."""
    text = "x = " + "".join(parts)
    try:
        read = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    bare = tomllib.loads(toml._STRINGS.sub(lambda one: "" if one[0][0] == "#" else '""', text))
    assert len(bare) == len(read)
    assert [type(value) for value in bare.values()] == [type(value) for value in read.values()]


def test_section_that_is_not_a_table_is_rejected() -> None:
    assert refusal("center = 3\n").startswith("center = 3: ")


@pytest.mark.parametrize("text", ["[array", "array = ", "x = 1\nx = 2\n", "= 3", "a = 'é"])
def test_invalid_toml_is_reported(text: str) -> None:
    assert refusal(text).startswith("not TOML: ")


@pytest.mark.parametrize(
    "text",
    [
        '[array]\ncoupling = "a\\u0000b"',
        '[signing]\nkeys = {"udpin:\\u0000" = "key"}',
        '[links]\nrouters = ["\\U00000000"]',
        '[recording]\ndirectory = "\\u0000"',
    ],
)
def test_nul_character_is_rejected_before_it_names_a_file(text: str) -> None:
    assert refusal(text) == "TOML has a NUL character; remove it"


@pytest.mark.parametrize("text", ["[tracks]\ncoasting_s = 100\n", "[tracks]\nlost_s = 10\n"])
def test_track_timeouts_out_of_order_are_rejected(text: str) -> None:
    """coasting_s <= stale_s <= lost_s; otherwise a state would be unreachable."""
    assert "tracks" in refusal(text)


# --- files --------------------------------------------------------------------------------------


def test_defaults_apply_without_a_file() -> None:
    assert load(None) == Settings()
    observer = load(None).observer
    assert (observer.model, observer.acceleration_max_mps2) == ("kinematic", None)
    assert (observer.feed_forward, observer.follow_accuracy) == (True, True)


def test_settings_file_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('[array]\nelements = 128\n[center]\nsource = "5:1"\n', encoding="utf-8")
    found = load(path)
    assert (found.array.elements, found.center.source) == (128, "5:1")
    assert found.beams == BeamSettings()


def test_unreadable_settings_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing\.toml: No such file"):
        load(tmp_path / "missing.toml")
    with pytest.raises(ConfigError, match="Is a directory"):
        load(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b"# \xe9\n")
    with pytest.raises(ConfigError, match=r"latin\.toml: not TOML: it is not UTF-8"):
        load(tmp_path / "latin.toml")
    (tmp_path / "bad.toml").write_text("[array]\nelements = 0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"bad\.toml: array\.elements = 0: "):
        load(tmp_path / "bad.toml")


# --- TOML round trip ----------------------------------------------------------------------------

LINKS = ["udpin:[::]:14550", "tcp:ground.example:5760", 'serial:/dev/"tty" = 1:57600']
SCALAR = st.characters(exclude_categories=["Cs"], exclude_characters="\0")


@given(
    directory=st.none() | st.text(SCALAR, min_size=1, max_size=20),
    urls=st.lists(st.sampled_from(LINKS), max_size=3),
    keys=st.dictionaries(st.sampled_from(LINKS), st.text(SCALAR, max_size=20)),
    deny=st.lists(st.sampled_from(["3:1", "*:190", "icao:4C*"]), max_size=2),
    alpha=st.just("auto") | st.floats(0, 1, exclude_min=True, exclude_max=True),
    speed=st.floats(0, 1e5, exclude_min=True),
    weights_hz=st.just("all") | st.floats(1e-3, 1e6),
    elements=st.integers(1, 4096),
    yaw_deg=st.floats(-360, 360),
    source=st.none() | st.sampled_from(["5:1", "home", "47.4,8.5,500,-90"]),
    model=st.sampled_from(["kinematic", "position"]),
    follow=st.booleans(),
    attitude_bound_deg=st.floats(0, 180),
)
def test_settings_round_trip_through_toml(
    *,
    directory: str | None,
    urls: list[str],
    keys: dict[str, str],
    deny: list[str],
    alpha: float | str,
    speed: float,
    weights_hz: float | str,
    elements: int,
    yaw_deg: float,
    source: str | None,
    model: str,
    follow: bool,
    attitude_bound_deg: float,
) -> None:
    made = Settings.model_validate(
        {
            "center": {"source": source, "attitude_bound_deg": attitude_bound_deg},
            "links": {"urls": urls},
            "signing": {"keys": keys, "allow_unsigned": sorted(keys)[:1]},
            "tracks": {"deny": deny},
            "observer": {
                "alpha": alpha,
                "speed_max_mps": speed,
                "model": model,
                "follow_accuracy": follow,
            },
            "recording": {"directory": directory, "weights_hz": weights_hz},
            "array": {"elements": elements, "mount_yaw_deg": yaw_deg},
        }
    )
    assert Settings.from_toml(made.to_toml(), "written") == made


def test_written_settings_include_every_default() -> None:
    text = Settings().to_toml()
    assert Settings.from_toml(text, "written") == Settings()
    written = tomllib.loads(text)
    for name, section in Settings():
        known = {key for key, value in section if value is not None}
        assert written[name].keys() == known


# --- options ------------------------------------------------------------------------------------


def test_options_override_settings_and_none_keeps_them() -> None:
    before = Settings.from_toml('[center]\nsource = "5:1"\n[array]\nelements = 8\n', "x")
    after = before.override(
        center={"source": None}, array={"elements": 16, "kind": None}, links={"urls": ["tcp:a:1"]}
    )
    assert after.center.source == "5:1"
    assert (after.array.elements, after.array.kind) == (16, "ula")
    assert after.links.urls == ("tcp:a:1",)
    assert before.array.elements == 8
    assert after.observer == ObserverSettings()
    assert before.override() == before


def test_invalid_option_is_a_settings_error() -> None:
    with pytest.raises(ConfigError, match=r"^array\.elements = 0: .*greater than or equal to 1"):
        Settings().override(array={"elements": 0})
    with pytest.raises(ConfigError, match=r"^array\.shape is not a setting"):
        Settings().override(array={"shape": 3})


# --- array --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        '[array]\nkind = "list"\n',
        '[array]\nkind = "ula"\npositions_m = [[0, 0, 0]]\n',
        '[array]\nkind = "uca"\npositions = "there.csv"\n',
    ],
)
def test_list_array_requires_positions(text: str) -> None:
    assert "needs positions" in refusal(text)


def test_listed_codebook_requires_a_file() -> None:
    for text in ('kind = "file"', 'file = "beams.npy"', 'kind = "dft"\nfile = "beams.npy"'):
        assert "needs file" in refusal(f"[codebook]\n{text}\n")


def test_rectangle_is_limited_to_4096_elements() -> None:
    assert "at most 4096" in refusal('[array]\nkind = "ura"\nrows = 100\ncolumns = 100\n')


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("elements.csv", "# x, y, z\n0, 0, 0\n0, 0.005, 0  # the second\n\n0,0,0.005\n"),
        ("elements.txt", "0 0 0\n0 0.005 0\n0 0 5e-3\n"),
        ("elements.npy", None),
    ],
)
def test_element_positions_are_read_into_the_settings(
    tmp_path: Path, name: str, text: str | None
) -> None:
    """A recording thus holds them independently of the file."""
    rows = [[0.0, 0.0, 0.0], [0.0, 0.005, 0.0], [0.0, 0.0, 0.005]]
    file = tmp_path / name
    if text is None:
        np.save(file, np.array(rows))
    else:
        file.write_text(text, encoding="utf-8")
    config = tmp_path / "settings.toml"
    config.write_text(f'[array]\nkind = "list"\npositions = "{file}"\n', encoding="utf-8")
    found = load(config)
    file.unlink()
    assert found.array.positions is None
    assert found.array.positions_m == tuple(map(tuple, rows))
    assert Settings.from_toml(found.to_toml(), "again") == found
    assert assembly.array(found).elements_m == pytest.approx(np.array(rows))


@pytest.mark.parametrize("rows", ["0,0,0\n" * 5000, "0,0,1e300\n0,0,0\n"], ids=["many", "far"])
def test_impossible_positions_in_a_file_are_one_line(rows: str, tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(rows)
    config = tmp_path / "settings.toml"
    config.write_text(f'[array]\nkind = "list"\npositions = "{tmp_path / "p.csv"}"\n')
    with pytest.raises(ConfigError, match=r"array\.positions = '.*p\.csv'") as error:
        load(config)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_mark_of_an_editor_is_no_part_of_the_settings(tmp_path: Path) -> None:
    config = tmp_path / "settings.toml"
    config.write_bytes(b"\xef\xbb\xbf[beams]\nupdate_hz = 7\n")
    assert load(config).beams.update_hz == 7


@pytest.mark.parametrize(
    ("text", "content", "said"),
    [
        ("[array]\nkind = 'list'\npositions = 'x.csv'", b"1 1 1\n" * 400_000, "larger than 2 MiB"),
        ("[array]\nkind = 'list'\npositions = 'x.npy'", bytes(3 << 20), "larger than 2 MiB"),
        ("[hardware]\ncalibration = 'x.csv'", b"\n" * (5 << 20), "larger than 4 MiB"),
        ("[observer]\ndesign = 'x.json'", b"[" * (5 << 20), "larger than 4 MiB"),
        ("[array]\nelements = 513\ncoupling = 'x.npy'", b"", "at most 512"),
    ],
    ids=["rows", "array", "calibration", "design", "coupling"],
)
def test_large_files_are_rejected_before_they_are_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, content: bytes, said: str
) -> None:
    """Positions of 16 MB took 1.6 GB, and the condition of a large coupling matrix a minute."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / re.search(r"x\.\w+", text)[0]).write_bytes(content)  # type: ignore[index]
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(ConfigError, match=said) as error:
        assembly.array(embedded(load(tmp_path / "settings.toml")))
    assert "\n" not in str(error.value)


def test_elements_that_are_too_far_apart_are_rejected(tmp_path: Path) -> None:
    """Three of them, 20 km apart, took 1.7 GB: patterns are sampled at each side lobe."""
    (tmp_path / "x.csv").write_text("10000,0,0\n0,10000,0\n-10000,0,0\n")
    config = tmp_path / "settings.toml"
    config.write_text(f"[array]\nkind = 'list'\npositions = '{tmp_path / 'x.csv'}'\n")
    with pytest.raises(
        ConfigError, match=r"up to 2\.\d+e\+06 wavelengths apart, the limit is 20000"
    ):
        assembly.array(embedded(load(config)))


def test_device_of_more_than_1024_elements_is_rejected() -> None:
    """The search of its settings took 20 s and 650 MB for 4096."""
    given = Settings().override(array={"elements": 1025}, hardware={"device": "adar1000"})
    with pytest.raises(
        ConfigError, match=r"^hardware\.device: the array has 1025 .* at most 1024$"
    ):
        assembly.equipment(given, assembly.array(given))


def test_matrix_of_more_than_a_million_numbers_is_rejected(tmp_path: Path) -> None:
    """One of four million bytes took 500 MB: each number becomes complex, in several copies."""
    np.save(tmp_path / "c.npy", np.ones((64, 16_385), dtype=np.int8))
    config = tmp_path / "settings.toml"
    config.write_text(f'[codebook]\nkind = "file"\nfile = "{tmp_path / "c.npy"}"\n')
    with pytest.raises(ConfigError, match=r"has 1048640 numbers; the limit is 1048576$"):
        matrix_of(load(config), CODEBOOK)


def test_pipe_in_place_of_settings_is_not_opened(tmp_path: Path) -> None:
    """It would be waited for without end, and silently. Nor is one that the settings name."""
    pipe, good = tmp_path / "pipe", tmp_path / "good.toml"
    os.mkfifo(pipe)
    good.write_text(f'[array]\nkind = "list"\npositions = "{pipe}"\n')
    for path in (pipe, good):
        with pytest.raises(ConfigError, match=r"pipe'?: not a file$"):
            load(path)


@pytest.mark.parametrize(
    "header",
    [
        "-" * 5000 + "1",
        "{[]: 1}",
        "{}\n  x\n y",
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**70}, 3)}}",
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**61}, 3)}}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1, 3)}",
        "(" * 3000,
    ],
    ids=["nested", "unhashable", "indented", "beyond 64 bits", "exabytes", "objects", "brackets"],
)
@pytest.mark.parametrize("key", ["array.coupling", "array.positions", "codebook.file"])
def test_hostile_npy_header_is_rejected_in_one_line(tmp_path: Path, key: str, header: str) -> None:
    file = tmp_path / "hostile.npy"
    file.write_bytes(b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode())
    section, _, name = key.partition(".")
    kind = {"positions": 'kind = "list"', "file": 'kind = "file"'}.get(name, "")
    config = tmp_path / "settings.toml"
    config.write_text(f'[{section}]\n{kind}\n{name} = "{file}"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="npy") as raised:
        found = load(config)
        for one in (COUPLING, CODEBOOK):
            matrix_of(found, one)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "No such file"),
        ("0, 0\n0, 1\n", "must have 3 or more finite numbers"),
        ("0, 0, x\n", "not a table of numbers"),
        ("0, 0, 0\n0, 0\n", "not a table of numbers"),
        ("0, 0, nan\n", "finite"),
        ("", "must have 3 or more finite numbers"),
    ],
)
def test_invalid_positions_file_is_named(tmp_path: Path, text: str | None, said: str) -> None:
    file = tmp_path / "elements.csv"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    config = tmp_path / "settings.toml"
    config.write_text(f'[array]\nkind = "list"\npositions = "{file}"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=said) as caught:
        load(config)
    assert str(caught.value).startswith(f"array.positions = '{file}'")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (
            {"kind": "list", "positions_m": [[0, 0, 0], [0, 0, 0]]},
            "two elements have the same position",
        ),
        ({"kind": "list", "positions_m": [[0, 0], [0, 1]]}, "rows of 3 numbers"),
        ({"kind": "list", "positions_m": [[0, 0, 0], [0, 0, 1, 1, 0, 0]]}, "rows of 3 numbers"),
    ],
)
def test_invalid_array_is_a_settings_error(array: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=f"^array: .*{said}"):
        assembly.array(Settings().override(array=array))


def test_coverage_is_built_from_settings() -> None:
    given = {
        "field_of_view_deg": 120.0,
        "azimuth_limits_deg": [-50.0, 40.0],
        "elevation_limits_deg": [-30.0, 20.0],
        "hidden_deg": [[170.0, -170.0, -90.0, -10.0]],
    }
    found = assembly.coverage(Settings().override(array=given))
    assert found.field_of_view_rad == pytest.approx(np.radians(120))
    assert found.azimuth_limits_rad == pytest.approx(np.radians([-50, 40]))
    assert found.elevation_limits_rad == pytest.approx(np.radians([-30, 20]))
    (hidden,) = found.hidden
    assert str(hidden) == "azimuth 170 to -170, elevation -90 to -10"
    assert assembly.coverage(Settings()) == EVERYWHERE
    wrong = Settings().override(array={"hidden_deg": [[0.0, 200.0, 0.0, 10.0]]})
    with pytest.raises(ConfigError, match=r"^array: azimuth 0 to 200 degrees"):
        assembly.coverage(wrong)


def test_equipment_is_built_from_settings(tmp_path: Path) -> None:
    def made(**sections: dict[str, object]) -> assembly.Equipment:
        found = Settings().override(array={"elements": 4}, **sections)
        return assembly.equipment(found, assembly.array(found))

    bare = made()
    assert (bare.codebook, bare.calibration, bare.uav_antennas) == (None, None, 4)
    radio = made(
        radio={
            "tx_power_dbm": 17.0, "bandwidth_hz": 1e6, "noise_figure_db": 3.0, "uav_antennas": 2,
        }
    )  # fmt: skip
    assert (radio.budget.tx_power_dbm, radio.budget.bandwidth_hz) == (17.0, 1e6)
    assert (radio.budget.noise_figure_db, radio.uav_antennas) == (3.0, 2)
    stored = made(codebook={"kind": "dft", "oversampling": 3}).codebook
    assert stored is not None
    assert stored.weights.shape == (4, 12)
    table = tmp_path / "measured.csv"
    lines = [f"{c},{3 - c},{10 * c},0" for c in range(4)]
    table.write_text("channel,element,phase_deg,gain_db\n" + "\n".join(lines), encoding="utf-8")
    calibrated = made(hardware={"calibration": str(table)}).calibration
    assert calibrated is not None
    assert calibrated.order == (3, 2, 1, 0)
    table.write_text("channel,element,phase_deg,gain_db\n0,0,0,0\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"^hardware\.calibration: 1 channels for 4 elements"):
        made(hardware={"calibration": str(table)})
    table.write_bytes(b"\xff")
    with pytest.raises(ConfigError, match=r"^hardware\.calibration = .*not UTF-8"):
        made(hardware={"calibration": str(table)})
    with pytest.raises(ConfigError, match=r"^hardware\.calibration = .*No such file"):
        made(hardware={"calibration": str(tmp_path / "missing.csv")})
    with pytest.raises(ConfigError, match=r"^codebook: a DFT codebook needs"):
        settings = Settings().override(codebook={"kind": "dft"}, array={"kind": "uca"})
        assembly.equipment(settings, assembly.array(settings))


def test_precoder_is_built_from_settings() -> None:
    given = {
        "method": "rzf", "policy": "drop", "loss_limit_db": 5.0, "condition_limit": 50.0,
        "regularisation": 0.5, "normalisation": "antenna", "priority": ["2:1"], "widen": "no",
        "floor_db": 1.5, "power": "max-min", "rate_weights": {"2:1": 3.0},
    }  # fmt: skip
    found = assembly.precoder(Settings().override(beams=given))
    for key, value in given.items():
        assert getattr(found, key) == (tuple(value) if isinstance(value, list) else value), key
    assert assembly.precoder(Settings()) == Precoder()
    radio = {"tx_power_dbm": 30.0, "bandwidth_hz": 1e6, "noise_figure_db": 3.0, "uav_antennas": 1}
    told = assembly.precoder(Settings().override(radio=radio))
    assert (told.budget, told.uav_antennas) == (
        LinkBudget(tx_power_dbm=30.0, bandwidth_hz=1e6, noise_figure_db=3.0),
        1,
    )


@pytest.mark.parametrize(
    ("given", "means"),
    [(True, Widen.GUARANTEE), (False, Widen.NO), ("likely", Widen.LIKELY), ("no", Widen.NO)],
)
def test_older_widen_values_keep_their_meaning(given: object, means: Widen) -> None:
    assert BeamSettings.model_validate({"widen": given}).widen is means


def test_power_allocation_requires_a_joint_normalisation() -> None:
    assert BeamSettings(power=Power.MAX_MIN).normalisation is Normalisation.TOTAL
    both = BeamSettings(power=Power.EQUAL, normalisation=Normalisation.ANTENNA)
    assert both.normalisation is Normalisation.ANTENNA
    with pytest.raises(ValidationError, match="power needs normalisation"):
        BeamSettings(power=Power.EQUAL, normalisation=Normalisation.STREAM)


def test_array_is_built_from_settings() -> None:
    ura = assembly.array(Settings().override(array={"kind": "ura", "rows": 2, "columns": 3}))
    assert (ura.kind, ura.size, ura.grid) == ("ura", 6, (2, 3))
    uca = assembly.array(Settings().override(array={"kind": "uca", "elements": 5}))
    gap = np.linalg.norm(uca.elements_m[0] - uca.elements_m[1])
    assert (uca.kind, gap) == ("uca", pytest.approx(uca.wavelength_m / 2))
    metres = {"spacing_m": 0.015, "frequency_hz": 10e9, "lever_arm_m": [1.0, 0.0, -2.0]}
    line = assembly.array(Settings().override(array=metres))
    assert line.elements_m[1, 1] == pytest.approx(0.015)
    assert line.lever_arm_m == pytest.approx(np.array([1.0, 0.0, -2.0]))
    facing = [[0, 0, 0, 1, 0, 0], [0, 0.1, 0, 0, 1, 0]]
    turned = {"kind": "list", "positions_m": facing, "element": "3gpp"}
    listed = assembly.array(Settings().override(array=turned))
    assert listed.element_from_array is not None
    assert listed.element_from_array[1, 0] == pytest.approx(np.array([0, 1, 0]))


# --- carrier ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "center"),
    [
        ("home", HomeCenter()),
        ("5:1", VehicleCenter(Source(5, 1))),
        ("255:0", VehicleCenter(Source(255, 0))),
        ("47.4,8.55,500", FixedCenter(lat_deg=47.4, lon_deg=8.55, alt_m=500.0, heading_deg=0.0)),
        (
            "-90,180,-3.5,-90",
            FixedCenter(lat_deg=-90.0, lon_deg=180.0, alt_m=-3.5, heading_deg=-90.0),
        ),
        (
            " 47.4, 8.55, 500, 90",
            FixedCenter(lat_deg=47.4, lon_deg=8.55, alt_m=500.0, heading_deg=90.0),
        ),
    ],
)
def test_center_text_round_trips(text: str, center: object) -> None:
    assert parse_center(text) == center
    assert parse_center(str(center)) == center


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "SYSID:COMPID"),
        ("5", "SYSID:COMPID"),
        ("5:", "SYSID:COMPID"),
        ("a:b", "SYSID:COMPID"),
        ("-1:1", "SYSID:COMPID"),
        ("5:1:1", "SYSID:COMPID"),
        ("Home", "SYSID:COMPID"),
        ("256:1", "at most 255"),
        ("1:256", "at most 255"),
        ("47,8", "LAT,LON,ALT"),
        ("47,8,500,90,1", "LAT,LON,ALT"),
        ("47,8,high", "LAT,LON,ALT"),
        ("47,,500", "LAT,LON,ALT"),
        ("90.1,8,500", "latitude must be -90..90"),
        ("47,-180.1,500", "longitude -180..180"),
        ("nan,8,500", "latitude"),
        ("47,inf,500", "longitude"),
    ],
)
def test_invalid_center_is_rejected(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        parse_center(text)
    assert repr(text) in str(caught.value)


@pytest.mark.parametrize("text", ["47,8,nan", "47,8,inf", "47,8,500,nan", "47,8,500,-inf"])
def test_center_height_and_heading_must_be_numbers(text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(repr(text))):
        parse_center(text)


@pytest.mark.parametrize("text", ["", "there"])
def test_missing_center_error_lists_all_three_kinds(text: str) -> None:
    with pytest.raises(ValueError, match=r"SYSID:COMPID.*LAT,LON,ALT.*home"):
        parse_center(text)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (
            '[observer.types.copter]\nspeed_max_mps = "x"\n',
            "observer.types.copter.speed_max_mps = 'x': Input should be a valid number",
        ),
        (
            '[observer.uav."1:1"]\nspeed_mx_mps = 3\n',
            'observer.uav."1:1".speed_mx_mps is not a setting;'
            ' did you mean observer.uav."1:1".speed_max_mps?',
        ),
        (
            "[observer.types.copterx]\nspeed_max_mps = 3\n",
            "observer.types = 'copterx': Input should",
        ),
        ("[observer]\nalpha = 'x'\n", "observer.alpha = 'x': Input should be 'auto', or Input"),
        ("[observer.types]\ncopter = 5\n", "observer.types.copter = 5: give a table"),
    ],
)
def test_error_in_a_table_of_a_section_names_the_whole_key(toml: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        Settings.from_toml(toml, "there.toml")
