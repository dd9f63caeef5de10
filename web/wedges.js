// Boresight and beams of the plan view.

import * as format from "./format.js";

const RADIANS = Math.PI / 180;

/** Boresight, then each beam as a wedge of its half-power width. */
export function drawBeams(view, uavs) {
  const { array, beams } = view.scene;
  const { context } = view;
  if (!array) return;
  if (format.known(array.boresight_bearing_deg)) {
    context.strokeStyle = view.scene.beamsLive && !view.scene.carrier?.unfit
      ? view.colour.bore : view.colour.stale;
    context.lineWidth = 1.2;
    context.setLineDash([2, 6]);
    context.beginPath();
    context.moveTo(...view.atBearing(array.boresight_bearing_deg, 16));
    context.lineTo(...view.atBearing(array.boresight_bearing_deg, view.outerPx));
    context.stroke();
    context.setLineDash([]);
  }
  const byId = new Map(uavs.map((uav) => [uav.id, uav]));
  for (const beam of beams) drawBeam(view, beam, array, byId.get(beam.uav));
}

function drawBeam(view, beam, array, uav) {
  if (!format.known(beam.bearing_deg)) return;
  const { context } = view;
  const isTrue = view.scene.beamsLive && beam.oldS === undefined;
  const colour = isTrue ? view.colour.beam : view.colour.stale;
  const widthDeg = wedgeWidthDeg(beam, array);
  const flatM = uav ? Math.hypot(uav.north_m, uav.east_m)
    : (beam.range_m ?? 0) * Math.cos((beam.elevation_deg ?? 0) * RADIANS);
  // A beam does not end at its target: it is drawn beyond it, fading.
  const targetPx = flatM * view.pxPerM;
  const reachPx = Math.max(targetPx + 60, view.outerPx);
  const fade = context.createRadialGradient(...view.centre, 0, ...view.centre, reachPx);
  const stop = Math.min(0.98, targetPx / reachPx);
  // Many wide beams overlap: together they should look no stronger than one.
  const strength = Math.max(0.1, Math.min(1, 360 / (widthDeg * view.scene.beams.length)));
  fade.addColorStop(0, withAlpha(colour, 0.7 * strength));
  fade.addColorStop(stop, withAlpha(colour, 0.45 * strength));
  fade.addColorStop(1, withAlpha(colour, 0));
  const chosen = view.scene.selected === beam.uav;
  context.globalAlpha = view.scene.selected === null || chosen ? 1 : 0.55;
  context.fillStyle = fade;
  const [from, to] = [-0.5, 0.5].map((side) =>
    (beam.bearing_deg + side * widthDeg - 90) * RADIANS);
  context.beginPath();
  context.moveTo(...view.centre);
  context.arc(...view.centre, reachPx, from, to);
  context.closePath();
  context.fill();
  // A centre line keeps a narrow beam visible near the carrier.
  context.strokeStyle = fade;
  context.lineWidth = chosen ? 2 : 1.1;
  context.beginPath();
  context.moveTo(...view.centre);
  context.lineTo(...view.atBearing(beam.bearing_deg, reachPx));
  context.stroke();
  context.globalAlpha = 1;
}

/** Width of a beam in bearing, degrees; of a widened one at least twice the pointing bound. */
function wedgeWidthDeg(beam, array) {
  const naturalDeg = naturalWidthDeg(beam, array);
  if (!beam.widened || !format.known(beam.pointing_bound_deg)) return naturalDeg;
  return Math.max(naturalDeg, Math.min(120, 2 * beam.pointing_bound_deg));
}

/**
 * Half-power width in bearing, degrees. A line of elements has a constant beamwidth in the sine of
 * the angle off boresight, so its beam widens with steering; other arrays: as the service states.
 */
function naturalWidthDeg(beam, array) {
  const widthDeg = array.half_power_beamwidth_deg;
  if (!format.known(widthDeg)) return 0;
  if (array.kind !== "ula" || !format.known(beam.azimuth_deg)) return widthDeg;
  const elevation = (beam.elevation_deg ?? 0) * RADIANS;
  const sine = Math.sin(beam.azimuth_deg * RADIANS) * Math.cos(elevation);
  return Math.min(60, widthDeg / Math.max(0.05, Math.sqrt(1 - sine * sine)));
}

/** A colour of the style sheet, written #rrggbb, with an opacity. */
export function withAlpha(hex, alpha) {
  return hex + Math.round(alpha * 255).toString(16).padStart(2, "0");
}
