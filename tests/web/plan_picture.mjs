// The plan view on a recording canvas, 400 by 400 px: the carrier is at 200, 200 and the outermost
// ring 170 px from it. What is drawn is told by its shape, as an onlooker tells it.

import { load, openBrowser } from "./browser.mjs";

export const CENTRE = { x: 200, y: 200 };
export const OUTER_PX = 170;

export async function openPlan({ width = 400, height = 400, ...settings } = {}) {
  const browser = openBrowser(settings);
  const { PlanView } = await load("plan.js");
  const { History } = await load("history.js");
  const history = new History();
  const chosen = [];
  const canvas = browser.element("plan");
  const plan = new PlanView(canvas, history, (id) => chosen.push(id));
  browser.resize("plan", width, height);
  browser.time.paint();
  const picture = canvas.getContext("2d");
  return {
    browser, plan, history, chosen, canvas, picture,
    /** Show a scene, and draw until it no longer changes. */
    show(scene, now = 1000) {
      plan.show({
        uavs: [], beams: [], array: null, carrier: null, uavsLive: true, beamsLive: true,
        message: "", isPast: false, selected: null, at: now, ...scene,
      }, now);
      return this.drawAnew();
    },
    drawAnew() {
      picture.forget();
      plan.redraw();
      let last = 0;
      while (browser.time.paint(1)) {
        picture.drawn.splice(0, last); // keep only the last frame of a scale transition
        last = picture.drawn.length;
      }
      return picture;
    },
  };
}

const shape = ({ path }) => path.map(({ op }) => op).join(" ");

/** Circles of a radius; ellipses and arcs that are not closed in themselves are none. */
export const circles = (picture, radius, kind = "stroke") =>
  picture.of(kind, (one) => shape(one) === "arc" && Math.abs(one.path[0].halfX - radius) < 1e-6
    && one.path[0].to - one.path[0].from >= 2 * Math.PI - 1e-9)
    .map((one) => ({ ...one, x: one.path[0].x, y: one.path[0].y }));

/** Arrow heads: of a UAV that moves and of the carrier; `tip`, and `tail` between the wings. */
export const arrows = (picture, colour) =>
  picture.of("fill", (one) => shape(one) === "move line line line close"
    && one.fillStyle === colour)
    .map((one) => ({ ...one, tip: one.path[0], tail: one.path[2] }));

/** Triangles at the edge, for UAVs outside the view. */
export const edgeArrows = (picture) =>
  picture.of("fill", (one) => shape(one) === "move line line close")
    .map((one) => ({ ...one, tip: one.path[0],
      base: { x: (one.path[1].x + one.path[2].x) / 2, y: (one.path[1].y + one.path[2].y) / 2 } }));

export const ellipses = (picture) => picture.of("stroke", (one) => shape(one) === "ellipse")
  .map((one) => ({ ...one, ...one.path[0] }));

/** Straight lines from a point. */
export const linesFrom = (picture, { x, y }) => picture.of("stroke", (one) =>
  shape(one) === "move line" && Math.hypot(one.path[0].x - x, one.path[0].y - y) < 1e-6)
  .map((one) => ({ ...one, to: one.path[1] }));

/** Wedges about the carrier: `bearingDeg` of the middle, `widthDeg`, `reachPx`. */
export const wedges = (picture) =>
  picture.of("fill", (one) => shape(one) === "move arc close").map((one) => {
    const { from, to, halfX } = one.path[1];
    const [a, b] = [from, to].map((angle) => (angle * 180) / Math.PI + 90);
    return { ...one, bearingDeg: (((a + b) / 2) + 360) % 360, widthDeg: b - a, reachPx: halfX };
  });
