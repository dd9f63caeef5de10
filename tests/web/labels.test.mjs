// The names beside the symbols of the plan view: whose they are, what they say, and that they
// cover neither one another nor a symbol.

import assert from "node:assert/strict";
import { test } from "node:test";

import { near } from "./near.mjs";
import { CENTRE, circles, openPlan } from "./plan_picture.mjs";
import { uav } from "./service.mjs";

const NBSP = "\u00a0";

const show = async (uavs, scene = {}) => (await openPlan()).show({ uavs, ...scene });

test("a UAV is labelled with its name and its height above the carrier", async () => {
  const picture = await show([uav("1:1", { down_m: -50 })]);
  const [symbol] = circles(picture, 6);
  const [name, height] = [picture.text("1:1"), picture.text(`↑50.0${NBSP}m`)];
  assert.ok(name.x > symbol.x && name.x < symbol.x + 30);
  near([name.y, height.y], [symbol.y - 7.5, symbol.y + 8.5]);
  near(height.x, name.x);
});

test("a UAV below the carrier has a down arrow", async () => {
  (await show([uav("1:1", { down_m: 30 })])).text(`↓30.0${NBSP}m`);
  (await show([uav("1:1", { down_m: 0 })])).text(`↑0.0${NBSP}m`);
});

test("a UAV that is not live is labelled with its state", async () => {
  (await show([uav("1:1", { state: "coasting" })])).text(`↑50.0${NBSP}m coasting`);
  (await show([uav("1:1", { state: "lost", down_m: null })])).text("lost");
});

test("a UAV outside the view is labelled with its range", async () => {
  const view = await openPlan();
  view.plan.zoom(20);
  const picture = view.show({ uavs: [uav("1:1", { north_m: 300, east_m: -400, down_m: -9 })] });
  picture.text("1:1");
  picture.text(`500${NBSP}m away`);
});

/** Boxes of the names, from the top of the letters to their foot. */
const boxesOf = (picture, names) => names.map((text) => {
  const { x, y, font } = picture.text(text);
  const size = Number(/([\d.]+)px/.exec(font)[1]);
  return { text, left: x, right: x + (text.length * size) / 2, top: y - size / 2,
    bottom: y + size / 2 };
});

const overlap = (a, b) =>
  a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

test("labels of close UAVs overlap neither each other nor a symbol", async () => {
  const uavs = [0, 1, 2, 3, 4].map((i) => uav(`${i}:1`, { north_m: 100, east_m: 22 * (i - 2) }));
  const picture = await show(uavs);
  const boxes = boxesOf(picture, uavs.map(({ id }) => id));
  const symbols = circles(picture, 6).map(({ x, y }) =>
    ({ left: x - 6, right: x + 6, top: y - 6, bottom: y + 6 }));
  boxes.forEach((box, i) => {
    for (const other of [...boxes.slice(i + 1), ...symbols]) {
      assert.ok(!overlap(box, other), `${box.text} covers ${other.text ?? "a symbol"}`);
    }
  });
});

test("labels leave the bearing scale legible", async () => {
  const view = await openPlan();
  view.show({ uavs: [uav("1:1", { north_m: 0, east_m: 140 })] }); // the scale stays
  const bearings = ["N", "E", "S", "W", "030", "060", "120", "240", "300"];
  for (let deg = 0; deg < 360; deg += 3) {
    const [north_m, east_m] = [Math.cos, Math.sin].map((part) => 140 * part(deg * Math.PI / 180));
    const picture = view.show({ uavs: [uav("1:1", { north_m, east_m })] });
    const [name] = boxesOf(picture, ["1:1"]);
    for (const bearing of bearings) {
      const { x, y } = picture.text(bearing);
      const box = { left: x - 8, right: x + 8, top: y - 5, bottom: y + 5 };
      assert.ok(!overlap(name, box), `at ${deg} the name covers ${bearing}`);
    }
  }
});

test("labels stay inside the view", async () => {
  const view = await openPlan();
  view.show({ uavs: [uav("1:1", { north_m: 0, east_m: 140 })] });
  for (const uavs of [[uav("9999:100", { north_m: 0, east_m: 140 })],
    [uav("9999:100", { north_m: 140, east_m: 0 })]]) {
    const [box] = boxesOf(view.show({ uavs }), ["9999:100"]);
    assert.ok(box.left > 0 && box.right < 400 && box.top > 0 && box.bottom < 400);
  }
});

test("labels keep clear of the carrier", async () => {
  const picture = await show([
    uav("1:1", { north_m: 0, east_m: -24 }), uav("2:1", { north_m: 140 }),
  ]);
  const [box] = boxesOf(picture, ["1:1"]);
  const carrier = { left: 190, right: 210, top: 190, bottom: 210 };
  assert.ok(!overlap(box, carrier));
  assert.ok(Math.abs(box.left - CENTRE.x) < 100);
});

/** Many coincident UAVs, with room for few labels. */
const crowd = (number) => Array.from({ length: number }, (_, i) => uav(`${i + 1}:1`));

test("a few coincident UAVs all have labels", async () => {
  const picture = await show(crowd(8));
  assert.equal(picture.texts.filter((text) => text.endsWith(":1")).length, 8);
});

test("labels without room are omitted, except that of the selected UAV", async () => {
  const picture = await show(crowd(30), { selected: "30:1" });
  const names = picture.texts.filter((text) => text.endsWith(":1"));
  assert.ok(names.length < 12, `${names.length} names`);
  assert.equal(names[0], "30:1"); // it was placed first
});

test("the worst link is labelled right after the selected UAV", async () => {
  const uavs = crowd(30).map((one) => (one.id === "29:1" ? { ...one, verdict: "none" } : one));
  const picture = await show(uavs, { selected: "30:1" });
  assert.deepEqual(picture.texts.filter((text) => text.endsWith(":1")).slice(0, 2),
    ["30:1", "✕ 29:1"]);
});
