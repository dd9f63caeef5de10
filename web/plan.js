// The plan view: the carrier at the centre, north up, to scale.

import { drawCompass, drawRingLabels, drawRings } from "./backdrop.js";
import * as format from "./format.js";
import { setUpGestures } from "./gestures.js";
import { drawLabels } from "./labels.js";
import { drawNodes, drawServing } from "./nodes.js";
import { Scale } from "./scale.js";
import { fontOf, readColours } from "./surface.js";
import { drawCarrier, drawUav } from "./symbols.js";
import { fixesOf, trailOf } from "./trails.js";
import { drawBeams, withAlpha } from "./wedges.js";

const RADIANS = Math.PI / 180;
const MARGIN_PX = 30; // space for the compass outside the outermost ring
const GAP_MS = 2500; // no trail across a longer gap

/** Parts of a scene that identify it, in addition to its answers. */
const KEYS = ["answers", "uavsLive", "beamsLive", "message", "isPast", "selected", "at"];

const COLOURS = [
  "plan", "grid", "gridtext", "text", "muted", "live", "coast", "stale", "beam", "bore", "bad",
  "warn", "past", "on-past",
];

export class PlanView {
  constructor(canvas, history, onSelect, onMove = () => {}) {
    Object.assign(this, { canvas, history, onMove, context: canvas.getContext("2d") });
    this.scene = { uavs: [], beams: [], array: null, selected: null, uavsLive: false };
    this.scale = new Scale();
    this.queued = false;
    this.fault = null; // error of the last drawing
    this.hits = [];
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.pan = [0, 0]; // offset of the carrier from the centre, pixels
    this.ground = null; // the map underneath, which moves along
    this.followed = null; // the UAV that is kept at the centre
    this.space = null; // the 3D view, if active
    setUpGestures(canvas, {
      pan: (dx, dy) => this.drag(dx, dy),
      zoom: (steps) => this.zoom(steps),
      choose: (event) => onSelect(this.nearest(event)),
    });
    this.recolour();
  }

  /** Read the colours of the theme from the style sheet. */
  recolour() {
    this.colour = readColours(COLOURS);
    this.font = fontOf();
    this.redraw();
  }

  changeUnits() {
    this.scale.changeUnits();
    this.redraw();
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.ratio = ratio;
    this.redraw();
  }

  /** `scene.answers` identifies the answers: an unchanged scene is not drawn again. */
  show(scene, now) {
    const key = JSON.stringify(KEYS.map((name) => scene[name]));
    const isSame = scene.answers !== undefined && key === this.shown;
    Object.assign(this, { scene, shown: key });
    // Neither lost UAVs nor other traffic may shrink the view of those with a beam.
    const shown = scene.uavs.filter((uav) => placed(uav) && uav.state !== "lost");
    const targets = shown.filter((uav) => uav.target !== false);
    this.scale.follow((targets.length ? targets : shown)
      .map((uav) => Math.hypot(uav.north_m, uav.east_m)), now);
    if (!isSame || this.scale.isMoving || this.fault) this.redraw();
    if (this.fault) throw this.fault; // so that the page reports it: errors in a frame are not caught
  }

  /** Zoom around the centre of the picture. */
  zoom(steps) {
    const [beforeM] = this.scale.rings;
    this.scale.zoom(steps);
    const ratio = beforeM / this.scale.rings[0];
    this.pan = this.pan.map((px) => px * ratio);
    this.redraw();
    this.onMove();
  }

  drag(dx, dy) {
    if (this.space) {
      this.turn(dx, dy);
      return;
    }
    this.followed = null;
    this.pan = [this.pan[0] + dx, this.pan[1] + dy];
    this.redraw();
    this.onMove();
  }

  /** Switch to a 3D view; null: plan view. */
  lookFrom(space) {
    this.space = space;
    this.pan = [0, 0];
    this.redraw();
    this.onMove();
  }

  /** Rotate the 3D view as by a drag of this many pixels; no effect in the plan view. */
  turn(dx, dy) {
    this.space?.turn(dx, dy);
    this.redraw();
  }

  /** Keep a UAV at the centre; null: the carrier. */
  follow(id) {
    this.followed = id;
    this.pan = [0, 0];
    this.redraw();
  }

  get isFitted() {
    return this.scale.fit && this.followed === null && !this.pan.some(Boolean);
  }

  fitAll() {
    this.follow(null);
    this.scale.fitAll();
    this.show(this.scene, performance.now());
  }

  // --- drawing ----------------------------------------------------------------------------------

  redraw() {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => {
      this.queued = false;
      if (!this.width || !this.height) return;
      const moving = this.scale.ease();
      this.fault = null;
      try {
        this.draw();
      } catch (error) {
        this.fault = error;
      }
      if (moving) this.redraw();
    });
  }

  draw() {
    const { context, width, height, ratio } = this;
    this.outerPx = Math.max(40, Math.min(width, height) / 2 - MARGIN_PX);
    this.pxPerM = this.outerPx / this.scale.radiusM;
    const followed = this.scene.uavs.find(({ id }) => id === this.followed);
    if (followed && placed(followed)) {
      this.pan = [-followed.east_m * this.pxPerM, followed.north_m * this.pxPerM];
    }
    this.centre = [width / 2 + this.pan[0], height / 2 + this.pan[1]];
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.globalAlpha = 1;
    context.setLineDash([]);
    context.fillStyle = this.colour.plan;
    if (this.ground && !this.space) context.clearRect(0, 0, width, height);
    else context.fillRect(0, 0, width, height);
    if (this.space) {
      this.space.draw(this);
      this.drawMessage();
      return;
    }
    this.ground?.follow(this);
    drawRings(this);
    const bearings = drawCompass(this);
    const uavs = this.scene.uavs.filter(placed);
    drawBeams(this, uavs);
    drawServing(this, uavs);
    uavs.forEach((uav) => this.drawTrail(uav));
    uavs.forEach((uav) => this.drawFixes(uav));
    uavs.forEach((uav) => this.drawBound(uav));
    const nodes = drawNodes(this);
    drawCarrier(this);
    this.hits = uavs.map((uav) => drawUav(this, uav));
    drawLabels(this, [...bearings, ...drawRingLabels(this)], nodes);
    this.drawMessage();
  }

  at(northM, eastM) {
    return [this.centre[0] + eastM * this.pxPerM, this.centre[1] - northM * this.pxPerM];
  }

  atBearing(bearingDeg, px) {
    const angle = bearingDeg * RADIANS;
    return [this.centre[0] + px * Math.sin(angle), this.centre[1] - px * Math.cos(angle)];
  }

  colourOf(uav) {
    if (!this.scene.uavsLive) return this.colour.stale;
    const { live, coast, stale, warn, bad } = this.colour;
    const ofState = { live, coasting: coast }[uav.state] ?? stale;
    return ofState === stale ? stale : { weak: warn, none: bad }[uav.verdict] ?? ofState;
  }

  /** Thick where based on reports, thin where only predicted. */
  drawTrail(uav) {
    if (!format.known(uav.lat_deg)) return;
    const { context } = this;
    const trail = trailOf(uav, this.history, this.scene.at);
    context.strokeStyle = this.colourOf(uav);
    context.lineCap = "round";
    for (let i = 1; i < trail.length; i += 1) {
      const [older, newer] = [trail[i - 1], trail[i]];
      if (newer.at - older.at > GAP_MS) continue;
      const solid = older.measured && newer.measured;
      context.lineWidth = solid ? 2.4 : 1;
      context.globalAlpha = (solid ? 0.75 : 0.7) * (1 - older.age) ** 1.2 + 0.04;
      context.beginPath();
      context.moveTo(...this.at(older.north, older.east));
      this.curveTo(older, newer);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  /** Reported positions, in addition to the estimate. */
  drawFixes(uav) {
    if (!format.known(uav.lat_deg)) return;
    const { context } = this;
    context.strokeStyle = this.colour.text;
    context.lineWidth = 1.2;
    for (const fix of fixesOf(uav, this.history, this.scene.at)) {
      const [x, y] = this.at(fix.north, fix.east);
      context.globalAlpha = 0.9 * (1 - fix.age) + 0.05;
      context.beginPath();
      context.moveTo(x - 3, y);
      context.lineTo(x + 3, y);
      context.moveTo(x, y - 3);
      context.lineTo(x, y + 3);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  /** Curve between two points with the velocities at both ends (Hermite). */
  curveTo(older, newer) {
    const to = this.at(newer.north, newer.east);
    if (!older.velocity || !newer.velocity) {
      this.context.lineTo(...to);
      return;
    }
    const thirdS = (newer.at - older.at) / 3000;
    const [v0, v1] = [older.velocity, newer.velocity];
    this.context.bezierCurveTo(
      ...this.at(older.north + v0[0] * thirdS, older.east + v0[1] * thirdS),
      ...this.at(newer.north - v1[0] * thirdS, newer.east - v1[1] * thirdS), ...to,
    );
  }

  drawBound(uav) {
    if (!format.known(uav.horizontal_bound_m)) return;
    const { context } = this;
    const radiusPx = uav.horizontal_bound_m * this.pxPerM;
    if (radiusPx > 4 * Math.hypot(this.width, this.height)) return;
    context.beginPath();
    context.ellipse(
      ...this.at(uav.north_m, uav.east_m), radiusPx, radiusPx, 0, 0, 2 * Math.PI,
    );
    // A bound as large as the picture is not filled, as several would cover everything else.
    if (radiusPx < this.outerPx) {
      context.fillStyle = withAlpha(this.colourOf(uav), 0.1);
      context.fill();
    }
    context.strokeStyle = this.colourOf(uav);
    context.globalAlpha = 0.8;
    context.lineWidth = 1;
    context.setLineDash(uav.state === "live" ? [] : [4, 4]);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  measure(text, size, weight) {
    this.context.font = `${weight} ${size}px ${this.font}`;
    return this.context.measureText(text).width;
  }

  write(text, x, y, { colour, size, weight = 400, align = "left", struck = false }) {
    const { context } = this;
    context.font = `${weight} ${size}px ${this.font}`;
    context.textAlign = align;
    context.textBaseline = "middle";
    context.lineJoin = "round";
    context.lineWidth = 3.5;
    context.strokeStyle = this.colour.plan;
    context.strokeText(text, x, y);
    context.fillStyle = this.colour[colour];
    context.fillText(text, x, y);
    if (!struck) return;
    const widthPx = context.measureText(text).width;
    context.fillRect(align === "center" ? x - widthPx / 2 : x, y, widthPx, 1.4);
  }

  /** A prominent message across the picture. */
  drawMessage() {
    const { message: text, uavsLive, isPast } = this.scene;
    if (!text) return;
    const isQuiet = uavsLive && !isPast; // the UAVs are valid: only a small message on the carrier
    const { context } = this;
    const size = this.width < 500 ? 16 : isQuiet ? 17 : 22;
    const x = this.width / 2;
    const y = this.height / 2 + this.outerPx * 0.42;
    const fits = this.measure(text, size, 700) + 36 <= this.width;
    const lines = fits ? [text] : text.split(/(?<=:) /); // the cause, and the age
    const widthPx = Math.max(...lines.map((line) => this.measure(line, size, 700))) + 36;
    const heightPx = size * (0.8 + 1.2 * lines.length);
    const top = isQuiet ? this.height - heightPx : y - heightPx / 2;
    context.fillStyle = isQuiet ? this.colour.plan
      : isPast ? this.colour.past : this.colour.bad;
    context.fillRect(x - widthPx / 2, top, widthPx, heightPx);
    context.font = `700 ${size}px ${this.font}`;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillStyle = isQuiet ? this.colour.warn
      : isPast ? this.colour["on-past"] : this.colour.plan;
    lines.forEach((line, i) => context.fillText(line, x, top + size * (1 + 1.2 * i)));
  }

  nearest(event) {
    let best = null;
    let bestPx = 26;
    for (const { uav, x, y } of this.hits) {
      const px = Math.hypot(event.offsetX - x, event.offsetY - y);
      if (px < bestPx) [best, bestPx] = [uav.id, px];
    }
    return best;
  }
}

const placed = (uav) => format.known(uav.north_m) && format.known(uav.east_m);
