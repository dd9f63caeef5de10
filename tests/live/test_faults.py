"""Every fault against a live service: API answers, recording and recovery.

Flights are synthetic: loss, truncation, duplication and arrival order depend only on the seed.
Counts are therefore exact unless stated otherwise; only latencies depend on the machine.
"""

import re
from collections import Counter

import pytest
from faulty_flight import Case, Outcome, fly_all
from support import LONGEST_FRAME, read_metadata

from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.recording import schemas
from companion.values import Frame

GNSS = "trust_gnss = true\nnode_utc_error_s = 0.01\n"
GNSS_ERROR_S = 0.01 + 0.02 + 0.001
"""What a clock known from GNSS may be off: both ends' errors, and a stamp's millisecond."""
SCHEDULER_S = 0.1
"""What a busy machine adds to a latency, and then some."""

CASES = {
    "senders": Case(
        faults=(
            "drift@1:1=-24000",
            "drift@6:1=24000",
            "reboot@2:1=4",
            "frozen@3:1=3:3",
            "glitch@4:1=4:500:6",
        ),
        uavs=6,
    ),
    "loss": Case(faults=("loss@1:1=0.3", "loss@3:1=0.3")),
    "duplication": Case(faults=("duplication@1:1=0.2", "duplication@3:1=0.2")),
    "delay": Case(faults=("delay@1:1=0.3", "delay@2:1=0.3"), clocks=GNSS),
    "jitter": Case(faults=("jitter=0.1",), links=2),
    "burst": Case(faults=("burst=0.4:1",)),
    "reordering": Case(faults=("reordering=0.1",)),
    "bit-errors": Case(faults=("bit-errors@1:1=5e-4", "bit-errors@2:1=5e-4")),
    "truncation": Case(faults=("truncation@1:1=0.2", "truncation@2:1=0.2")),
    "garbage": Case(faults=("garbage=0.2",)),
    "shared-id": Case(scenario="shared-id"),
    "adsb": Case(scenario="adsb", seconds=12.0),
}
BITES = 9
"""Frames that may still wait, when all is over, for the end of one that a damaged length claims."""


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    """All cases, flown at once."""
    return fly_all(CASES, tmp_path_factory.mktemp("faults"))


# --- any fault ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_recording_replays_identically_and_matches_the_api(
    flights: dict[str, Outcome], name: str
) -> None:
    done = flights[name]
    returncode, _, err = done.exit
    assert returncode == 0, err
    assert "Traceback" not in err
    summary = read_metadata(done.recording)["summary"]
    assert done.replayed["digest"] == summary["digest"]
    assert done.replayed["rejected"] == done.rejected
    assert done.replayed["frames"] == done.status["frames"] == len(done.received)
    assert done.status["recording"]["state"] == "recording"
    assert done.status["recording"]["dropped"] == 0
    refused: Counter[str] = Counter()
    for one in done.recorded[schemas.REJECTIONS_TOPIC]:
        refused[one.reason] += one.count
    assert refused == done.rejected
    said = [(one.name, one.message) for one in done.recorded[schemas.LOG_TOPIC]]
    told = [(event["subject"], event["text"]) for event in done.events]
    assert said[: len(told)] == told  # later ones are about the silence at the end


@pytest.mark.parametrize("name", CASES)
def test_all_uavs_are_live_with_beams_at_the_end(flights: dict[str, Outcome], name: str) -> None:
    done = flights[name]
    flown = set(done.reports_flown) - {"5:1"}
    flown -= {"1:1"} if name == "shared-id" else set()  # the identity of this track is ambiguous
    assert len(done.moments) > 5
    # One of the last moments: tracks coast if the machine is busy for 2 s.
    good = [
        moment
        for moment in done.moments[-4:]
        if moment.ready
        and flown <= moment.beamed
        and {moment.uavs[uav]["state"] for uav in flown} == {"live"}
    ]
    assert good, [(m.ready, m.beamed, m.beams["left_out"]) for m in done.moments[-4:]]


@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.struck or not case.faults])
def test_uavs_without_faults_lose_no_report(flights: dict[str, Outcome], name: str) -> None:
    done = flights[name]
    frames = Counter(str(frame.source) for frame in done.flown)
    for link in done.links:
        assert link["overflowed"] in (None, 0)
        heard = {one["id"]: one for one in link["components"]}
        for uav in honest(done):
            assert (heard[uav]["frames"], heard[uav]["gaps"]) == (frames[uav], 0), uav
    for uav in honest(done) - {"5:1"}:
        assert done.uavs[uav]["reports"] == done.reports_flown[uav], uav
        assert set(done.uavs[uav]["rejected"]) <= {"no-position"}, uav  # relayed by ADS-B
        states = {moment.uavs[uav]["state"] for moment in done.moments if uav in moment.uavs}
        assert states <= {"live", "coasting"}, uav  # coasting: the machine was busy elsewhere


@pytest.mark.parametrize("name", CASES)
def test_no_bound_is_violated(flights: dict[str, Outcome], name: str) -> None:
    """Against the flown truth. A delay is measured once GNSS time is available; bounds hold from
    then."""
    done = flights[name]
    checked = 0
    for uav in done.last.uavs:
        for off_m, entry in done.errors_m(uav):
            if name == "delay" and uav in done.case.struck and entry["clock"]["kind"] != "gnss":
                continue
            assert min(off_m) <= entry["bound_m"], (uav, entry)
            checked += 1
    assert checked > 2 * len(done.last.uavs)


# --- sender faults ------------------------------------------------------------------------------


def test_drift_beyond_the_limit_is_reported(flights: dict[str, Outcome]) -> None:
    """A clock 2.4 % slow looks like a link that slows down; a fast clock hides nothing."""
    done = flights["senders"]
    told = {one["subject"] for one in done.events if "clock stalled" in one["text"]}
    assert "1:1" in told or "6:1" in told
    for uav in ("1:1", "6:1"):
        assert done.touched[f"drift@{uav}"] > 100
        assert done.uavs[uav]["rejected"] == {}
        assert done.uavs[uav]["reports"] == done.reports_flown[uav]


def test_reboot_is_reported_once_and_restarts_the_track(flights: dict[str, Outcome]) -> None:
    done = flights["senders"]
    texts = [event["text"] for event in done.events if "restarted" in event["text"]]
    assert len(texts) == 1
    stepped = re.fullmatch(r"2:1 was restarted: its boot clock stepped back to (\S+) s", texts[0])
    assert stepped is not None, texts
    assert 0.5 <= float(stepped[1]) < 2.0  # three timestamps over half a second confirm it
    unplaced = done.rejected["unplaced-stamp"]
    assert done.uavs["2:1"]["rejected"] == {"unplaced-stamp": unplaced}
    assert 2 <= unplaced <= 10
    since = [frame for frame in done.flown if is_report(frame, "2:1") and boot_s(frame) < 50.0]
    assert done.uavs["2:1"]["reports"] + unplaced == len(since)
    (link,) = done.links
    # Sequence 0 looks late; three in a row indicate a restarted sender, not a gap.
    assert (link["late"], link["gaps"], link["repeats"]) == (3, 0, 0)


def test_frozen_position_is_rejected_and_the_track_coasts(flights: dict[str, Outcome]) -> None:
    done = flights["senders"]
    frozen = done.touched["frozen@3:1"]
    assert frozen == pytest.approx(3.0 / 0.2, abs=1)  # five reports a second
    assert done.uavs["3:1"]["rejected"] == {"frozen": frozen}
    assert done.rejected["frozen"] == frozen
    assert done.uavs["3:1"]["reports"] == done.reports_flown["3:1"] - frozen
    recent = done.uavs["3:1"]["recent_rejections"]
    assert [one["reason"] for one in recent] == ["frozen"] * 8
    assert [one["at"] for one in recent] == sorted(one["at"] for one in recent)
    said = done.said("3:1")
    why = "frozen, new stamp on the previous report's position"
    form = rf"no report of 3:1 was used in the last \S+ s: {why}"
    unheard = [text for text in said if re.fullmatch(form, text)]
    assert len(unheard) == 1
    assert _of_the_track(said) == {"3:1 is live", "3:1 is coasting", *unheard}
    assert said[-1] == "3:1 is live"
    heard = [one for one in done.moments if "3:1" in one.uavs]
    fit = [one for one in heard[1:] if one.beams["unfit"] is None]  # the carrier is known
    assert fit
    assert all("3:1" in one.beamed for one in fit)  # also while it coasts


def test_glitch_reports_are_rejected_individually(flights: dict[str, Outcome]) -> None:
    done = flights["senders"]
    assert done.touched["glitch@4:1"] == 6
    assert done.uavs["4:1"]["rejected"] == {"unreachable": 6}
    assert set(done.rejected) == {"unplaced-stamp", "frozen", "unreachable"}
    assert done.uavs["4:1"]["reports"] == done.reports_flown["4:1"] - 6
    for one in done.uavs["4:1"]["recent_rejections"]:
        off = re.fullmatch(r"(\S+) m from the prediction, at most (\S+) m possible", one["detail"])
        assert off is not None, one
        assert float(off[1]) == pytest.approx(500.0, abs=float(off[2]))
    unheard = {text for text in done.said("4:1") if text.startswith("no report of 4:1 was used")}
    assert len(unheard) <= 1
    assert _of_the_track(done.said("4:1")) <= {"4:1 is live", "4:1 is coasting", *unheard}


# --- link faults --------------------------------------------------------------------------------


def test_lost_frames_are_counted_as_gaps(flights: dict[str, Outcome]) -> None:
    """Except frames lost before a sender's first received frame and after its last."""
    done = flights["loss"]
    (link,) = done.links
    assert link["frames"] == done.sent["frames"] - sum(done.touched.values())
    assert (link["late"], link["repeats"], link["bad_crc"]) == (0, 0, 0)
    gaps = {one["id"]: one["gaps"] for one in link["components"]}
    assert gaps == {uav: holes(done, uav) for uav in gaps}
    assert link["gaps"] == sum(gaps.values()) > 0.9 * sum(done.touched.values())
    assert done.rejected == {}
    for uav in ("1:1", "3:1"):
        assert done.uavs[uav]["reports"] == sum(is_report(one, uav) for one in done.received)
        assert done.uavs[uav]["reports"] < 0.9 * done.reports_flown[uav]


def test_duplicate_frames_count_once(flights: dict[str, Outcome]) -> None:
    done = flights["duplication"]
    (link,) = done.links
    copies = sum(done.touched.values())
    assert link["frames"] == done.sent["frames"] + copies
    assert (link["late"] + link["repeats"], link["gaps"]) == (copies, 0)
    again = Counter(one.raw for one in done.received if is_report(one))
    twice = Counter({raw: times - 1 for raw, times in again.items() if times > 1})
    assert done.rejected == {"duplicate": twice.total()}
    assert link["reports"]["first"] == done.reports_flown.total()
    assert link["reports"]["total"] == done.reports_flown.total() + twice.total()
    for uav in ("1:1", "3:1"):
        assert done.uavs[uav]["reports"] == done.reports_flown[uav]


def _of_the_track(said: list[str]) -> set[str]:
    """Event texts without verdicts on links, which may concern one or several together."""
    return {text for text in said if not text.startswith("link")}


def test_delay_is_measured_if_gnss_time_is_available(flights: dict[str, Outcome]) -> None:
    done = flights["delay"]
    for uav, late_s in {"1:1": 0.3, "2:1": 0.3, "3:1": 0.0, "4:1": 0.0}.items():
        clock = done.last.uavs[uav]["clock"]
        assert clock["kind"] == "gnss", uav
        assert clock["uncertainty_s"] < GNSS_ERROR_S + 0.07  # plus the possible drift
        assert clock["constant_delay_s"] == pytest.approx(late_s, abs=clock["uncertainty_s"])
        entries = (one.uavs[uav] for one in done.moments if uav in one.uavs)
        known = [entry for entry in entries if entry["clock"]["kind"] == "gnss"]
        assert len(known) > 2
        for entry in known[1:]:  # the newest report may precede the first clock estimate
            assert entry["latency_s"] >= late_s - entry["clock"]["uncertainty_s"], uav
    (link,) = done.links
    assert link["frames"] == done.sent["frames"]
    assert (link["gaps"], link["late"], done.rejected) == (0, 0, {})


def test_first_copy_over_two_jittery_links_is_used(flights: dict[str, Outcome]) -> None:
    """The later one counts once its positions have agreed with those of the first."""
    done = flights["jitter"]
    total = done.reports_flown.total()
    assert done.touched["jitter"] == 2 * done.sent["frames"]
    assert set(done.rejected) <= {"duplicate", "stranger"}
    assert 0.8 * total < done.rejected["duplicate"] <= total
    assert sum(link["reports"]["first"] for link in done.links) == total
    for link in done.links:
        assert link["frames"] == done.sent["frames"]
        assert (link["gaps"], link["late"], link["repeats"]) == (0, 0, 0)
        reports = link["reports"]
        assert 0.8 * total < reports["total"] <= total
        assert reports["first_share"] == reports["first"] / reports["total"]
        assert 0.3 < reports["first_share"] < 0.7  # equals
        assert 0.05 < reports["latency_p50_s"] < reports["latency_p95_s"]
        assert reports["latency_p95_s"] < 1.0  # ten means: the longest jitter
    for uav, entry in done.uavs.items():
        assert entry["reports"] == done.reports_flown[uav], uav


def test_late_bursts_are_used_completely(flights: dict[str, Outcome]) -> None:
    """If a share of the frames waits for up to 1 s, the 95th percentile has that latency."""
    done = flights["burst"]
    (link,) = done.links
    struck = done.touched["burst"] / done.sent["frames"]
    assert struck > 0.2
    assert link["frames"] == done.sent["frames"]
    assert (link["gaps"], link["late"], link["repeats"], done.rejected) == (0, 0, 0, {})
    expected_s = 1.0 - 0.05 / struck
    assert link["reports"]["latency_p95_s"] == pytest.approx(expected_s, abs=0.15 + SCHEDULER_S)
    for uav, entry in done.uavs.items():
        assert entry["reports"] == done.reports_flown[uav], uav


def test_reordered_frames_are_late_and_used(flights: dict[str, Outcome]) -> None:
    done = flights["reordering"]
    (link,) = done.links
    overtaken = sum(overtaken_frames(done, one["id"]) for one in link["components"])
    assert 0 < overtaken <= done.touched["reordering"]
    assert link["frames"] == done.sent["frames"]
    assert (link["late"], link["gaps"], link["repeats"]) == (overtaken, overtaken, 0)
    assert done.rejected == {}
    for uav, entry in done.uavs.items():
        assert entry["reports"] == done.reports_flown[uav], uav


@pytest.mark.parametrize("name", ["bit-errors", "truncation"])
def test_damaged_frames_are_counted_and_lose_no_others(
    flights: dict[str, Outcome], name: str
) -> None:
    """A damaged frame is a bad checksum or an unknown message; a few become garbage if their
    magic byte or flags are hit or little else remains. Very rarely, bytes of a truncated
    frame that look like a magic byte start one more."""
    done = flights[name]
    (link,) = done.links
    struck = sum(done.touched.values())
    nothing_invented(done)
    waiting = done.sent["frames"] - struck - link["frames"]
    assert 0 <= waiting <= BITES
    heads = link["bad_crc"] + done.rejected["unknown-message"]
    assert 0.75 * struck <= heads <= 1.1 * struck
    assert heads + done.rejected["garbage"] >= struck - BITES
    assert set(done.rejected) == {"bad-crc", "unknown-message", "garbage"}
    assert done.rejected["bad-crc"] == link["bad_crc"] == link["lost"]["bad-crc"]
    received_bytes = sum(len(frame.raw) for frame in done.received)
    assert done.rejected["garbage"] <= link["bytes"] - received_bytes
    assert link["bytes"] == done.sent["bytes"] or name == "truncation"
    gaps = {one["id"]: one["gaps"] for one in link["components"]}
    assert gaps == {uav: holes(done, uav) for uav in gaps}
    for uav in ("1:1", "2:1"):
        assert done.uavs[uav]["reports"] == sum(is_report(one, uav) for one in done.received)


def test_garbage_is_counted_in_bytes_and_loses_no_frame(flights: dict[str, Outcome]) -> None:
    """Except garbage bytes claimed by a false header: one byte in 128 is a magic byte."""
    done = flights["garbage"]
    (link,) = done.links
    nothing_invented(done)
    assert 0 <= done.sent["frames"] - link["frames"] <= BITES
    noise_bytes = link["bytes"] - done.sent["bytes"]
    assert noise_bytes == pytest.approx(32.5 * done.touched["garbage"], rel=0.2)
    assert 0.8 * noise_bytes <= done.rejected["garbage"] <= noise_bytes
    heads = link["bad_crc"] + done.rejected["unknown-message"]
    assert 0 < heads <= noise_bytes / 64
    assert noise_bytes - done.rejected["garbage"] <= heads * LONGEST_FRAME
    assert link["gaps"] == sum(holes(done, one["id"]) for one in link["components"])


# --- scenarios ----------------------------------------------------------------------------------


def test_track_of_a_shared_id_follows_one_uav(flights: dict[str, Outcome]) -> None:
    """They are 600 m apart: the track stays on one of them, never on the other or in between."""
    done = flights["shared-id"]
    followed = {off_m.index(min(off_m)) for off_m, _ in done.errors_m("1:1")}
    assert len(followed) == 1
    refused = done.uavs["1:1"]["rejected"]
    assert done.rejected == refused
    assert done.uavs["1:1"]["reports"] + sum(refused.values()) == done.reports_flown["1:1"]
    assert sum(refused.values()) >= done.reports_flown["1:1"] // 2


def test_shared_id_is_reported(flights: dict[str, Outcome]) -> None:
    done = flights["shared-id"]
    assert done.uavs["1:1"]["rejected"]["shared-id"] > 0
    assert [one["severity"] for one in done.events if "send under the id" in one["text"]] == [
        "warning"
    ]


def test_adsb_aircraft_have_own_tracks_and_one_matches_a_uav(flights: dict[str, Outcome]) -> None:
    done = flights["adsb"]
    relayed = {uav: one for uav, one in done.last.uavs.items() if uav.startswith("icao:")}
    assert {"icao:F00001", "icao:F00002", "icao:F00006"} <= set(relayed)
    assert "icao:F00005" not in relayed  # it never sends its height
    assert relayed["icao:F00006"]["same_as"] == "3:1"
    assert {one["same_as"] for uav, one in relayed.items() if uav != "icao:F00006"} == {None}
    assert not any(one["target"] for one in relayed.values())
    assert done.last.beamed == {"1:1", "2:1", "3:1", "4:1"}
    assert set(done.rejected) <= {"duplicate", "no-altitude", "no-position"}
    used = sum(count for uav, count in done.replayed["reports"].items() if uav in relayed)
    assert used + sum(done.rejected.values()) == done.sent["by_message"]["ADSB_VEHICLE"]
    assert done.rejected["no-altitude"] > 0
    assert done.rejected["duplicate"] > 0


# --- sent and received frames -------------------------------------------------------------------


def honest(done: Outcome) -> set[str]:
    """UAVs without faults, including the carrier 5:1 if a fault does not affect all."""
    if done.case.scenario == "shared-id":
        return set(done.reports_flown) - {"1:1"}
    return set(done.reports_flown) - done.case.struck


def is_report(frame: Frame, uav: str | None = None) -> bool:
    """Whether a frame is a GLOBAL_POSITION_INT, of the given vehicle or of any."""
    return frame.msgid == GLOBAL_POSITION_INT and uav in (None, str(frame.source))


def boot_s(report: Frame) -> float:
    """The boot clock in a GLOBAL_POSITION_INT."""
    return int.from_bytes(report.payload[:4], "little") * 1e-3


def places(done: Outcome, uav: str) -> list[int]:
    """Positions of the received frames in their sender's stream, in order of arrival."""
    sent = [frame.raw for frame in done.flown if str(frame.source) == uav]
    place = {raw: number for number, raw in enumerate(sent)}
    assert len(place) == len(sent)
    return [place[frame.raw] for frame in done.received if str(frame.source) == uav]


def holes(done: Outcome, uav: str) -> int:
    """Frames missing between a vehicle's first and last received frame."""
    came = places(done, uav)
    return max(came) - min(came) + 1 - len(came)


def overtaken_frames(done: Outcome, uav: str) -> int:
    """Frames of a vehicle that arrived after a later one."""
    came = places(done, uav)
    return sum(number < max(came[:at], default=0) for at, number in enumerate(came))


def nothing_invented(done: Outcome) -> None:
    """Every accepted frame was sent, and accepted once."""
    assert Counter(one.raw for one in done.received) <= Counter(one.raw for one in done.flown)
