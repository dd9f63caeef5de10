// The polar pattern of one beam, in dB over the azimuth from boresight, with three directions: its
// UAV, the commanded direction, and the actual peak.

import * as format from "./format.js";
import { Surface } from "./surface.js";
import { withAlpha } from "./wedges.js";

const RADIANS = Math.PI / 180;
const SPAN_DB = 40;
const RING_DB = 10;
const COLOURS = ["plan", "grid", "gridtext", "text", "muted", "stale", "beam", "live", "coast",
  "bore"];

/** Distance from the centre for a response, in pixels; 0 below the floor. */
const radius = (view, valueDb, topDb) =>
  view.outerPx * Math.max(0, Math.min(1, 1 - (topDb - valueDb) / SPAN_DB));

function place(view, azimuthDeg, px) {
  const angle = azimuthDeg * RADIANS;
  return [view.x + px * Math.sin(angle), view.y - px * Math.cos(angle)];
}

function line(view, from, to) {
  view.context.beginPath();
  view.context.moveTo(...from);
  view.context.lineTo(...to);
  view.context.stroke();
}

function drawGrid(view, topDb) {
  const { context } = view;
  context.strokeStyle = view.colour.grid;
  context.lineWidth = 1;
  for (let deg = 0; deg < 360; deg += 30) {
    line(view, place(view, deg, radius(view, topDb - SPAN_DB + RING_DB, topDb)),
      place(view, deg, view.outerPx));
    const signed = deg > 180 ? deg - 360 : deg;
    view.write(`${format.fixed(signed)}°`, ...place(view, deg, view.outerPx + 15));
  }
  for (let db = topDb; db > topDb - SPAN_DB; db -= RING_DB) {
    context.beginPath();
    context.arc(view.x, view.y, radius(view, db, topDb), 0, 2 * Math.PI);
    context.stroke();
  }
}

function drawRingNames(view, topDb) {
  for (let db = topDb; db > topDb - SPAN_DB; db -= RING_DB) {
    const [x, y] = place(view, 195, radius(view, db, topDb) - 8);
    view.write(`${format.fixed(db)}${db === topDb ? " dB" : ""}`, x, y, { colour: "muted" });
  }
}

/** The half-power width as a wedge around the actual peak. */
function drawWidth(view, entry, colour) {
  const widthDeg = entry.half_power_beamwidth_deg;
  if (!format.known(widthDeg)) return;
  const [from, to] = [-0.5, 0.5].map((side) =>
    (entry.peak_azimuth_deg + side * widthDeg - 90) * RADIANS);
  const { context } = view;
  context.fillStyle = withAlpha(colour, 0.28);
  context.beginPath();
  context.moveTo(view.x, view.y);
  context.arc(view.x, view.y, view.outerPx, from, to);
  context.closePath();
  context.fill();
}

function drawResponse(view, { angles_deg: angles }, entry, topDb, colour) {
  const { context } = view;
  context.beginPath();
  entry.response_db.forEach((valueDb, i) => {
    const point = place(view, angles[i], radius(view, valueDb ?? -Infinity, topDb));
    if (i) context.lineTo(...point);
    else context.moveTo(...point);
  });
  context.closePath();
  context.fillStyle = withAlpha(colour, 0.16);
  context.fill();
  context.strokeStyle = colour;
  context.lineWidth = 1.8;
  context.lineJoin = "round";
  context.stroke();
}

/** Three directions, normally close together, so each has its own shape. */
function drawDirections(view, entry, beam) {
  const { context, outerPx } = view;
  context.lineWidth = 2;
  if (format.known(entry.target_deg)) { // commanded: a dashed line
    context.strokeStyle = view.colour.text;
    context.setLineDash([6, 4]);
    line(view, [view.x, view.y], place(view, entry.target_deg, outerPx));
    context.setLineDash([]);
  }
  if (format.known(entry.peak_azimuth_deg)) { // actual: a bar across the edge
    context.strokeStyle = view.colour.bore;
    context.lineWidth = 4;
    line(view, place(view, entry.peak_azimuth_deg, outerPx - 7),
      place(view, entry.peak_azimuth_deg, outerPx + 7));
  }
  if (format.known(beam?.azimuth_deg)) { // target: a ring outside
    context.strokeStyle = view.colour.live;
    context.lineWidth = 2.5;
    context.beginPath();
    context.arc(...place(view, beam.azimuth_deg, outerPx - 14), 6, 0, 2 * Math.PI);
    context.stroke();
  }
}

function draw(view, { answer, entry, beam, trusted, none }) {
  const { context, width, height } = view;
  const outerPx = Math.min(width / 2 - 34, height / 2 - 22);
  Object.assign(view, { x: width / 2, y: height / 2, outerPx });
  context.fillStyle = view.colour.plan;
  context.fillRect(0, 0, width, height);
  const peakDb = entry?.peak_db;
  const topDb = format.known(peakDb) ? Math.ceil(peakDb / 5) * 5 : 0;
  drawGrid(view, topDb);
  if (entry) {
    const colour = trusted ? view.colour.beam : view.colour.stale;
    drawWidth(view, entry, colour);
    drawResponse(view, answer, entry, topDb, colour);
    drawRingNames(view, topDb);
    drawDirections(view, entry, beam);
  } else view.write(none, view.x, view.y, { colour: "text", size: 14 });
}

export const makePattern = (canvas) => new Surface(canvas, COLOURS, draw);

/** The directions as text. */
export function directionFacts(entry, beam) {
  return [
    ["target", format.signedDegrees(beam?.azimuth_deg)],
    ["commanded", format.signedDegrees(entry?.target_deg)],
    ["actual", format.signedDegrees(entry?.peak_azimuth_deg)],
    ["peak", format.decibels(entry?.peak_db)],
    ["width", format.degrees(entry?.half_power_beamwidth_deg)],
    ["side lobe", format.decibels(entry?.side_lobe_db)],
  ];
}
