// Pause and look back: what the slider, the button and the steps show, and that the past says of
// itself that it is past.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { stampAt, uav } from "./service.mjs";

const { TimeBar } = await load("timebar.js");
const { History } = await load("history.js");
const NBSP = "\u00a0";

/** A history with a moment a second for half a minute, which ends now. */
function openBar({ seconds = 30 } = {}) {
  const browser = openBrowser();
  const { time } = browser;
  time.now = 100_000;
  const history = new History();
  for (let s = seconds; s >= 0; s -= 1) {
    history.add({ at: time.now - s * 1000, stamp: stampAt(-s), uavs: [uav("1:1")] });
  }
  let changes = 0;
  const bar = new TimeBar(history, () => { changes += 1; });
  return {
    browser, history, bar,
    draw: () => bar.draw(time.now),
    agoS: () => (bar.isLive ? null : (time.now - bar.shown.at) / 1000),
    changes: () => changes,
  };
}

test("the button pauses at the newest time and returns to live", () => {
  const { browser, bar, agoS, changes } = openBar();
  assert.ok(bar.isLive);
  browser.element("pause").click();
  assert.equal(agoS(), 0);
  assert.equal(bar.isLive, false);
  browser.element("pause").click();
  assert.ok(bar.isLive);
  assert.equal(changes(), 2);
});

test("a paused page keeps its time", async () => {
  const { browser, history, bar, agoS } = openBar();
  bar.toggle();
  await browser.time.advance(5000);
  history.add({ at: browser.time.now, stamp: stampAt(5), uavs: [] });
  assert.equal(agoS(), 5);
});

test("steps go to the adjacent response, jumps by ten seconds, Home to the oldest", () => {
  const { bar, agoS } = openBar();
  bar.step(-1);
  assert.equal(agoS(), 1);
  bar.step(-1);
  assert.equal(agoS(), 2);
  bar.step(1);
  assert.equal(agoS(), 1);
  bar.jump(-1);
  assert.equal(agoS(), 11);
  bar.jump(1);
  assert.equal(agoS(), 1);
  bar.jump(1);
  assert.equal(agoS(), 0);
  bar.toOldest();
  assert.equal(agoS(), 30);
  bar.goLive();
  assert.equal(agoS(), null);
});

test("the slider shows the time that its age states", () => {
  const { browser, agoS } = openBar();
  browser.element("scrub").value = "-12.3";
  browser.element("scrub").dispatch("input");
  assert.equal(agoS(), 13); // the newest moment that is not after that
});

test("the slider spans the history and follows the displayed time", async () => {
  const { browser, bar, draw } = openBar();
  const scrub = browser.element("scrub");
  draw();
  assert.deepEqual([scrub.min, scrub.value], ["-30", "0"]);
  bar.jump(-1);
  await browser.time.advance(1500);
  draw();
  assert.deepEqual([scrub.min, scrub.value], ["-32", "-11.5"]);
  scrub.pseudo.add("active"); // while dragged, the operator controls it
  scrub.value = "-20";
  draw();
  assert.equal(scrub.value, "-20");
});

test("the past is labelled with its time and age", async () => {
  const { browser, bar, draw } = openBar();
  const root = browser.document.documentElement;
  draw();
  assert.ok(browser.element("past").hidden && !root.hasAttribute("data-past"));
  assert.equal(browser.text("time-mode"), "now");
  assert.match(browser.text("pause"), /Pause/);
  assert.equal(browser.element("pause").getAttribute("aria-pressed"), "false");
  bar.jump(-1);
  await browser.time.advance(65_000);
  draw();
  assert.ok(!browser.element("past").hidden && root.hasAttribute("data-past"));
  assert.match(browser.text("past-detail"), /from 12:59:50 UTC, 1.min 15.s ago/);
  assert.equal(browser.text("time-mode"), `−1${NBSP}min 15${NBSP}s`);
  assert.equal(browser.text("reach"), `−1${NBSP}min 35${NBSP}s`);
  assert.match(browser.text("pause"), /Live/);
  assert.equal(browser.element("pause").getAttribute("aria-pressed"), "true");
  const said = browser.element("scrub").getAttribute("aria-valuetext");
  assert.equal(said, `1${NBSP}min 15${NBSP}s ago`);
  bar.goLive();
  draw();
  assert.ok(browser.element("past").hidden && !root.hasAttribute("data-past"));
  assert.equal(browser.element("scrub").getAttribute("aria-valuetext"), "live");
});

test("looking back is disabled before any data", () => {
  const { bar, draw, browser } = openBar({ seconds: -1 });
  bar.toggle();
  bar.step(-1);
  bar.jump(-1);
  bar.toOldest();
  assert.ok(bar.isLive);
  draw();
  assert.equal(browser.element("scrub").min, "0");
});

test("a recording is played to its end, paused, played again, and left for the live page", () => {
  const { browser, bar, draw } = openBar();
  const history = new History();
  const endAt = browser.time.now + 9_000_000; // far from the moments of the page
  history.moments = [0, 1, 2].map((i) => ({ at: endAt - 2000 + i * 1000, stamp: stampAt(i), uavs: [] }));
  bar.openRecording({ name: "a.mcap", history, endAt });
  bar.advance(1500);
  draw();
  assert.equal(bar.shown, history.moments[1]);
  assert.equal(browser.text("past-title"), "RECORDING – NOT LIVE");
  assert.match(browser.text("past-detail"), /^a\.mcap: 2026-11-20 13:00:01 UTC/);
  assert.deepEqual([browser.element("scrub").min, browser.element("scrub").value], ["-2", "-1"]);
  bar.toggle();
  assert.equal(bar.recording.isPlaying, false);
  bar.toggle();
  bar.advance(60_000);
  assert.deepEqual([bar.shown, bar.recording.isPlaying], [history.moments[2], false]);
  bar.toggle(); // from the beginning
  bar.advance(0);
  assert.equal(bar.shown, history.moments[0]);
  bar.goLive();
  draw();
  assert.ok(bar.isLive && bar.recording === null && browser.element("past").hidden);
});
