// The symbols of the plan view: the carrier, UAVs, and UAVs outside the picture.

import * as format from "./format.js";

const RADIANS = Math.PI / 180;
const LEADER_S = 2; // the line ahead of a UAV ends at its position after this time

/** The carrier at the centre, with its heading. */
export function drawCarrier(view) {
  const { context } = view;
  const { carrier } = view.scene;
  if (carrier?.unseen) return; // then a UAV's first position is at the centre
  const headingDeg = carrier?.heading_deg;
  context.save();
  context.translate(...view.centre);
  context.fillStyle = view.colour.plan;
  context.strokeStyle = view.scene.uavsLive && !carrier?.unfit
    ? view.colour.text : view.colour.stale;
  context.lineWidth = 2;
  context.beginPath();
  context.arc(0, 0, 9, 0, 2 * Math.PI);
  context.fill();
  context.stroke();
  if (format.known(headingDeg)) {
    context.rotate(headingDeg * RADIANS);
    context.fillStyle = context.strokeStyle;
    polygon(context, [[0, -7], [4.5, 5], [0, 2.5], [-4.5, 5]]);
    context.fill();
  }
  context.restore();
}

/** Draw the symbol of a UAV; returns its position, for labels and for the pointer. */
export function drawUav(view, uav) {
  const [x, y] = view.at(uav.north_m, uav.east_m);
  const inside = x > 8 && y > 8 && x < view.width - 8 && y < view.height - 8;
  if (!inside) return drawBeyond(view, uav, x - view.width / 2, y - view.height / 2);
  const { context } = view;
  const colour = view.colourOf(uav);
  const velocity = uav.velocity_ned_mps;
  const moving = velocity && Math.hypot(velocity[0], velocity[1]) > 0.3;
  context.save();
  context.translate(x, y);
  context.strokeStyle = colour;
  context.lineWidth = 2;
  if (uav.state !== "lost" && moving) drawLeader(view, velocity);
  if (moving) context.rotate(Math.atan2(velocity[1], velocity[0]));
  if (view.scene.selected === uav.id) drawSelection(view);
  context.fillStyle = uav.state === "live" ? colour : view.colour.plan;
  context.beginPath();
  if (uav.state === "lost") {
    polygon(context, [[-6, -6], [6, 6]]);
    context.moveTo(6, -6);
    context.lineTo(-6, 6);
  } else if (moving) polygon(context, [[0, -9], [6.5, 8], [0, 4.5], [-6.5, 8]]);
  else context.arc(0, 0, 6, 0, 2 * Math.PI);
  if (uav.state !== "lost") context.fill();
  context.stroke();
  context.restore();
  return { uav, x, y, beyond: false };
}

function drawLeader(view, velocity) {
  const { context } = view;
  context.save();
  context.lineWidth = 1.2;
  context.beginPath();
  context.moveTo(0, 0);
  context.lineTo(velocity[1] * LEADER_S * view.pxPerM, -velocity[0] * LEADER_S * view.pxPerM);
  context.stroke();
  context.restore();
}

function drawSelection(view) {
  const { context } = view;
  context.save();
  context.strokeStyle = view.colour.text;
  context.lineWidth = 1.5;
  context.beginPath();
  context.arc(0, 0, 15, 0, 2 * Math.PI);
  context.stroke();
  context.restore();
}

/** A UAV outside the picture: an arrow at the edge, in its direction. */
function drawBeyond(view, uav, rightPx, downPx) {
  const { context } = view;
  const angle = Math.atan2(rightPx, -downPx);
  const [dx, dy] = [Math.sin(angle), -Math.cos(angle)];
  const reach = Math.min(
    (view.width / 2 - 16) / Math.max(1e-9, Math.abs(dx)),
    (view.height / 2 - 16) / Math.max(1e-9, Math.abs(dy)),
  );
  const [x, y] = [view.width / 2 + dx * reach, view.height / 2 + dy * reach];
  context.save();
  context.translate(x, y);
  context.rotate(angle);
  context.fillStyle = view.colourOf(uav);
  polygon(context, [[0, -9], [7, 4], [-7, 4]]);
  context.fill();
  context.restore();
  return { uav, x, y, beyond: true };
}

function polygon(context, points) {
  context.beginPath();
  points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.closePath();
}
