// The other nodes of the fleet in the plan view, and lines to the UAVs that they serve.

import * as format from "./format.js";

const SIZE_PX = 6;
const EDGE_PX = 16;
const COLOURS = { there: "text", silent: "stale", aside: "bad" };

/** A thin line from each other node to each UAV that it serves. */
export function drawServing(view, uavs) {
  const { context, scene } = view;
  const places = new Map((scene.nodes ?? []).map((one) => [one.node, one]));
  context.strokeStyle = scene.uavsLive ? view.colour.muted : view.colour.stale;
  context.lineWidth = 1;
  context.setLineDash([2, 4]);
  for (const uav of uavs) {
    for (const node of (uav.served_by ?? []).map((name) => places.get(name)).filter(Boolean)) {
      context.beginPath();
      context.moveTo(...view.at(node.north_m, node.east_m));
      context.lineTo(...view.at(uav.north_m, uav.east_m));
      context.stroke();
    }
  }
  context.setLineDash([]);
}

/** A diamond for each node. Returns the position of each, and its label. */
export function drawNodes(view) {
  return (view.scene.nodes ?? []).map((node) => drawNode(view, node));
}

function drawNode(view, node) {
  const { context, width, height } = view;
  const [x, y] = placeOf(view, node);
  const colour = view.scene.uavsLive ? COLOURS[node.state] ?? "stale" : "stale";
  context.fillStyle = view.colour.plan;
  context.strokeStyle = view.colour[colour];
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(x, y - SIZE_PX);
  context.lineTo(x + SIZE_PX, y);
  context.lineTo(x, y + SIZE_PX);
  context.lineTo(x - SIZE_PX, y);
  context.closePath();
  context.fill();
  context.stroke();
  const isBeyond = x <= EDGE_PX || y <= EDGE_PX || x >= width - EDGE_PX || y >= height - EDGE_PX;
  const away = isBeyond ? ` ${format.length(Math.hypot(node.north_m, node.east_m))}` : "";
  const text = `${node.node}${node.state === "there" ? "" : ` ${node.state}`}${away}`;
  return { x, y, text, colour: colour === "text" ? "muted" : colour };
}

/** Position of its mark; for a node outside the picture at the edge, in its direction. */
function placeOf(view, node) {
  const [x, y] = view.at(node.north_m, node.east_m);
  const [middleX, middleY] = [view.width / 2, view.height / 2];
  const [dx, dy] = [x - middleX, y - middleY];
  const share = Math.min(1, (middleX - EDGE_PX) / Math.max(1e-9, Math.abs(dx)),
    (middleY - EDGE_PX) / Math.max(1e-9, Math.abs(dy)));
  return [middleX + dx * share, middleY + dy * share];
}
