// Where the plan view puts things: north up, east right, metres to scale, everything about the
// carrier in the middle.

import assert from "node:assert/strict";
import { test } from "node:test";

import { near } from "./near.mjs";
import {
  CENTRE, OUTER_PX, arrows, circles, edgeArrows, ellipses, linesFrom, openPlan,
} from "./plan_picture.mjs";
import { uav } from "./service.mjs";

/** A hovering UAV is a circle of 6 px. */
const stillAt = (picture) => circles(picture, 6)[0];

const COMPASS = [
  { name: "north", north_m: 100, east_m: 0, x: 0, y: -1 },
  { name: "south", north_m: -100, east_m: 0, x: 0, y: 1 },
  { name: "east", north_m: 0, east_m: 100, x: 1, y: 0 },
  { name: "west", north_m: 0, east_m: -100, x: -1, y: 0 },
];
const SIDE = { north: "above it", south: "below it", east: "right of it", west: "left of it" };
const PX = (100 * OUTER_PX) / 150; // 100 m, with the outermost ring at 150 m

for (const { name, north_m, east_m, x, y } of COMPASS) {
  test(`a UAV ${name} of the carrier is drawn ${SIDE[name]}, to scale`, async () => {
    const view = await openPlan();
    const picture = view.show({ uavs: [uav("1:1", { north_m, east_m })] });
    assert.equal(circles(picture, 6).length, 1);
    near(stillAt(picture), { x: CENTRE.x + x * PX, y: CENTRE.y + y * PX });
  });

  test(`a UAV that flies ${name} points there, with a line to its position in 2 s`, async () => {
    const view = await openPlan();
    const velocity = [north_m / 10, east_m / 10, 0];
    const picture = view.show({
      uavs: [uav("1:1", { north_m: 60, east_m: 60, velocity_ned_mps: velocity })],
    });
    const place = { x: CENTRE.x + 0.6 * OUTER_PX, y: CENTRE.y - 0.6 * OUTER_PX };
    const [symbol] = arrows(picture, view.browser.colour("live"));
    near(symbol.tip, { x: place.x + 9 * x, y: place.y + 9 * y });
    const [leader] = linesFrom(picture, place);
    near(leader.to, { x: place.x + 20 * x * OUTER_PX / 100, y: place.y + 20 * y * OUTER_PX / 100 });
  });

  test(`a carrier that heads ${name} points there`, async () => {
    const view = await openPlan();
    const headingDeg = { north: 0, east: 90, south: 180, west: 270 }[name];
    const picture = view.show({ carrier: { heading_deg: headingDeg } });
    const [symbol] = arrows(picture, view.browser.colour("text"));
    near(symbol.tip, { x: CENTRE.x + 7 * x, y: CENTRE.y + 7 * y });
  });

  test(`a UAV outside the view in the ${name} is an arrow at that edge`, async () => {
    const view = await openPlan();
    view.plan.zoom(20);
    const picture = view.show({ uavs: [uav("1:1", { north_m, east_m })] });
    const [arrow] = edgeArrows(picture);
    near(arrow.tip, { x: CENTRE.x + (184 + 9) * x, y: CENTRE.y + (184 + 9) * y });
    near(arrow.base, { x: CENTRE.x + (184 - 4) * x, y: CENTRE.y + (184 - 4) * y });
    assert.deepEqual(circles(picture, 6), []);
  });
}

test("a UAV to the northeast is above and to the right, twice as far east as north", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1", { north_m: 60, east_m: 120 })] });
  near(stillAt(picture), { x: CENTRE.x + 1.2 * PX, y: CENTRE.y - 0.6 * PX });
});

test("the error bound is a circle of the horizontal bound", async () => {
  const view = await openPlan();
  const picture = view.show({
    uavs: [uav("1:1", { east_m: 50, horizontal_bound_m: 30, vertical_bound_m: 99 })],
  });
  const [bound] = ellipses(picture);
  near(bound, { x: CENTRE.x + PX / 2, y: CENTRE.y - PX });
  near([bound.halfX, bound.halfY], [0.3 * PX, 0.3 * PX]);
  assert.deepEqual(bound.dash, []);
});

test("the bound of an estimate that coasts is dashed", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1", { state: "coasting" })] });
  assert.deepEqual(ellipses(picture)[0].dash, [4, 4]);
});

test("a bound larger than the picture, or unknown, is not drawn", async () => {
  const view = await openPlan();
  for (const bound of [9e3, null]) {
    const picture = view.show({ uavs: [uav("1:1", { horizontal_bound_m: bound })] });
    assert.deepEqual(ellipses(picture), []);
  }
});

test("neither a hovering nor a lost UAV has a line ahead", async () => {
  const view = await openPlan();
  const place = { x: CENTRE.x, y: CENTRE.y - PX };
  const hovering = uav("1:1", { velocity_ned_mps: [0.2, 0.2, 3] });
  assert.deepEqual(linesFrom(view.show({ uavs: [hovering] }), place), []);
  const lost = uav("1:1", { state: "lost", velocity_ned_mps: [9, 0, 0] });
  const near100 = uav("2:1", { north_m: 0, east_m: 100 }); // keeps the scale
  assert.deepEqual(linesFrom(view.show({ uavs: [lost, near100] }), place), []);
});

test("a UAV without a position is not drawn", async () => {
  const view = await openPlan();
  const nowhere = uav("1:1", { north_m: null, east_m: null });
  assert.deepEqual(circles(view.show({ uavs: [nowhere] }), 6), []);
  assert.equal(circles(view.show({ uavs: [nowhere, uav("2:1")] }), 6).length, 1);
});

test("a high-density screen is drawn at twice the pixels", async () => {
  const view = await openPlan({ ratio: 2 });
  assert.deepEqual([view.canvas.width, view.canvas.height], [800, 800]);
  const picture = view.show({ uavs: [uav("1:1")] });
  near(circles(picture, 12)[0], { x: 400, y: 400 - 2 * PX });
});

test("a wide picture is scaled by its height", async () => {
  const view = await openPlan({ width: 900 });
  const picture = view.show({ uavs: [uav("1:1", { north_m: 0, east_m: -100 })] });
  near(stillAt(picture), { x: 450 - PX, y: 200 });
});
