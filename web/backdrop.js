// Background of the plan view: range rings and compass.

import { units } from "./units.js";

function rings(view) {
  const [radiusM, stepM] = view.scale.rings;
  const reachM = (Math.hypot(view.width, view.height) / 2 + Math.hypot(...view.pan)) / view.pxPerM;
  const found = [];
  for (let m = stepM; m <= reachM && found.length < 40; m += stepM) {
    found.push({ m, px: m * view.pxPerM, outer: m === radiusM });
  }
  return found;
}

export function drawRings(view) {
  const { context } = view;
  context.strokeStyle = view.colour.grid;
  for (const { px, outer } of rings(view)) {
    context.lineWidth = outer ? 1.6 : 1;
    context.globalAlpha = px > view.outerPx + 1 ? 0.45 : 1;
    context.beginPath();
    context.arc(...view.centre, px, 0, 2 * Math.PI);
    context.stroke();
  }
  context.globalAlpha = 1;
}

/** Returns the boxes of the labels, which other labels must avoid. */
export function drawRingLabels(view) {
  const boxes = [];
  for (const { m, px, outer } of rings(view)) {
    if (px < 26) continue;
    // Below the centre and to the left, where boresight and compass seldom are.
    const [x, y] = view.atBearing(225, px);
    if (y > view.height - 8 || x < 16) continue;
    view.write(ringLabel(m), x, y, { colour: "gridtext", size: 11, align: "center",
      weight: outer ? 600 : 400 });
    boxes.push([x - 20, y - 7, x + 20, y + 7]);
  }
  return boxes;
}

/** Returns the boxes of the bearings, likewise. */
export function drawCompass(view) {
  const boxes = [];
  const { context } = view;
  context.strokeStyle = view.colour.grid;
  context.lineWidth = 1;
  for (let deg = 0; deg < 360; deg += 10) {
    const long = deg % 30 === 0;
    context.beginPath();
    context.moveTo(...view.atBearing(deg, view.outerPx));
    context.lineTo(...view.atBearing(deg, view.outerPx + (long ? 8 : 4)));
    context.stroke();
    if (!long) continue;
    const [x, y] = view.atBearing(deg, view.outerPx + 18);
    const cardinal = { 0: "N", 90: "E", 180: "S", 270: "W" }[deg];
    view.write(cardinal ?? String(deg).padStart(3, "0"), x, y, {
      colour: cardinal === "N" ? "text" : "gridtext", size: cardinal ? 14 : 10.5,
      weight: cardinal ? 700 : 400, align: "center",
    });
    boxes.push([x - 11, y - 8, x + 11, y + 8]);
  }
  return boxes;
}

function ringLabel(m) {
  const { far } = units.length;
  const { name, metres } = m >= far.metres * 0.999 ? far : units.length;
  return `${Number((m / metres).toFixed(2))} ${name}`;
}
