// Labels beside the symbols of the plan view.

import * as format from "./format.js";
import { MARKS, worstFirst } from "./health.js";

const CROWD = 8; // with more UAVs than this, a label without space is omitted

/**
 * Labels are placed where they cover nothing. With many UAVs, first the second line is omitted, then
 * the label. The selected UAV has priority, then the worst links. Names of other nodes are always
 * shown. The boxes in `written`, of rings and bearings, are kept free.
 */
export function drawLabels(view, written, nodes = []) {
  const [x, y] = view.centre;
  const taken = [...written, [x - 12, y - 12, x + 12, y + 12]];
  taken.push(...view.hits.map((hit) => [hit.x - 9, hit.y - 9, hit.x + 9, hit.y + 9]));
  taken.push(...nodes.map(({ x, y }) => [x - 7, y - 7, x + 7, y + 7]));
  for (const node of nodes) {
    const label = findPlace(view, node, [node.text], taken) ?? findPlace(view, node, [node.text], []);
    if (!label) continue;
    taken.push(label.box);
    const [left, top] = label.box;
    view.write(node.text, left, top + 8, { colour: node.colour, size: 12, weight: 700 });
  }
  const isChosen = ({ uav }) => uav.id === view.scene.selected;
  const before = (a, b) => isChosen(b) - isChosen(a) || worstFirst(a.uav, b.uav);
  for (const hit of [...view.hits].sort(before)) {
    const lines = labelOf(hit);
    const label = findPlace(view, hit, lines, taken)
      ?? findPlace(view, hit, lines.slice(0, 1), taken)
      ?? (view.hits.length <= CROWD || isChosen(hit) ? findPlace(view, hit, lines, []) : null);
    if (!label) continue;
    taken.push(label.box);
    drawLabel(view, hit.uav, label);
  }
}

/** The first free position beside a symbol inside the picture, or null. */
function findPlace(view, { x, y }, lines, taken) {
  const widthPx = Math.max(
    view.measure(lines[0], 13, 700), lines[1] ? view.measure(lines[1], 11.5, 400) : 0,
  );
  const heightPx = lines[1] ? 31 : 16;
  const box = [
    [x + 14, y - heightPx / 2], [x - 14 - widthPx, y - heightPx / 2],
    [x + 12, y + 10], [x - 12 - widthPx, y + 10],
    [x + 12, y - 10 - heightPx], [x - 12 - widthPx, y - 10 - heightPx],
    [x - widthPx / 2, y - 14 - heightPx], [x - widthPx / 2, y + 14],
  ].map(([left, top]) => [left, top, left + widthPx, top + heightPx])
    .find((place) => holds(view, place) && !taken.some((other) => overlap(place, other)));
  return box ? { box, lines } : null;
}

function drawLabel(view, uav, { box: [left, top], lines }) {
  const struck = !view.scene.uavsLive;
  const colour = struck || ["stale", "lost"].includes(uav.state) ? "muted" : "text";
  view.write(lines[0], left, top + 8, { colour, size: 13, weight: 700, struck });
  if (lines[1]) view.write(lines[1], left, top + 24, { colour: "muted", size: 11.5, struck });
}

function holds(view, [left, top, right, bottom]) {
  return left > 4 && top > 4 && right < view.width - 4 && bottom < view.height - 4;
}

function labelOf({ uav, beyond }) {
  const up = format.known(uav.down_m) ? -uav.down_m : null;
  const flatM = Math.hypot(uav.north_m, uav.east_m);
  const height = format.known(up) ? `${up >= 0 ? "↑" : "↓"}${format.length(Math.abs(up))}` : "";
  const name = ["weak", "none"].includes(uav.verdict) ? `${MARKS[uav.verdict]} ${uav.id}` : uav.id;
  if (beyond) return [name, `${format.length(flatM)} away`];
  return [name, uav.state === "live" ? height : `${height} ${uav.state}`.trim()];
}

const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
