// Metres and metres per second in other units: in the table, the plan, the drawer, the charts and
// what is exported. What is chosen stays chosen.

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { circles, openPlan } from "./plan_picture.mjs";
import { beam, stampAt, uav } from "./service.mjs";
import { openPage } from "./whole_page.mjs";

const format = await load("format.js");
const { csvOf } = await load("export.js");
const { LENGTHS, SPEEDS, lengthOf, setUpUnits, speedOf, units, use } = await load("units.js");
const plain = (text) => text.replaceAll("\u00a0", " ");

beforeEach(() => use({ length: "m", speed: "m/s" }));

test("units have their international definitions", () => {
  assert.deepEqual([LENGTHS.ft.metres, LENGTHS.ft.far.metres], [0.3048, 1852]);
  use({ length: "ft", speed: "kn" });
  assert.equal(lengthOf(304.8), 1000);
  assert.ok(Math.abs(speedOf(1852) - 3600) < 1e-9);
  use({ speed: "km/h" });
  assert.ok(Math.abs(speedOf(10) - 36) < 1e-12);
  use({ length: "furlong", speed: "toString" });
  assert.deepEqual([units.length, units.speed], [LENGTHS.ft, SPEEDS["km/h"]]);
});

test("feet, nautical miles for long distances, knots and kilometres per hour", () => {
  use({ length: "ft", speed: "kn" });
  const lengths = [[0, "0.0 ft"], [1, "3.3 ft"], [30.46, "99.9 ft"], [304.8, "1000 ft"],
    [-100, "−328 ft"], [3047.8, "9999 ft"], [3048, "1.6 nmi"], [185_200, "100.0 nmi"]];
  for (const [metres, text] of lengths) assert.equal(plain(format.length(metres)), text);
  assert.equal(plain(format.speed(100)), "194.4 kn");
  use({ speed: "km/h" });
  assert.equal(plain(format.speed(100)), "360.0 km/h");
  for (const none of [null, undefined, NaN]) {
    assert.deepEqual([format.length(none), format.speed(none)], ["–", "–"]);
  }
});

test("exports name their units, and unknown values are empty", () => {
  const view = { stamp: stampAt(0), beams: [beam("1:1", { range_m: 304.8 })],
    uavs: [uav("1:1", { alt_m: 30.48, speed_mps: 10, bound_m: null })] };
  const row = () => {
    const [head, line] = csvOf(view).split("\n").map((text) => text.split(","));
    return Object.fromEntries(head.map((name, i) => [name, line[i]]));
  };
  assert.deepEqual([row().alt_m, row().speed_mps, row().range_m], ["30.48", "10", "304.8"]);
  use({ length: "ft", speed: "kn" });
  const { alt_ft: alt, speed_kn: speed, range_ft: range, bound_ft: bound } = row();
  assert.deepEqual([alt, speed, range, bound], ["100", "19.438", "1000", ""]);
  assert.deepEqual(Object.keys(row()).filter((name) => /_(m|mps)$/.test(name)), []);
  use({ speed: "km/h" });
  assert.equal(row().speed_kmh, "36");
});

test("ring distances are round numbers in the selected units", async () => {
  const view = await openPlan();
  const labels = (picture) => picture.texts.filter((text) => / (m|km|ft|nmi)$/.test(text));
  const uavs = [uav("1:1", { north_m: 180, east_m: 0 })];
  assert.deepEqual(labels(view.show({ uavs })).slice(0, 4), ["50 m", "100 m", "150 m", "200 m"]);
  use({ length: "ft" });
  view.plan.changeUnits();
  assert.deepEqual(labels(view.drawAnew()).slice(0, 3), ["200 ft", "400 ft", "600 ft"]);
  assert.equal(circles(view.drawAnew(), 170).length, 1); // the outermost ring has not moved
  uavs[0].north_m = 30_000;
  assert.match(labels(view.show({ uavs }, 20_000))[0], /^\d+ nmi$/);
});

test("selected units apply to the whole page and are stored", async () => {
  const page = await openPage();
  const [length, speed] = [page.element("unit-length"), page.element("unit-speed")];
  assert.deepEqual([length.value, speed.value], ["m", "m/s"]);
  page.service.uavs[0].speed_mps = 10;
  const before = page.cells("range")[0];
  assert.match(before, / m$/);
  [length.value, speed.value] = ["ft", "kn"];
  length.dispatch("change");
  await page.time.advance(1000);
  assert.match(page.cells("range")[0], / ft$/);
  assert.match(page.cells("speed")[0], / kn$/);
  assert.equal(page.text("innovation-unit"), "ft");
  page.element("uavs").querySelector(".pick").click();
  await page.time.advance(100);
  assert.match(plain(page.text("drawer-facts")), /Bound[\d.]+ ft/);
  use({ length: "m", speed: "m/s" });
  const next = openBrowser({ storage: page.storage });
  setUpUnits(() => {});
  assert.deepEqual([next.element("unit-length").value, units.speed.name], ["ft", "kn"]);
});

test("invalid or missing stored units default to metres", () => {
  for (const kept of ["{", "null", '{"length":"ell"}']) {
    const storage = { getItem: () => kept, setItem: () => {} };
    openBrowser({ storage });
    setUpUnits(() => {});
    assert.deepEqual([units.length.name, units.speed.name], ["m", "m/s"]);
  }
});
