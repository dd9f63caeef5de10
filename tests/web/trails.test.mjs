// Where a UAV has been, and what it reported: on the earth, so that a trail stays where it was
// flown while the carrier moves.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { near } from "./near.mjs";
import { CENTRE, OUTER_PX, openPlan } from "./plan_picture.mjs";
import { LAT, LON, uav } from "./service.mjs";

const { fixesOf, metresPerDegree, trailOf } = await load("trails.js");
const { History } = await load("history.js");

const PX_PER_M = OUTER_PX / 150;

/** A history of one UAV: a moment for each of `[at, fields]`. */
function historyOf(...moments) {
  const history = new History();
  for (const [at, fields] of moments) history.add({ at, uavs: [uav("1:1", fields)] });
  return history;
}

/** Segments of the trail, oldest first, recognised by their round ends. */
const trailIn = (picture) => picture.of("stroke", (one) => one.lineCap === "round"
  && one.strokeStyle === "#27c498" && /^move (line|curve)$/.test(one.path.map(({ op }) => op)
    .join(" ")));

test("a degree has the length given by ellipsoid tables", () => {
  // Length of a degree of latitude and of longitude on WGS84, metres.
  for (const [latDeg, north, east] of [
    [0, 110_574, 111_320], [30, 110_852, 96_486], [45, 111_132, 78_847], [60, 111_412, 55_800],
    [-60, 111_412, 55_800], [80, 111_660, 19_393],
  ]) {
    const found = metresPerDegree(latDeg);
    near([found.north, found.east], [north, east], 1.5, `${latDeg}°`);
  }
});

test("a trail from the southwest runs from below left to its UAV", async () => {
  const view = await openPlan();
  const { north, east } = metresPerDegree(LAT + 0.0009);
  const here = { lat_deg: LAT + 0.0009, lon_deg: LON };
  const then = { lat_deg: here.lat_deg - 40 / north, lon_deg: LON - 30 / east };
  for (const [at, fields] of [[1000, then], [1850, here]]) {
    view.history.add({ at, uavs: [uav("1:1", { ...fields, velocity_ned_mps: null })] });
  }
  const picture = view.show({ uavs: [uav("1:1", { ...here, velocity_ned_mps: null })], at: 1850 });
  const [{ path: [from, to] }] = trailIn(picture);
  const place = { x: CENTRE.x, y: CENTRE.y - 100 * PX_PER_M };
  near(to, place);
  near(from, { x: place.x - 30 * PX_PER_M, y: place.y + 40 * PX_PER_M }, 0.01);
});

test("a trail belongs to its UAV and ends at the displayed time", () => {
  const history = historyOf([1000], [2000], [3000]);
  const at = (moment) => trailOf(uav("1:1"), history, moment).map((point) => point.at);
  assert.deepEqual(at(3000), [1000, 2000, 3000]);
  assert.deepEqual(at(2000), [1000, 2000]);
  assert.deepEqual(trailOf(uav("2:1"), history, 3000), []);
});

test("trails last 45 s, reported positions 12 s", () => {
  const fix = { at: "a", lat_deg: LAT, lon_deg: LON };
  const history = historyOf([0, { fix }], [22_500], [45_000]);
  near(trailOf(uav("1:1"), history, 45_000).map(({ age }) => age), [0.5, 0]);
  near(trailOf(uav("1:1"), history, 44_999).map(({ age }) => age),
    [44_999 / 45_000, 22_499 / 45_000]);
  near(fixesOf(uav("1:1"), history, 11_999).map(({ age }) => age), [11_999 / 12_000]);
  assert.deepEqual(fixesOf(uav("1:1"), history, 12_000), []);
});

test("a trail crosses the date line, not the whole earth", () => {
  const history = historyOf([1000, { lat_deg: 0, lon_deg: 179.9999 }],
    [2000, { lat_deg: 0, lon_deg: -179.9999 }]);
  const now = uav("1:1", { lat_deg: 0, lon_deg: -179.9999, north_m: 0, east_m: 50 });
  near(trailOf(now, history, 2000).map(({ east }) => east), [50 - 22.26, 50], 0.01);
});

test("a trail follows the flown curve between points of a circle", async () => {
  const view = await openPlan();
  const { north, east } = metresPerDegree(LAT);
  const radiusM = 100;
  const on = (angle) => ({ // clockwise, a quarter of the circle in 2 s
    lat_deg: LAT + (radiusM * Math.cos(angle)) / north,
    lon_deg: LON + (radiusM * Math.sin(angle)) / east,
    north_m: radiusM * Math.cos(angle), east_m: radiusM * Math.sin(angle),
    velocity_ned_mps: [-Math.sin(angle), Math.cos(angle), 0]
      .map((one) => (one * radiusM * Math.PI) / 4),
  });
  view.history.add({ at: 1000, uavs: [uav("1:1", on(0))] });
  view.history.add({ at: 3000, uavs: [uav("1:1", on(Math.PI / 2))] });
  const picture = view.show({ uavs: [uav("1:1", on(Math.PI / 2))], at: 3000 });
  const [from, { controls: [c1, c2], ...to }] = trailIn(picture)[0].path;
  const middle = ["x", "y"].map((k) => (from[k] + 3 * c1[k] + 3 * c2[k] + to[k]) / 8);
  near(Math.hypot(middle[0] - CENTRE.x, middle[1] - CENTRE.y), radiusM * PX_PER_M, 2);
  assert.ok(c1.x > from.x && c2.y < to.y);
});

test("a trail is thick where reports support it, thin where predicted", async () => {
  const view = await openPlan();
  for (const [at, state] of [[1000, "live"], [2000, "live"], [3000, "coasting"]]) {
    view.history.add({ at, uavs: [uav("1:1", { state })] });
  }
  const [measured, estimated] = trailIn(view.show({ uavs: [uav("1:1")], at: 3000 }));
  assert.ok(measured.lineWidth > 2 * estimated.lineWidth);
});

test("a trail fades with its age", async () => {
  const view = await openPlan();
  for (const at of [1000, 3000, 5000, 7000]) view.history.add({ at, uavs: [uav("1:1")] });
  const alphas = trailIn(view.show({ uavs: [uav("1:1")], at: 40_000 }))
    .map(({ globalAlpha }) => globalAlpha);
  assert.equal(alphas.length, 3);
  assert.ok(alphas[0] < alphas[1] && alphas[1] < alphas[2] && alphas[2] < 0.3);
});

test("no trail is drawn across a gap in the received data", async () => {
  const view = await openPlan();
  for (const at of [1000, 2000, 4501, 5000]) view.history.add({ at, uavs: [uav("1:1")] });
  assert.equal(trailIn(view.show({ uavs: [uav("1:1")], at: 5000 })).length, 2);
});

test("each report is one cross at its reported position", async () => {
  const view = await openPlan();
  const { north, east } = metresPerDegree(LAT + 0.0009);
  const fixes = [-20, -10].map((m, i) => ({ // to the southeast
    at: `${i}`, lat_deg: LAT + 0.0009 + m / north, lon_deg: LON - m / east,
  }));
  [fixes[0], fixes[0], fixes[1], null].forEach((fix, i) =>
    view.history.add({ at: 1000 + 850 * i, uavs: [uav("1:1", { fix })] }));
  const picture = view.show({ uavs: [uav("1:1")], at: 3550 });
  const crosses = picture.of("stroke", (one) =>
    one.path.map(({ op }) => op).join(" ") === "move line move line" && one.lineWidth === 1.2);
  const places = crosses.map(({ path }) => ({ x: (path[0].x + path[1].x) / 2, y: path[0].y }));
  near(places, [20, 10].map((m) =>
    ({ x: CENTRE.x + m * PX_PER_M, y: CENTRE.y - (100 - m) * PX_PER_M })), 0.01);
  assert.ok(crosses[0].globalAlpha < crosses[1].globalAlpha);
});

test("a UAV without a geodetic position has no trail", async () => {
  const view = await openPlan();
  for (const at of [1000, 2000]) view.history.add({ at, uavs: [uav("1:1")] });
  const picture = view.show({ uavs: [uav("1:1", { lat_deg: null })], at: 2000 });
  assert.deepEqual(trailIn(picture), []);
});
