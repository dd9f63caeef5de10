// Phase and amplitude of every element, for one UAV's beam.

import * as format from "./format.js";
import { Surface } from "./surface.js";

const LEFT_PX = 40;
const GAP_PX = 22;
const FLOOR_DB = -30;
const COLOURS = ["plan", "grid", "gridtext", "text", "muted", "stale", "beam", "coast"];

/** The column of a UAV: amplitude in dB below the strongest element, phase in degrees; or null. */
export function elementsOf(answer, uav) {
  const column = answer?.uavs?.indexOf(uav) ?? -1;
  if (column < 0) return null;
  const parts = answer.re.map((row, m) => [row[column], answer.im[m][column]]);
  const strongest = Math.max(...parts.map(([re, im]) => Math.hypot(re, im)));
  return parts.map(([re, im]) => ({
    db: 20 * Math.log10(Math.hypot(re, im) / strongest),
    deg: (Math.atan2(im, re) * 180) / Math.PI,
  }));
}

function drawScale(view, top, height, marks) {
  const { context } = view;
  context.strokeStyle = view.colour.grid;
  context.lineWidth = 1;
  for (const [share, label] of marks) {
    const y = Math.round(top + height * share) + 0.5;
    context.beginPath();
    context.moveTo(LEFT_PX, y);
    context.lineTo(view.width - 6, y);
    context.stroke();
    view.write(label, LEFT_PX - 5, y, { align: "right" });
  }
}

function drawPhases(view, elements, top, height, colour) {
  drawScale(view, top, height, [[0, "180°"], [0.5, "0°"], [1, "−180°"]]);
  view.context.fillStyle = colour;
  elements.forEach(({ deg }, i) => {
    view.context.beginPath();
    view.context.arc(view.xOf(i + 0.5), top + height * (0.5 - deg / 360),
      Math.max(1.2, Math.min(3, view.stepPx * 0.4)), 0, 2 * Math.PI);
    view.context.fill();
  });
}

function drawAmplitudes(view, elements, top, height, colour) {
  drawScale(view, top, height, [[0, "0 dB"], [0.5, `${format.fixed(FLOOR_DB / 2)}`],
    [1, `${format.fixed(FLOOR_DB)}`]]);
  view.context.fillStyle = colour;
  elements.forEach(({ db }, i) => {
    const share = Math.max(0, 1 - db / FLOOR_DB); // 1: the strongest element
    const px = height * share;
    const widthPx = Math.max(0.5, view.stepPx * 0.7);
    view.context.fillRect(view.xOf(i + 0.15), top + height - px, widthPx, px);
  });
}

function draw(view, { elements, trusted }) {
  const { context, width, height } = view;
  context.fillStyle = view.colour.plan;
  context.fillRect(0, 0, width, height);
  if (!elements?.length) {
    view.write("no weights", width / 2, height / 2, { colour: "muted", size: 15 });
    return;
  }
  view.stepPx = (width - LEFT_PX - 8) / elements.length;
  view.xOf = (i) => LEFT_PX + i * view.stepPx;
  const each = (height - GAP_PX - 26) / 2;
  const colour = (name) => (trusted ? view.colour[name] : view.colour.stale);
  drawPhases(view, elements, 8, each, colour("beam"));
  drawAmplitudes(view, elements, 8 + each + GAP_PX, each, colour("coast"));
  const y = height - 8;
  view.write("element 0", LEFT_PX, y, { align: "left" });
  view.write(String(elements.length - 1), width - 8, y, { align: "right" });
}

export const makeElements = (canvas) => new Surface(canvas, COLOURS, draw);
