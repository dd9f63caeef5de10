// The 3D view, on the plan view's own canvas and with its gestures: a perspective of the ground with
// its grid, the carrier and its array, beams as cones, UAVs with their bounds, and a line from each
// UAV down to the ground. No terrain is known: the ground is a level plane
// below the lowest UAV and the carrier, and the picture says how far below the carrier it is.

import * as format from "./format.js";
import { drawLabels } from "./labels.js";
import { withAlpha } from "./wedges.js";

const RADIANS = Math.PI / 180;
const TURN_DEG_PER_PX = 0.4;
const STEPS = 36; // of a circle
const ARRAY_PX = 26; // a line of elements, not to scale
const MARK_PX = 9; // half the length of a UAV's mark, not to scale
const [LOWEST_DEG, HIGHEST_DEG] = [5, 90];
const WIDEST_DEG = 60; // limit on half a cone's angle: a wider one would hide everything else
const AWAY = 2.6; // distance of the eye from the centre, in radii of the outermost ring
const NEAREST = 0.05; // distance from the eye within which nothing is drawn, as a part of that
const GROUND_STEPS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];

/** The viewpoint: bearing of the view, and elevation above the horizon. */
export class Space {
  constructor() {
    Object.assign(this, { bearingDeg: 20, aboveDeg: 25, groundM: 0 });
  }

  turn(dxPx, dyPx) {
    this.bearingDeg = (this.bearingDeg - dxPx * TURN_DEG_PER_PX + 360) % 360;
    const above = this.aboveDeg + dyPx * TURN_DEG_PER_PX;
    this.aboveDeg = Math.max(LOWEST_DEG, Math.min(HIGHEST_DEG, above));
  }

  /** A position relative to the centre as seen by the eye: right, up and away from it, metres. */
  seen([northM, eastM, downM]) {
    const [sin, cos] = [Math.sin(this.bearingDeg * RADIANS), Math.cos(this.bearingDeg * RADIANS)];
    const [tilt, level] = [Math.sin(this.aboveDeg * RADIANS), Math.cos(this.aboveDeg * RADIANS)];
    const aheadM = northM * cos + eastM * sin;
    return [eastM * cos - northM * sin, aheadM * tilt - downM * level,
      this.eyeM + aheadM * level + downM * tilt];
  }

  /** Choose the centre and the ground, for the UAVs of `view`, a plan view. */
  aim(view, uavs) {
    const followed = uavs.find(({ id }) => id === view.followed);
    this.middle = followed ? placeOf(followed) : [0, 0, 0];
    this.eyeM = AWAY * view.scale.radiusM;
    this.focalPx = this.eyeM * view.pxPerM; // the plan's scale at the centre
    view.centre = [view.width / 2, view.height / 2];
    this.centre = view.centre;
    const lowestM = Math.max(0, ...uavs.map((uav) => placeOf(uav)[2]));
    const stepM = GROUND_STEPS.find((metres) => metres >= view.scale.radiusM / 40) ?? 10_000;
    this.groundM = Math.ceil(lowestM / stepM - 1e-9) * stepM;
  }

  eyed(ned) {
    return this.seen(ned.map((part, i) => part - this.middle[i]));
  }

  drawnAt([right, up, away]) {
    const scale = this.focalPx / away;
    return [this.centre[0] + right * scale, this.centre[1] - up * scale];
  }

  /** Position in the picture; of what is behind the eye, far below. */
  at(ned) {
    const [right, up, away] = this.eyed(ned);
    return this.drawnAt([right, up, Math.max(away, NEAREST * this.eyeM)]);
  }

  /** Positions in the picture of those in front of the eye. */
  pictured(points) {
    return points.map((ned) => this.eyed(ned)).filter(([, , away]) => away > NEAREST * this.eyeM)
      .map((point) => this.drawnAt(point));
  }

  /** Stroke a line through positions, as far as it is in front of the eye. */
  line(context, points, colour, width) {
    const nearestM = NEAREST * this.eyeM;
    const eyed = points.map((ned) => this.eyed(ned));
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.beginPath();
    let isDrawing = false;
    eyed.slice(1).forEach((to, i) => {
      const from = eyed[i];
      const isEnd = to[2] > nearestM;
      if (from[2] > nearestM || isEnd) {
        const cut = () => mix(from, to, (nearestM - from[2]) / (to[2] - from[2]));
        if (!isDrawing) context.moveTo(...this.drawnAt(from[2] > nearestM ? from : cut()));
        context.lineTo(...this.drawnAt(isEnd ? to : cut()));
      }
      isDrawing = isEnd;
    });
    context.stroke();
  }

  /** Draw `view`, a plan view, and set the positions at which its UAVs can be selected. */
  draw(view) {
    const uavs = view.scene.uavs.filter(placed);
    this.aim(view, uavs);
    this.drawGround(view);
    const far = new Map(uavs.map((uav) => [uav, this.eyed(placeOf(uav))[2]]));
    const ahead = uavs.filter((uav) => far.get(uav) > NEAREST * this.eyeM)
      .sort((a, b) => far.get(b) - far.get(a));
    ahead.forEach((uav) => this.drawDrop(view, uav));
    this.drawBoresight(view);
    const byId = new Map(uavs.map((uav) => [uav.id, uav]));
    for (const beam of view.scene.beams) this.drawBeam(view, beam, byId.get(beam.uav));
    ahead.forEach((uav) => this.drawBound(view, uav));
    this.drawNodes(view);
    this.drawCarrier(view);
    view.hits = ahead.map((uav) => this.drawUav(view, uav));
    drawLabels(view, []);
  }

  // --- ground -----------------------------------------------------------------------------------

  circle([north, east, down], radiusM) {
    return Array.from({ length: STEPS + 1 }, (_, i) => {
      const angle = (2 * Math.PI * i) / STEPS;
      return [north + radiusM * Math.cos(angle), east + radiusM * Math.sin(angle), down];
    });
  }

  /** A grid on a level plane, the outermost ring of the plan, and the quarters. */
  drawGround(view) {
    const { context } = view;
    const [radiusM, ringM] = view.scale.rings;
    const stepM = radiusM / ringM > 4 ? ringM : ringM / 2;
    const steps = Math.ceil(radiusM / stepM - 1e-9);
    const edgeM = steps * stepM;
    const down = this.groundM;
    context.fillStyle = withAlpha(view.colour.grid, 0.22);
    context.beginPath();
    outline(context, this.pictured([[edgeM, edgeM, down], [edgeM, -edgeM, down],
      [-edgeM, -edgeM, down], [-edgeM, edgeM, down]]));
    context.fill();
    context.globalAlpha = 0.6;
    for (let i = -steps; i <= steps; i += 1) {
      const width = i === 0 ? 1.4 : 0.7;
      const m = i * stepM;
      this.line(context, [[m, -edgeM, down], [m, edgeM, down]], view.colour.grid, width);
      this.line(context, [[-edgeM, m, down], [edgeM, m, down]], view.colour.grid, width);
    }
    context.globalAlpha = 1;
    this.line(context, this.circle([0, 0, down], radiusM), view.colour.grid, 1.6);
    for (const [name, deg] of [["N", 0], ["E", 90], ["S", 180], ["W", 270]]) {
      const [north, east] = polar(deg, 0, edgeM * 1.06);
      const [x, y] = this.at([north, east, down]);
      view.write(name, x, y, { colour: name === "N" ? "text" : "gridtext", size: 14, weight: 700,
        align: "center" });
    }
    const below = down > 0 ? `${format.length(down)} below the carrier` : "at the carrier's height";
    view.write(`Grid ${format.length(stepM)}, ${below}`, view.width - 12, view.height - 16,
      { colour: "gridtext", size: 12, align: "right" });
  }

  /** The line from a UAV down to the ground, and its foot there. */
  drawDrop(view, uav) {
    const { context } = view;
    const [north, east, down] = placeOf(uav);
    const foot = [north, east, this.groundM];
    const colour = view.colourOf(uav);
    context.globalAlpha = 0.7;
    this.line(context, [[north, east, down], foot], colour, 1);
    context.fillStyle = withAlpha(colour, 0.5);
    context.beginPath();
    outline(context, this.pictured(this.circle(foot, 4 / view.pxPerM)));
    context.fill();
    context.globalAlpha = 1;
  }

  drawBoresight(view) {
    const { array, beamsLive, carrier } = view.scene;
    if (!format.known(array?.boresight_bearing_deg)) return;
    const colour = beamsLive && !carrier?.unfit ? view.colour.bore : view.colour.stale;
    const deg = array.boresight_bearing_deg;
    view.context.setLineDash([2, 6]);
    this.line(view.context, [[0, 0, 0], polar(deg, 0, view.scale.radiusM)], colour, 1.2);
    view.context.setLineDash([]);
    const half = ARRAY_PX / 2 / view.pxPerM; // the array lies across it
    this.line(view.context, [-90, 90].map((side) => polar(deg + side, 0, half)), colour, 4);
  }

  drawCarrier(view) {
    const { context } = view;
    const { carrier, uavsLive } = view.scene;
    if (carrier?.unseen) return;
    const colour = uavsLive && !carrier?.unfit ? view.colour.text : view.colour.stale;
    this.line(context, [[0, 0, 0], [0, 0, this.groundM]], colour, 1.6);
    this.line(context, this.circle([0, 0, this.groundM], 6 / view.pxPerM), colour, 1.2);
    const [x, y] = this.at([0, 0, 0]);
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.fillStyle = colour;
    context.fill();
    if (!format.known(carrier?.heading_deg)) return;
    this.line(context, [[0, 0, 0], polar(carrier.heading_deg, 0, 18 / view.pxPerM)], colour, 2.5);
  }

  drawNodes(view) {
    const { context } = view;
    for (const { north_m: north, east_m: east, node } of view.scene.nodes ?? []) {
      const sizeM = 6 / view.pxPerM;
      if (this.pictured([[north, east, 0]]).length === 0) continue;
      this.line(context, [[north, east, 0], [north, east, this.groundM]], view.colour.muted, 1);
      this.line(context, [[north + sizeM, east, 0], [north, east + sizeM, 0],
        [north - sizeM, east, 0], [north, east - sizeM, 0], [north + sizeM, east, 0]],
      view.colour.muted, 2);
      const [x, y] = this.at([north, east, 0]);
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
    outline(context, hull(this.pictured([[0, 0, 0], ...rim])));
    context.fill();
    this.line(context, [...rim, rim[0]], colour, 1);
    this.line(context, [[0, 0, 0], end], colour, chosen ? 2 : 1.1);
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
      return end.map((part, k) => part + a * aside[k] + b * other[k]);
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
    outline(context, hull(this.pictured(ends.flat())));
    context.fill();
    for (const rim of ends) this.line(context, rim, colour, 1);
  }

  /** Its mark: a level arrow head along its course, or a ball if it hovers; nearer ones are larger. */
  drawUav(view, uav) {
    const { context } = view;
    const ned = placeOf(uav);
    const [x, y] = this.at(ned);
    const nearness = this.eyeM / this.eyed(ned)[2];
    const colour = view.colourOf(uav);
    const velocity = uav.velocity_ned_mps;
    const isMoving = velocity && Math.hypot(velocity[0], velocity[1]) > 0.3 && uav.state !== "lost";
    context.beginPath();
    if (isMoving) {
      this.line(context, [ned, ned.map((part, i) => part + 2 * velocity[i])], colour, 1.2);
      const course = Math.atan2(velocity[1], velocity[0]) / RADIANS;
      const sizeM = MARK_PX * Math.max(0.7, Math.min(1.4, nearness)) / nearness / view.pxPerM;
      const corners = [[0, 1.3], [140, 1.2], [180, 0.5], [-140, 1.2]].map(([deg, size]) =>
        polar(course + deg, 0, sizeM * size).map((part, i) => part + ned[i]));
      context.beginPath();
      outline(context, this.pictured(corners));
    } else {
      context.arc(x, y, 6 * Math.max(0.7, Math.min(1.4, nearness)), 0, 2 * Math.PI);
    }
    context.fillStyle = uav.state === "live" ? colour : view.colour.plan;
    context.fill();
    context.strokeStyle = colour;
    context.lineWidth = 2;
    context.stroke();
    if (view.scene.selected === uav.id) {
      context.strokeStyle = view.colour.text;
      context.lineWidth = 1.5;
      context.beginPath();
      context.arc(x, y, 14, 0, 2 * Math.PI);
      context.stroke();
    }
    return { uav, x, y, beyond: false };
  }
}

const placed = (uav) => format.known(uav.north_m) && format.known(uav.east_m);
const placeOf = (uav) => [uav.north_m, uav.east_m, uav.down_m ?? 0];

const mix = (from, to, share) => from.map((part, i) => part + share * (to[i] - part));

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
