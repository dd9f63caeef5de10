// The plan view is moved by hand: dragged, pinched, followed; a press that stays where it is chooses.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { circles } from "./plan_picture.mjs";
import { uav } from "./service.mjs";
import { openPage } from "./whole_page.mjs";

const { setUpGestures } = await load("gestures.js");

function openCanvas() {
  const canvas = openBrowser().element("plan");
  const done = [];
  setUpGestures(canvas, {
    pan: (dx, dy) => done.push(["pan", dx, dy]), zoom: (steps) => done.push(["zoom", steps]),
    choose: () => done.push(["choose"]),
  });
  const point = (type, pointerId, clientX, clientY = 0) =>
    canvas.dispatch(type, { pointerId, clientX, clientY });
  return { canvas, done, point };
}

test("a press without movement selects; a drag pans without selecting", () => {
  const { canvas, done, point } = openCanvas();
  point("pointerdown", 1, 100);
  point("pointermove", 1, 103);
  point("pointerup", 1, 103);
  canvas.click();
  assert.deepEqual(done, [["choose"]]);
  point("pointerdown", 1, 100);
  point("pointermove", 1, 140, 20);
  point("pointerup", 1, 140, 20);
  canvas.click();
  assert.deepEqual(done.slice(1), [["pan", 40, 20]]);
  point("pointermove", 1, 300); // no pointer is pressed any more
  assert.equal(done.length, 2);
});

test("two fingers zoom by their spread and do not pan", () => {
  const { done, point } = openCanvas();
  point("pointerdown", 1, 100);
  point("pointerdown", 2, 200);
  point("pointermove", 2, 220);
  assert.deepEqual(done, []);
  point("pointermove", 2, 230);
  point("pointermove", 2, 190);
  assert.deepEqual(done, [["zoom", 1], ["zoom", -1]]);
});

test("dragging pans, following centres a UAV, and Fit resets both", async () => {
  const page = await openPage();
  page.service.uavs = [uav("1:1", { north_m: 0, east_m: 50 }), uav("2:1")];
  const carrier = async () => {
    const [{ x, y }] = circles(await page.drawn(), 9);
    return [x, y].map(Math.round);
  };
  await page.time.advance(2000);
  assert.deepEqual(await carrier(), [200, 200]);
  const canvas = page.element("plan");
  canvas.dispatch("pointerdown", { pointerId: 1, clientX: 10, clientY: 10 });
  canvas.dispatch("pointermove", { pointerId: 1, clientX: 40, clientY: 30 });
  canvas.dispatch("pointerup", { pointerId: 1, clientX: 40, clientY: 30 });
  assert.deepEqual(await carrier(), [230, 220]);
  assert.equal(page.element("zoom-fit").getAttribute("aria-pressed"), "false");
  page.press("1");
  page.press("f");
  assert.equal(page.element("follow").getAttribute("aria-pressed"), "true");
  const [x, y] = await carrier();
  assert.ok(x < 190 && y === 200, `${x} ${y}`); // the UAV, east of the carrier, is centred
  page.press("0");
  assert.deepEqual(await carrier(), [200, 200]);
  assert.equal(page.element("zoom-fit").getAttribute("aria-pressed"), "true");
});
