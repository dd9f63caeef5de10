"""Beam study, ``companion study beams``: the beams of an array over a recorded flight.

A log is replayed through the pipeline, and the newest update is examined several times a second.
For each beam the study computes the gain by the prediction, the guaranteed gain within the pointing
bound, and, if the log has the simulator's truth, the true gain. The beams of the settings are
compared with those of ``[beams] widen = false`` for the same tracks, which shows the cost and the
benefit of widening. With a codebook (that of the settings, else a DFT's if the elements are on a
grid) it also computes the share that must be swept to include the best stored beam.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.beams.aim import directions
from companion.beams.hardware import codebooks
from companion.beams.hardware.codebooks import Codebook
from companion.beams.worth import link_budget
from companion.node.replay import log_events
from companion.pipeline import assembly
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.beams import modes
from companion.studies.beams.worth import Sample, Worth, aimed, given, summed_up
from companion.studies.origin import Progress, Row, StudiedLogs, silent, versions
from companion.studies.prediction.radio_link import LINKS
from companion.studies.truth import array_truth
from companion.studies.truth.array_truth import ArrayTruth
from companion.studies.truth.vehicles import named
from companion.values import BeamSet, Carrier, FloatArray, Update, UserError, Widen, kind_of

PROGRESS_EVERY: Final = 20  # looks between two progress messages


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamStudy(StudiedLogs):
    """Parameters of the beam study.

        links     names of the links over which widths and predictors are compared; may be empty

    Raises ``UserError`` for a rate out of range.
    """

    hz: float = 5.0  # looks per second of log
    links: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        known = [link.name for link in LINKS]
        if not set(self.links) <= set(known):
            raise UserError(f"--links {','.join(self.links)}: give some of {', '.join(known)}")
        if not 0.001 <= self.hz <= 1000:
            raise UserError(f"--hz {self.hz:g}: give updates per second, 0.001 to 1000")


@dataclass(frozen=True, slots=True, kw_only=True)
class StudiedFlight:
    """One flight: samples of every UAV in order of time, the array, and the source of the truth."""

    log: str
    center: str
    array: str
    codebook_beams: int | None
    widen: bool
    looks: int
    truth: str | None
    samples: tuple[Sample, ...]

    @property
    def by_uav(self) -> dict[str, list[Sample]]:
        """Samples of each UAV, in the order of first appearance."""
        found: dict[str, list[Sample]] = {}
        for sample in self.samples:
            found.setdefault(sample.uav, []).append(sample)
        return found


# --- one look -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Sight:
    """Data shared by all sampling instants of one log."""

    pipeline: Pipeline
    equipment: Equipment
    codebook: Codebook | None

    def worths(
        self, beam_set: BeamSet, carrier: Carrier, truly: dict[str, FloatArray]
    ) -> dict[str, Worth]:
        """Return the performance of each beam of a set of beams, by UAV.

        ``truly`` holds the true directions, (3,) each.
        """
        if not beam_set.beams:
            return {}
        array, towards = self.pipeline.array, directions(beam_set)
        guaranteed, true_gains = given(self.pipeline, beam_set, truly)
        budget, antennas = self.equipment.budget, self.equipment.uav_antennas
        sinr_db = link_budget.sinr_of_beams_db(array, beam_set, towards, budget, antennas)
        efficiency = link_budget.spectral_efficiency(10 ** (sinr_db / 10), beam_set.groups)
        return {
            beam.uav: Worth(
                gain_db=beam.gain_db,
                loss_db=beam.loss_db,
                guaranteed_gain_db=guaranteed[i],
                true_gain_db=10 * math.log10(true_gains[i]) if beam.uav in truly else None,
                sinr_db=float(sinr_db[i]),
                spectral_efficiency=float(efficiency[i]),
                group=beam.group,
                widened=beam.widened,
                method=beam_set.method,
                condition_number=beam_set.condition_number or 1.0,
            )
            for i, beam in enumerate(beam_set.beams)
        }

    def swept(
        self, towards: FloatArray, bound_rad: float | None, truly: FloatArray | None
    ) -> tuple[int | None, float | None, bool | None]:
        """Return a direction's (3,) best stored beam, the share to sweep, and whether it misses.

        A share misses if it lacks the beam that is best for the true direction. None: unknown.
        """
        if self.codebook is None:
            return None, None, None
        array = self.pipeline.array
        (best,), _ = codebooks.best(self.codebook, array, towards[np.newaxis])
        held = codebooks.candidates(self.codebook, array, towards, bound_rad)
        missed = None
        if truly is not None:
            (wanted,), _ = codebooks.best(self.codebook, array, truly[np.newaxis])
            missed = int(wanted) not in held.tolist()
        return int(best), len(held) / self.codebook.size, missed


def sight(pipeline: Pipeline) -> Sight:
    """Return radio and codebook of the settings; raises ``ConfigError`` if they are inconsistent.

    Without a codebook in the settings, the codebook is a DFT's over the array's own grid, if it has
    one.
    """
    equipment = assembly.equipment(pipeline.settings, pipeline.array)
    codebook = equipment.codebook
    if codebook is None and pipeline.array.grid is not None:
        codebook = codebooks.dft(pipeline.array)
    return Sight(pipeline, equipment, codebook)


def look(seen: Sight, update: Update, truth: ArrayTruth | None, t_s: float) -> list[Sample]:
    """Return samples of every tracked UAV at one update, ``t_s`` seconds into the log."""
    pipeline, carrier = seen.pipeline, update.carrier
    if carrier is None:
        return [Sample(t_s=t_s, uav=track.uav) for track in update.tracks]
    truly = array_truth.known_directions(truth, update.tracks, carrier, pipeline.array)
    as_set = update.beams
    sharp = as_set
    if pipeline.precoder.widen is not Widen.NO:
        sharp = aimed(pipeline, update, Widen.NO)
    worths = [seen.worths(beam_set, carrier, truly) for beam_set in (as_set, sharp)]
    beams = {
        beam.uav: (beam.pointing_bound_rad, towards)
        for beam_set in (as_set, sharp)
        for beam, towards in zip(beam_set.beams, directions(beam_set), strict=True)
    }
    samples = []
    for track in update.tracks:
        if track.uav not in beams:
            samples.append(Sample(t_s=t_s, uav=track.uav))
            continue
        bound_rad, towards = beams[track.uav]
        true = truly.get(track.uav)
        best, share, missed = seen.swept(towards, bound_rad, true)
        off_rad = None if true is None else _angle_rad(towards, true)
        set_worth, sharp_worth = (worth.get(track.uav) for worth in worths)
        samples.append(
            Sample(
                t_s=t_s,
                uav=track.uav,
                pointing_bound_rad=bound_rad,
                off_rad=off_rad,
                codebook_best=best,
                sweep_share=share,
                missed=missed,
                as_set=set_worth,
                sharp=sharp_worth,
            )
        )
    return samples


def _angle_rad(towards: FloatArray, truly: FloatArray) -> float:
    """Return the angle between two unit directions (3,); exact also for small angles."""
    return math.atan2(float(np.linalg.norm(np.cross(towards, truly))), float(towards @ truly))


# --- the study ----------------------------------------------------------------------------------


def updates(logs: Sequence[Path], pipeline: Pipeline, hz: float) -> Iterator[tuple[float, Update]]:
    """Yield the time within a flight in seconds, at ``hz``, each with the latest tick's update.

    Each update is yielded once. Steps the pipeline through the whole flight.
    """
    period_ns = round(1e9 / hz)
    begins_ns, due_ns, seen = None, 0, None
    for event in log_events(logs, pipeline.settings):
        if begins_ns is None:
            begins_ns, due_ns = event.t_ns, event.t_ns + period_ns
        while due_ns < event.t_ns:  # all earlier events are processed
            update = pipeline.last_update
            if update is not None and update is not seen:
                seen = update
                yield (due_ns - begins_ns) * 1e-9, update
            due_ns += period_ns
        pipeline.step(event)


def watch(
    logs: Sequence[Path], settings: Settings, hz: float, progress: Progress = silent
) -> StudiedFlight:
    """Study the logs of one flight through the pipeline.

    Raises ``UserError``, ``LogError`` or ``ConfigError`` if no UAV gets a beam.
    """
    pipeline = Pipeline(settings)
    seen, truth, sought = sight(pipeline), None, False
    samples: list[Sample] = []
    looks, name = 0, named(logs)
    for t_s, update in updates(logs, pipeline, hz):
        if not sought and any(kind_of(track.uav).reports_itself for track in update.tracks):
            truth, sought = array_truth.load(logs, pipeline), True
        if update.tracks:
            samples += look(seen, update, truth, t_s)
            looks += 1
        if looks % PROGRESS_EVERY == 0:
            progress(f"{name}: {t_s:.0f} s of log")
    if not any(sample.as_set or sample.sharp for sample in samples):
        raise UserError(f"{name}: no UAV gets a beam while the carrier's pose is known")
    array = pipeline.array
    return StudiedFlight(
        log=name,
        center=str(pipeline.center.place),
        array=f"{array.size} elements ({array.kind}) at {settings.array.frequency_hz * 1e-9:g} GHz",
        codebook_beams=None if seen.codebook is None else seen.codebook.size,
        truth=None if truth is None else truth.kind,
        widen=pipeline.precoder.widen is not Widen.NO,
        looks=looks,
        samples=tuple(samples),
    )


def study(
    setting: BeamStudy, progress: Progress = silent
) -> tuple[dict[str, Any], list[StudiedFlight]]:
    """Return the answer as written to ``beams.json``, and the data of the report.

    Raises ``UserError``, ``LogError`` or ``ConfigError`` for a log without any beam.
    """
    found = [watch(logs, settings, setting.hz, progress) for logs, settings in setting.by_flight()]
    rows: list[Row] = [
        {"log": watched.log, "uav": uav, **summed_up(samples), "truth": watched.truth}
        for watched in found
        for uav, samples in watched.by_uav.items()
    ]
    modes_found = [
        row
        for logs, settings in setting.by_flight()
        for link in LINKS
        if link.name in setting.links
        for row in modes.compare(logs, settings, link, progress)
    ]
    return {
        "rows": rows,
        "modes": modes_found,
        "summary": summed_up([sample for watched in found for sample in watched.samples]),
        "logs": [
            {field.name: getattr(watched, field.name) for field in fields(StudiedFlight)[:-1]}
            for watched in found  # without its samples
        ],
        "command": setting.command_line("beams", links=setting.links, hz=setting.hz),
        "versions": versions(),
        "hz": setting.hz,
    }, found
