// The scene in space: a perspective with a ground, on the plan's canvas.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { near } from "./near.mjs";
import { CENTRE, openPlan } from "./plan_picture.mjs";
import { array, beam, otherNode, uav } from "./service.mjs";

const { Space, hull } = await load("space.js");

async function openSpace(fields = {}) {
  const view = await openPlan();
  const space = Object.assign(new Space(), fields);
  view.plan.lookFrom(space);
  return { ...view, space };
}

const HIGH = uav("1:1", { north_m: 30, east_m: 40, down_m: -50 });
const points = ({ path }) => path.filter(({ op }) => op === "move" || op === "line");

test("it is a perspective: to scale at the centre, smaller further away", async () => {
  const view = await openSpace({ bearingDeg: 0, aboveDeg: 90 });
  view.show({ uavs: [HIGH] });
  const { plan: { pxPerM }, space } = view;
  const offset = (ned) => {
    const [x, y] = space.at(ned);
    return [x - CENTRE.x, y - CENTRE.y];
  };
  near(offset([30, 40, 0])[0], 40 * pxPerM); // from above, at the carrier's height: the plan
  near(offset([30, 40, 0])[1], -30 * pxPerM);
  assert.ok(offset([30, 40, -50])[0] > 40 * pxPerM); // nearer to the eye
  assert.ok(offset([30, 40, 50])[0] < 40 * pxPerM);
  space.aboveDeg = 0;
  near(offset([0, 0, -50])[1], -50 * pxPerM);
  assert.ok(offset([100, 0, -50])[1] > offset([0, 0, -50])[1]);
  space.bearingDeg = 90; // looking east, south is on the right
  near(offset([-30, 0, 0])[0], 30 * pxPerM);
});

test("what is behind the eye is not drawn", async () => {
  const view = await openSpace({ bearingDeg: 0, aboveDeg: 5 });
  const behind = uav("2:1", { north_m: -5000, east_m: 0, down_m: -50 });
  view.plan.zoom(1); // no longer fitted to all UAVs
  const picture = view.show({ uavs: [HIGH, behind] });
  assert.deepEqual(view.plan.hits.map((hit) => hit.uav.id), ["1:1"]);
  assert.ok(picture.drawn.every(({ path = [] }) => path.every(({ x = 0, y = 0 }) =>
    Number.isFinite(x) && Number.isFinite(y))));
});

test("a drag orbits the view, never below ground; on the plan it pans", async () => {
  const { plan, space } = await openSpace();
  const before = space.bearingDeg;
  plan.drag(50, 10_000);
  assert.notEqual(space.bearingDeg, before);
  assert.equal(space.aboveDeg, 90);
  plan.drag(0, -10_000);
  assert.ok(space.aboveDeg > 0);
  assert.deepEqual(plan.pan, [0, 0]);
  plan.lookFrom(null);
  plan.drag(5, 6);
  assert.deepEqual(plan.pan, [5, 6]);
});

test("a UAV has a line down to the ground, is selectable and labelled", async () => {
  const view = await openSpace({ bearingDeg: 0, aboveDeg: 30 });
  const picture = view.show({ uavs: [HIGH, uav("2:1", { down_m: 7 })] });
  const { space } = view;
  const hit = view.plan.hits.find(({ uav: { id } }) => id === "1:1");
  const [x, y] = space.at([30, 40, -50]);
  near(hit.x, x);
  near(hit.y, y);
  assert.ok(space.groundM >= 7); // below the lowest UAV
  const [footX, footY] = space.at([30, 40, space.groundM]);
  assert.ok(footY > y);
  const drops = picture.of("stroke", (one) => one.path.length === 2).map(points);
  const isDrop = ([from, to]) => Math.hypot(from.x - x, from.y - y, to.x - footX, to.y - footY);
  assert.ok(drops.some((line) => isDrop(line) < 1e-6));
  picture.text("1:1");
  picture.text(`Grid 25.0\u00a0m, ${space.groundM.toFixed(1)}\u00a0m below the carrier`);
  assert.equal(view.plan.nearest({ offsetX: hit.x + 3, offsetY: hit.y }), "1:1");
});

test("a beam is a cone of the p95 angle, or of the bound without one", async () => {
  const view = await openSpace({ bearingDeg: 0, aboveDeg: 90 });
  const flat = uav("1:1", { north_m: 100, east_m: 0, down_m: 0, horizontal_bound_m: null });
  const halfWidthM = (fields) => {
    const picture = view.show({ uavs: [flat], beams: [beam("1:1", fields)], array: array() });
    const rim = picture.of("stroke", (one) => one.strokeStyle === view.browser.colour("beam")
      && one.path.length > 10).map(points)[0];
    return (Math.max(...rim.map(({ x }) => x)) - CENTRE.x) / view.plan.pxPerM;
  };
  const isNear = (metres, degrees) => // the upper half of the rim is nearer to the eye
    Math.abs(metres / (100 * Math.tan(degrees * Math.PI / 180)) - 1) < 0.01;
  assert.ok(isNear(halfWidthM({ pointing_p95_deg: 5, pointing_bound_deg: 20 }), 5));
  assert.ok(isNear(halfWidthM({ pointing_p95_deg: null, pointing_bound_deg: 20 }), 20));
});

test("outdated values are grey, and unknown ones cause no error", async () => {
  const view = await openSpace();
  const picture = view.show({ uavs: [HIGH], beams: [beam("1:1", { oldS: 3 })], array: array(),
    uavsLive: false, message: "NOT LIVE – connection lost" });
  for (const name of ["live", "beam"]) {
    assert.ok(!picture.drawn.some(({ strokeStyle }) => strokeStyle === view.browser.colour(name)));
  }
  picture.text("NOT LIVE – connection lost");
  view.show({
    uavs: [uav("2:1", { down_m: null, horizontal_bound_m: null, velocity_ned_mps: null }),
      uav("3:1", { north_m: null })],
    beams: [beam("9:1", { bearing_deg: null }),
      beam("8:1", { range_m: null, elevation_deg: null, pointing_bound_deg: null })],
    nodes: [{ ...otherNode("south"), north_m: 10, east_m: 10 }], selected: "2:1",
  });
  assert.deepEqual(view.plan.hits.map(({ uav: { id } }) => id), ["2:1"]);
});

test("a followed UAV is centred", async () => {
  const view = await openSpace();
  view.plan.follow("1:1");
  view.show({ uavs: [HIGH] });
  near(view.plan.hits[0].x, CENTRE.x);
  near(view.plan.hits[0].y, CENTRE.y);
});

test("the convex hull contains all points and has no other corners", () => {
  const corners = [[0, 0], [4, 0], [4, 3], [0, 3]];
  assert.deepEqual(new Set(hull([[2, 1], ...corners, [1, 2], [2, 0]]).map(String)),
    new Set(corners.map(String)));
});
