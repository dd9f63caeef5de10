// Phase and amplitude of every element: from the weights' column of one UAV to dots and bars.
// The picture is 288 by 208 px; with 8 elements each has 30 px from 40 px on.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { near } from "./near.mjs";

const { elementsOf, makeElements } = await load("elements.js");
const WEIGHTS = { uavs: ["1:1", "2:1"], re: [[9, 1], [9, 0], [9, -0.5], [9, 0]],
  im: [[9, 0], [9, 2], [9, 0], [9, -0.2]] };

test("phase is in degrees, amplitude in dB relative to the strongest element", () => {
  const found = elementsOf(WEIGHTS, "2:1");
  near(found.map(({ deg }) => deg), [0, 90, 180, -90]);
  near(found.map(({ db }) => db), [-6.0206, 0, -12.0412, -20], 1e-4);
  near(elementsOf(WEIGHTS, "1:1").map(({ deg }) => deg), [45, 45, 45, 45]);
});

test("a UAV without a weight column has no elements", () => {
  assert.equal(elementsOf(WEIGHTS, "3:1"), null);
  assert.equal(elementsOf(null, "1:1"), null);
  assert.equal(elementsOf(WEIGHTS, null), null);
});

function draw(elements, trusted = true) {
  const browser = openBrowser();
  const canvas = browser.element("elements");
  const surface = makeElements(canvas);
  browser.resize("elements", 288, 208);
  surface.show({ elements, trusted });
  const picture = canvas.getContext("2d");
  const dots = picture.of("fill", ({ path }) => path[0].op === "arc")
    .map(({ path, fillStyle }) => ({ ...path[0], fillStyle }));
  const bars = picture.of("rect").slice(1); // after the background
  return { browser, picture, dots, bars };
}

const eight = (values) => Array.from({ length: 8 }, (_, i) => values[i] ?? { db: 0, deg: 0 });

test("phases are dots, positive above the middle line and negative below", () => {
  const { picture, dots } = draw(eight([
    { db: 0, deg: 0 }, { db: 0, deg: 90 }, { db: 0, deg: -90 }, { db: 0, deg: 180 },
  ]));
  const [top, middle, bottom] = ["180°", "0°", "−180°"].map((text) => picture.text(text).y);
  near(dots.map(({ y }) => y).slice(0, 4),
    [middle, (top + middle) / 2, (middle + bottom) / 2, top], 0.51);
  near(dots.map(({ x }) => x), eight([]).map((_, i) => 40 + 30 * (i + 0.5)));
});

test("amplitudes are bars in dB: full for the strongest, empty at −30 and below", () => {
  const { picture, bars } = draw(eight([
    { db: 0, deg: 0 }, { db: -15, deg: 0 }, { db: -30, deg: 0 }, { db: -45, deg: 0 },
  ]));
  const [top, bottom] = ["0 dB", "−30"].map((text) => picture.text(text).y);
  const fullPx = bottom - top;
  near(bars.map(({ height }) => height).slice(0, 4), [fullPx, fullPx / 2, 0, 0], 0.51);
  bars.forEach((bar) => near(bar.y + bar.height, bottom, 0.51));
  near(bars.map(({ x, width }) => x + width / 2), eight([]).map((_, i) => 40 + 30 * (i + 0.5)));
});

test("first and last element are labelled", () => {
  const { picture } = draw(eight([]));
  assert.ok(picture.text("element 0").x < picture.text("7").x);
});

test("outdated values have the stale colour", () => {
  for (const [trusted, dot, bar] of [[true, "beam", "coast"], [false, "stale", "stale"]]) {
    const { browser, dots, bars } = draw(eight([]), trusted);
    assert.equal(dots[0].fillStyle, browser.colour(dot));
    assert.equal(bars[0].fillStyle, browser.colour(bar));
  }
});

test("without weights the page says so", () => {
  for (const elements of [null, []]) {
    assert.deepEqual(draw(elements).picture.texts, ["no weights"]);
  }
});
