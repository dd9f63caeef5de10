// The 3D view, on the plan view's own canvas and with its gestures: the carrier and its array, beams
// as cones, UAVs with their bounds, rings at the carrier's height. Loaded on first use. The
// projection is orthographic: lengths are to scale at every distance.

import * as format from "./format.js";
import { drawLabels } from "./labels.js";
import { withAlpha } from "./wedges.js";

const RADIANS = Math.PI / 180;
const TURN_DEG_PER_PX = 0.4;
const STEPS = 36; // of a circle
const ARRAY_PX = 26; // a line of elements, not to scale
const [LOWEST_DEG, HIGHEST_DEG] = [5, 90];
const WIDEST_DEG = 60; // limit on half a cone's angle: a wider one would hide everything else

/** The viewpoint: bearing of the view, and elevation above the horizon. */
export class Space {
  constructor() {
    Object.assign(this, { bearingDeg: 20, aboveDeg: 30 });
  }

  turn(dxPx, dyPx) {
    this.bearingDeg = (this.bearingDeg - dxPx * TURN_DEG_PER_PX + 360) % 360;
    const above = this.aboveDeg + dyPx * TURN_DEG_PER_PX;
    this.aboveDeg = Math.max(LOWEST_DEG, Math.min(HIGHEST_DEG, above));
  }

  /** Projection of an offset from the carrier: right and down in pixels, depth in metres. */
  offset([northM, eastM, downM], pxPerM) {
    const [sin, cos] = [Math.sin(this.bearingDeg * RADIANS), Math.cos(this.bearingDeg * RADIANS)];
    const above = this.aboveDeg * RADIANS;
    const [rightM, aheadM] = [eastM * cos - northM * sin, northM * cos + eastM * sin];
    return [rightM * pxPerM,
      (downM * Math.cos(above) - aheadM * Math.sin(above)) * pxPerM, aheadM];
  }

  /** Draw `view`, a plan view, and set the positions at which its UAVs can be selected. */
  draw(view) {
    const uavs = view.scene.uavs.filter(placed);
    this.middle(view, uavs);
    this.at = (ned) => {
      const [right, down] = this.offset(ned, view.pxPerM);
      return [view.centre[0] + right, view.centre[1] + down];
    };
    this.drawRings(view);
    this.drawBoresight(view);
    const byId = new Map(uavs.map((uav) => [uav.id, uav]));
    for (const beam of view.scene.beams) this.drawBeam(view, beam, byId.get(beam.uav));
    const far = (uav) => this.offset(placeOf(uav), 1)[2];
    uavs.sort((a, b) => far(b) - far(a));
    uavs.forEach((uav) => this.drawBound(view, uav));
    this.drawNodes(view);
    this.drawCarrier(view);
    view.hits = uavs.map((uav) => this.drawUav(view, uav));
    drawLabels(view, []);
  }

  /** Centre on the followed UAV, or else on the carrier. */
  middle(view, uavs) {
    const followed = uavs.find(({ id }) => id === view.followed);
    const [right, down] = followed ? this.offset(placeOf(followed), view.pxPerM) : [0, 0];
    view.centre = [view.width / 2 - right, view.height / 2 - down];
  }

  // --- ground -----------------------------------------------------------------------------------

  circle([north, east, down], radiusM) {
    return Array.from({ length: STEPS }, (_, i) => {
      const angle = (2 * Math.PI * i) / STEPS;
      return this.at([north + radiusM * Math.cos(angle), east + radiusM * Math.sin(angle), down]);
    });
  }

  drawRings(view) {
    const { context } = view;
    const [radiusM, stepM] = view.scale.rings;
    for (let m = stepM; m <= radiusM * 1.001; m += stepM) {
      stroke(context, this.circle([0, 0, 0], m), view.colour.grid, m >= radiusM ? 1.6 : 1, true);
      const [x, y] = this.at([-m * Math.SQRT1_2, -m * Math.SQRT1_2, 0]);
      view.write(format.length(m), x, y, { colour: "gridtext", size: 11, align: "center" });
    }
    for (const [name, deg] of [["N", 0], ["E", 90], ["S", 180], ["W", 270]]) {
      const [x, y] = this.at(polar(deg, 0, radiusM * 1.09));
      view.write(name, x, y, { colour: name === "N" ? "text" : "gridtext", size: 14, weight: 700,
        align: "center" });
    }
  }

  drawBoresight(view) {
    const { array, beamsLive, carrier } = view.scene;
    if (!format.known(array?.boresight_bearing_deg)) return;
    const colour = beamsLive && !carrier?.unfit ? view.colour.bore : view.colour.stale;
    const deg = array.boresight_bearing_deg;
    view.context.setLineDash([2, 6]);
    stroke(view.context, [this.at([0, 0, 0]), this.at(polar(deg, 0, view.scale.radiusM))], colour,
      1.2);
    view.context.setLineDash([]);
    const half = ARRAY_PX / 2 / view.pxPerM; // the array lies across it
    stroke(view.context, [-90, 90].map((side) => this.at(polar(deg + side, 0, half))), colour, 4);
  }

  drawCarrier(view) {
    const { context } = view;
    const { carrier, uavsLive } = view.scene;
    if (carrier?.unseen) return;
    const [x, y] = this.at([0, 0, 0]);
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.fillStyle = uavsLive && !carrier?.unfit ? view.colour.text : view.colour.stale;
    context.fill();
    if (!format.known(carrier?.heading_deg)) return;
    const tip = this.at(polar(carrier.heading_deg, 0, 18 / view.pxPerM));
    stroke(context, [[x, y], tip], context.fillStyle, 2.5);
  }

  drawNodes(view) {
    for (const { north_m: north, east_m: east, node } of view.scene.nodes ?? []) {
      const [x, y] = this.at([north, east, 0]);
      stroke(view.context, [[x, y - 6], [x + 6, y], [x, y + 6], [x - 6, y]], view.colour.muted, 2,
        true);
      view.write(node, x + 10, y, { colour: "muted", size: 12, weight: 700 });
    }
  }

  // --- beams ------------------------------------------------------------------------------------

  /** A cone to its UAV with the 95th percentile of the pointing error as its half angle. */
  drawBeam(view, beam, uav) {
    if (!uav && !format.known(beam.bearing_deg)) return;
    const end = uav ? placeOf(uav)
      : polar(beam.bearing_deg, beam.elevation_deg ?? 0, beam.range_m ?? view.scale.radiusM);
    const { context } = view;
    const isTrue = view.scene.beamsLive && beam.oldS === undefined;
    const colour = isTrue ? view.colour.beam : view.colour.stale;
    const chosen = view.scene.selected === beam.uav;
    const rim = this.rimOf(end, likelyDeg(beam));
    context.globalAlpha = view.scene.selected === null || chosen ? 1 : 0.45;
    context.fillStyle = withAlpha(colour, Math.max(0.06, Math.min(0.3, 2 / view.scene.beams.length)));
    context.beginPath();
    outline(context, hull([this.at([0, 0, 0]), ...rim]));
    context.fill();
    stroke(context, rim, colour, 1, true);
    stroke(context, [this.at([0, 0, 0]), this.at(end)], colour, chosen ? 2 : 1.1);
    context.globalAlpha = 1;
  }

  /** The rim of a cone from the carrier around a position, with this half angle. */
  rimOf(end, halfDeg) {
    const lengthM = Math.hypot(...end) || 1;
    const axis = end.map((part) => part / lengthM);
    const aside = unit(Math.abs(axis[2]) > 0.9 ? cross(axis, [1, 0, 0]) : cross(axis, [0, 0, 1]));
    const other = cross(axis, aside);
    const radiusM = lengthM * Math.tan(halfDeg * RADIANS);
    return Array.from({ length: STEPS }, (_, i) => {
      const angle = (2 * Math.PI * i) / STEPS;
      const [a, b] = [radiusM * Math.cos(angle), radiusM * Math.sin(angle)];
      return this.at(end.map((part, k) => part + a * aside[k] + b * other[k]));
    });
  }

  // --- UAVs -------------------------------------------------------------------------------------

  /** The cylinder that contains the UAV. */
  drawBound(view, uav) {
    const { horizontal_bound_m: radiusM, vertical_bound_m: heightM } = uav;
    if (!format.known(radiusM) || !format.known(heightM)) return;
    if (Math.max(radiusM, heightM) * view.pxPerM > view.outerPx) return;
    const [north, east, down] = placeOf(uav);
    const ends = [-heightM, heightM].map(
      (off) => this.circle([north, east, down + off], radiusM),
    );
    const { context } = view;
    const colour = view.colourOf(uav);
    context.fillStyle = withAlpha(colour, 0.12);
    context.beginPath();
    outline(context, hull(ends.flat()));
    context.fill();
    for (const rim of ends) stroke(context, rim, colour, 1, true);
  }

  /** Its mark, and a vertical line to the height of the carrier. */
  drawUav(view, uav) {
    const { context } = view;
    const ned = placeOf(uav);
    const [x, y] = this.at(ned);
    const colour = view.colourOf(uav);
    context.setLineDash([2, 3]);
    stroke(context, [[x, y], this.at([ned[0], ned[1], 0])], view.colour.muted, 1);
    context.setLineDash([]);
    const velocity = uav.velocity_ned_mps;
    if (velocity && uav.state !== "lost") {
      stroke(context, [[x, y], this.at(ned.map((part, i) => part + 2 * velocity[i]))], colour, 1.2);
    }
    context.beginPath();
    context.arc(x, y, 6, 0, 2 * Math.PI);
    context.fillStyle = uav.state === "live" ? colour : view.colour.plan;
    context.fill();
    context.strokeStyle = colour;
    context.lineWidth = 2;
    context.stroke();
    if (view.scene.selected === uav.id) {
      stroke(context, ring([x, y], 12), view.colour.text, 1.5, true);
    }
    return { uav, x, y, beyond: false };
  }
}

const placed = (uav) => format.known(uav.north_m) && format.known(uav.east_m);
const placeOf = (uav) => [uav.north_m, uav.east_m, uav.down_m ?? 0];

/** Half angle of a cone: the likely error, or the bound if that is unknown. */
function likelyDeg({ pointing_p95_deg: likely, pointing_bound_deg: bound }) {
  const deg = [likely, bound].find(format.known) ?? WIDEST_DEG;
  return Math.max(0.5, Math.min(WIDEST_DEG, deg));
}

function polar(bearingDeg, aboveDeg, metres) {
  const [bearing, above] = [bearingDeg * RADIANS, aboveDeg * RADIANS];
  const flat = metres * Math.cos(above);
  return [flat * Math.cos(bearing), flat * Math.sin(bearing), -metres * Math.sin(above)];
}

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((part) => part / length);
}

const ring = ([x, y], px) => Array.from({ length: STEPS }, (_, i) => [
  x + px * Math.cos((2 * Math.PI * i) / STEPS), y + px * Math.sin((2 * Math.PI * i) / STEPS),
]);

/** The convex hull of points in the picture (Andrew's monotone chain). */
export function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const left = (o, a, b) => (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
  const half = (list) => {
    const found = [];
    for (const point of list) {
      while (found.length > 1 && left(found.at(-2), found.at(-1), point) <= 0) found.pop();
      found.push(point);
    }
    return found.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

function outline(context, points, closed = true) {
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (closed) context.closePath();
}

function stroke(context, points, colour, width, closed = false) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  outline(context, points, closed);
  context.stroke();
}
