// How many metres the plan view shows, and when that changes: wider at once, narrower only after
// a while, never against the operator's choice.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { near } from "./near.mjs";

async function newScale({ still = false } = {}) {
  openBrowser({ still });
  const { Scale } = await load("scale.js");
  return new Scale();
}

const radiusOf = (scale) => scale.rings[0];

test("the first UAVs are fitted at once, with a small margin", async () => {
  for (const [farthestM, radiusM] of [[10, 50], [47, 50], [48, 60], [140, 150], [142, 200],
    [7000, 8000], [90_000, 100_000]]) {
    const scale = await newScale();
    scale.follow([5, farthestM], 0);
    assert.equal(radiusOf(scale), radiusM, `${farthestM} m`);
    assert.equal(scale.radiusM, radiusM);
  }
});

test("the scale stops at its maximum", async () => {
  const scale = await newScale();
  scale.follow([1e9], 0);
  assert.equal(radiusOf(scale), 800_000);
});

test("the view widens at once for a departing UAV", async () => {
  const scale = await newScale();
  scale.follow([100], 0);
  scale.follow([190], 1);
  assert.equal(radiusOf(scale), 300);
});

test("the view narrows only after four uninterrupted seconds", async () => {
  const scale = await newScale();
  scale.follow([190], 0);
  scale.follow([50], 1000);
  scale.follow([50], 4900);
  assert.equal(radiusOf(scale), 300);
  scale.follow([220], 4950); // out again: the wait restarts
  scale.follow([50], 5000);
  scale.follow([50], 9000);
  assert.equal(radiusOf(scale), 300);
  scale.follow([50], 9001);
  assert.equal(radiusOf(scale), 60);
});

test("the scale does not change without UAVs", async () => {
  const scale = await newScale();
  scale.follow([100], 0);
  scale.follow([], 10_000);
  assert.equal(radiusOf(scale), 150);
});

test("a zoomed scale is kept until Fit, which narrows at once", async () => {
  const scale = await newScale();
  scale.follow([100], 0);
  scale.zoom(-2);
  assert.equal(scale.fit, false);
  assert.equal(radiusOf(scale), 300);
  scale.follow([5000], 10_000);
  assert.equal(radiusOf(scale), 300);
  scale.fitAll();
  scale.follow([100], 10_001);
  assert.equal(radiusOf(scale), 150);
});

test("zooming stops at the smallest and largest scale", async () => {
  const scale = await newScale();
  scale.zoom(100);
  assert.equal(radiusOf(scale), 50);
  scale.zoom(-100);
  assert.equal(radiusOf(scale), 800_000);
});

test("ring distances divide the radius", async () => {
  const scale = await newScale();
  scale.zoom(100);
  for (let before = 0; radiusOf(scale) !== before; scale.zoom(-1)) {
    const [radiusM, stepM] = scale.rings;
    near(radiusM / stepM, Math.round(radiusM / stepM));
    assert.ok(radiusM / stepM >= 3 && radiusM / stepM <= 5, `${radiusM}: ${stepM}`);
    before = radiusM;
  }
});

test("the scale eases monotonically to its new value", async () => {
  const scale = await newScale();
  scale.follow([100], 0);
  scale.follow([900], 1);
  let before = scale.radiusM;
  let frames = 0;
  while (scale.ease()) {
    assert.ok(scale.radiusM > before && scale.radiusM < 1000);
    before = scale.radiusM;
    frames += 1;
  }
  assert.equal(scale.radiusM, 1000);
  assert.ok(frames > 5 && frames < 60, `${frames}`);
});

test("with reduced motion the scale changes in one step", async () => {
  const scale = await newScale({ still: true });
  scale.follow([100], 0);
  scale.follow([900], 1);
  assert.equal(scale.ease(), false);
  assert.equal(scale.radiusM, 1000);
});
