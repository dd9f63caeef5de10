// Range rings and compass of the plan view.

import assert from "node:assert/strict";
import { test } from "node:test";

import { near } from "./near.mjs";
import { CENTRE, OUTER_PX, circles, openPlan } from "./plan_picture.mjs";
import { uav } from "./service.mjs";

/** Metres that the label of a ring says: 50 m, 1.5 km. */
function metresOf(text) {
  const [, number, unit] = /^([\d.]+) (k?m)$/.exec(text) ?? [];
  return number === undefined ? null : Number(number) * (unit === "km" ? 1000 : 1);
}

const labelsOf = (picture) => picture.of("text").map((one) => ({ ...one, m: metresOf(one.text) }))
  .filter(({ m }) => m !== null);

test("compass has N at the top, E at the right, and three-digit bearings between", async () => {
  const picture = (await openPlan()).show({});
  const [n, e, s, w] = ["N", "E", "S", "W"].map((text) => picture.text(text));
  const px = OUTER_PX + 18;
  near([n, e, s, w], [{ x: 200, y: 200 - px }, { x: 200 + px, y: 200 }, { x: 200, y: 200 + px },
    { x: 200 - px, y: 200 }]);
  near(picture.text("030"), {
    x: 200 + px * Math.sin(Math.PI / 6), y: 200 - px * Math.cos(Math.PI / 6),
  });
  assert.ok(n.fillStyle !== e.fillStyle); // north stands out
  assert.equal(picture.texts.filter((text) => /^\d{3}$/.test(text)).length, 8);
});

test("a ring labelled 100 m goes through a UAV 100 m away", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1")] });
  const [symbol] = circles(picture, 6);
  const labels = labelsOf(picture);
  assert.deepEqual(labels.map(({ m }) => m), [50, 100, 150, 200]);
  for (const { m, x, y } of labels) {
    const px = Math.hypot(x - CENTRE.x, y - CENTRE.y);
    near(px, ((CENTRE.y - symbol.y) * m) / 100);
    assert.equal(circles(picture, px).length, 1);
    assert.ok(x < CENTRE.x && y > CENTRE.y); // below to the left
  }
});

test("the outermost ring is heavier, those beyond it fainter", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1")] });
  const [outer] = circles(picture, OUTER_PX);
  const [inner] = circles(picture, OUTER_PX / 3);
  const [beyond] = circles(picture, (OUTER_PX * 4) / 3);
  assert.ok(outer.lineWidth > inner.lineWidth);
  assert.ok(beyond.globalAlpha < outer.globalAlpha && inner.globalAlpha === 1);
});

test("far rings are labelled in kilometres", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1", { north_m: 1400 })] });
  assert.deepEqual(labelsOf(picture).map(({ text }) => text),
    ["500 m", "1 km", "1.5 km", "2 km"]);
});
