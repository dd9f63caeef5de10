// Beams on the plan view: each a wedge of its half-power width in its bearing, and the boresight.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, themeColours } from "./browser.mjs";
import { near } from "./near.mjs";
import { CENTRE, OUTER_PX, linesFrom, openPlan, wedges } from "./plan_picture.mjs";
import { array, beam, uav } from "./service.mjs";

const { withAlpha } = await load("wedges.js");

/** The wedges of these beams, with a UAV 100 m to the north. */
async function wedgesOf(beams, { array: fields = {}, ...scene } = {}) {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1")], beams, array: array(fields), ...scene });
  return wedges(picture);
}

for (const [name, bearing, x, y] of [
  ["north", 0, 0, -1], ["east", 90, 1, 0], ["south", 180, 0, 1], ["west", 270, -1, 0],
]) {
  test(`a beam to the ${name} is a wedge that points there, with a centre line`, async () => {
    const view = await openPlan();
    const picture = view.show({ beams: [beam("1:1", { bearing_deg: bearing })], array: array() });
    const [wedge] = wedges(picture);
    near(wedge.path[0], CENTRE);
    near([wedge.bearingDeg, wedge.widthDeg], [bearing, 10]);
    const thread = linesFrom(picture, CENTRE)[0];
    near(thread.to, { x: CENTRE.x + wedge.reachPx * x, y: CENTRE.y + wedge.reachPx * y });
  });
}

test("the beam on a UAV goes through it", async () => {
  const view = await openPlan();
  const target = uav("1:1", { north_m: 60, east_m: -80 });
  const bearing = 360 - (Math.atan2(80, 60) * 180) / Math.PI;
  const picture = view.show({
    uavs: [target], beams: [beam("1:1", { bearing_deg: bearing })], array: array(),
  });
  const symbol = picture.of("stroke", ({ path }) => path[0].op === "arc" && path[0].halfX === 6)[0];
  const { to } = linesFrom(picture, CENTRE)[0];
  const [dx, dy] = [symbol.path[0].x - CENTRE.x, symbol.path[0].y - CENTRE.y];
  near(dx * (to.y - CENTRE.y), dy * (to.x - CENTRE.x), 1e-6);
  assert.ok(dx * (to.x - CENTRE.x) + dy * (to.y - CENTRE.y) > 0);
});

test("a line's beam widens as it is steered off boresight, a panel's does not", async () => {
  const steered = beam("1:1", { azimuth_deg: 60, elevation_deg: 0 });
  near((await wedgesOf([steered]))[0].widthDeg, 20);
  near((await wedgesOf([steered], { array: { kind: "ura" } }))[0].widthDeg, 10);
  const high = beam("1:1", { azimuth_deg: 60, elevation_deg: 60 });
  near((await wedgesOf([high]))[0].widthDeg, 10 / Math.sqrt(1 - 3 / 16));
  const endfire = beam("1:1", { azimuth_deg: 90, elevation_deg: 0 });
  near((await wedgesOf([endfire]))[0].widthDeg, 60);
});

test("a widened beam is as wide as its target's uncertainty, up to 120°", async () => {
  const width = async (fields) => (await wedgesOf([beam("1:1", fields)]))[0].widthDeg;
  near(await width({ widened: true, pointing_bound_deg: 20 }), 40);
  near(await width({ widened: true, pointing_bound_deg: 2 }), 10);
  near(await width({ widened: true, pointing_bound_deg: 99 }), 120);
  near(await width({ widened: true, pointing_bound_deg: null }), 10);
  near(await width({ widened: false, pointing_bound_deg: 20 }), 10);
});

test("a beam of unknown width is a centre line only", async () => {
  const [wedge] = await wedgesOf([beam("1:1")], { array: { half_power_beamwidth_deg: null } });
  near(wedge.widthDeg, 0);
});

test("a beam extends beyond its target and fades from there", async () => {
  const [wedge] = await wedgesOf([beam("1:1")]);
  assert.equal(wedge.reachPx, Math.max(OUTER_PX, (100 * OUTER_PX) / 150 + 60));
  const { stops, radius } = wedge.fillStyle;
  assert.equal(radius, wedge.reachPx);
  near(stops[1][0], (100 * OUTER_PX) / 150 / wedge.reachPx);
  const opacities = stops.map(([, colour]) => parseInt(colour.slice(7), 16));
  assert.ok(opacities[0] > opacities[1] && opacities[1] > opacities[2] && opacities[2] === 0);
});

test("a beam without a placed UAV fades from its horizontal range", async () => {
  const far = beam("9:9", { range_m: 200, elevation_deg: 60 }); // 100 m in the plane
  const [wedge] = await wedgesOf([far]);
  near(wedge.fillStyle.stops[1][0] * wedge.reachPx, (100 * OUTER_PX) / 150, 1e-6);
});

test("beams without a bearing or without an array are not drawn", async () => {
  assert.deepEqual(await wedgesOf([beam("1:1", { bearing_deg: null })]), []);
  assert.deepEqual(await wedgesOf([beam("1:1")], { array: {} }).then((list) => list.length), 1);
  const view = await openPlan();
  assert.deepEqual(wedges(view.show({ beams: [beam("1:1")] })), []);
});

test("the boresight is a dotted line in its bearing", async () => {
  const view = await openPlan();
  const line = (picture) => picture.of("stroke", (one) => one.dash.join() === "2,6");
  const [found] = line(view.show({ array: array({ boresight_bearing_deg: 90 }) }));
  near(found.path, [{ x: CENTRE.x + 16, y: CENTRE.y }, { x: CENTRE.x + OUTER_PX, y: CENTRE.y }]);
  assert.deepEqual(line(view.show({ array: array({ boresight_bearing_deg: null }) })), []);
});

test("an opacity is two hexadecimal digits behind the colour", () => {
  assert.deepEqual([0, 0.03, 0.5, 1].map((alpha) => withAlpha("#56b4e9", alpha)),
    ["#56b4e900", "#56b4e908", "#56b4e980", "#56b4e9ff"]);
});

test("every colour that gets an opacity is written #rrggbb in both themes", () => {
  for (const theme of ["dark", "light"]) {
    const colours = themeColours(theme);
    for (const name of ["live", "coast", "stale", "beam"]) {
      assert.match(colours[name], /^#[0-9a-f]{6}$/, `${name} of ${theme}`);
    }
  }
});

test("many wide beams together are no more opaque than one", async () => {
  const view = await openPlan();
  const opacity = (number, width) => {
    const ids = Array.from({ length: number }, (_, i) => `${i + 1}:1`);
    const picture = view.show({
      uavs: ids.map((id) => uav(id)), array: array(),
      beams: ids.map((id) => beam(id, { widened: true, pointing_bound_deg: width / 2 })),
    });
    return parseInt(wedges(picture)[0].fillStyle.stops[1][1].slice(7), 16);
  };
  assert.equal(opacity(1, 120), opacity(4, 20));
  assert.ok(opacity(20, 120) < opacity(1, 120) / 5);
  assert.ok(opacity(100, 120) > 0);
});
