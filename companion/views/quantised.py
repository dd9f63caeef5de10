"""Weights quantised to the settings of a device."""

from companion.beams.aim import directions
from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.hardware import tables
from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.devices import Beamformer
from companion.pipeline.assembly import Equipment
from companion.values import BeamSet


def device_table(
    device: Beamformer,
    beam_set: BeamSet,
    array: Array,
    equipment: Equipment,
    only: str | None = None,
) -> tables.DeviceTable:
    """Return the settings of a device that best approximate the weights.

    Each beam, or only that of one UAV, is fitted towards its own UAV and away from the others in
    its group. Raises ``UserError`` with the reason if the device cannot apply them.
    """
    steering = steering_matrix(array, directions(beam_set))
    wanted = []
    for i, beam in enumerate(beam_set.beams):
        if only not in (None, beam.uav):
            continue
        others = [j for j, one in enumerate(beam_set.beams) if j != i and one.group == beam.group]
        wanted.append(
            tables.WantedBeam(
                uav=beam.uav,
                weights=beam_set.weights[:, i],
                azimuth_rad=beam.azimuth_rad,
                elevation_rad=beam.elevation_rad,
                steering=steering[:, [i, *others]],
            )
        )
    calibration = equipment.calibration or Calibration.ideal(range(array.size))
    return tables.fit(device, wanted, calibration, equipment.unit_gains)
