// Verdicts on the page: the headline, what to do, the worst first, and the alarm.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { uav, weak } from "./service.mjs";
import { BEAT_MS, openPage } from "./whole_page.mjs";

const { headlineOf, troublesOf, showTroubles, worstFirst } = await load("health.js");

test("the headline counts good links and shows the worst level", () => {
  const said = (...verdicts) => headlineOf(verdicts.map((verdict) => ({ verdict })));
  assert.deepEqual(said("good", "good"), { text: "2 of 2 links good", level: "good" });
  assert.deepEqual(said("good", "weak"), { text: "1 of 2 links good", level: "warn" });
  assert.deepEqual(said("weak", "none", "good", null), { text: "1 of 3 links good", level: "bad" });
  assert.deepEqual(said(null), { text: "no link assessed yet", level: "wait" });
});

test("links are grouped by cause, worst first, without the good ones", () => {
  const uavs = [uav("1:1", weak()), uav("2:1"), uav("3:1", weak("none", { cause: "silent" })),
    uav("4:1", weak("weak", { reason: "reports 2.0 s apart" }))];
  assert.deepEqual(troublesOf(uavs).map(({ level, ids }) => [level, ids]),
    [["none", ["3:1"]], ["weak", ["1:1", "4:1"]]]);
});

test("links of one verdict are sorted by guaranteed gain with 1 dB of hysteresis", () => {
  const gains = (guaranteed, likely = 12) => ({ ...weak("weak"),
    health: { needed_gain_db: 3, guaranteed_gain_db: guaranteed, likely_gain_db: likely } });
  const order = (...given) => given.map((one, i) => uav(`${i + 1}:1`, one)).sort(worstFirst)
    .map(({ id }) => id.split(":")[0]).join("");
  assert.equal(order(gains(2.9), gains(-9), gains(null)), "321");
  assert.equal(order(gains(2.9), gains(2.0), gains(2.5)), "123");
  assert.equal(order(gains(null), gains(null, -20), gains(null, null)), "321");
  assert.equal(order(gains(-40), weak("none")), "21");
});

test("remedies are shown with selectable UAVs; the panel hides when all links are good", () => {
  const browser = openBrowser();
  const chosen = [];
  showTroubles([uav("1:1", weak()), uav("2:1")], (id) => chosen.push(id));
  const panel = browser.element("troubles-panel");
  assert.equal(panel.hidden, false);
  assert.match(browser.text("troubles"), /1:1 weakreports 1.1 s apart→ ask for 10 Hz/);
  browser.element("troubles").querySelector(".name").click();
  assert.deepEqual(chosen, ["1:1"]);
  showTroubles([uav("1:1")], () => {});
  assert.equal(panel.hidden, true);
});

test("the worst link is the first row, and the page title has the headline", async () => {
  const page = await openPage({ ids: ["1:1", "2:1", "3:1"] });
  assert.deepEqual(page.rows(), ["1:1", "2:1", "3:1"]);
  page.service.uavs = [uav("1:1"), uav("2:1", weak()), uav("3:1", weak("none"))];
  await page.time.advance(2 * BEAT_MS);
  assert.deepEqual(page.rows(), ["3:1", "2:1", "1:1"]);
  assert.equal(page.text("headline"), "1 of 3 links good");
  assert.equal(page.document.title, "1 of 3 links good · companion");
  const plan = await page.drawn();
  plan.text("▲ 2:1");
  plan.text("✕ 3:1");
});

test("the alarm is off by default, stays until acknowledged, and is stored", async () => {
  const page = await openPage();
  const [bar, button] = [page.element("alarm-bar"), page.element("alarm")];
  const worsen = async (id) => {
    page.service.uavs = page.service.uavs.map((one) => (one.id === id ? uav(id, weak()) : one));
    await page.time.advance(2 * BEAT_MS);
  };
  assert.equal(page.text("alarm"), "Alarm off");
  await worsen("1:1");
  assert.equal(bar.hidden, true);
  button.click();
  assert.deepEqual([page.text("alarm"), page.storage.getItem("companion.alarm")],
    ["Alarm on", "on"]);
  assert.equal(bar.hidden, true); // what was bad at the start raises no alarm
  await worsen("2:1");
  assert.deepEqual([bar.hidden, page.text("alarm-text")], [false, "ALARM – link to 2:1: weak"]);
  page.service.uavs = page.service.uavs.map(({ id }) => uav(id));
  await page.time.advance(2 * BEAT_MS);
  assert.equal(bar.hidden, false); // good again, but not yet acknowledged
  page.element("alarm-seen").click();
  assert.equal(bar.hidden, true);
  page.service.mode = "gone";
  await page.time.advance(6000);
  assert.equal(page.text("alarm-text"), "ALARM – connection to the service lost");
  button.click();
  assert.deepEqual([bar.hidden, page.text("alarm")], [true, "Alarm off"]);
});

test("the alarm sounds every two seconds until acknowledged; a bad start does not count", async () => {
  const page = await openPage();
  let tones = 0;
  const node = { connect: () => {}, frequency: {}, start: () => { tones += 1; }, stop: () => {} };
  globalThis.AudioContext = class {
    constructor() {
      Object.assign(this, { state: "running", currentTime: 0, destination: null });
    }

    resume() {}

    createOscillator() {
      return node;
    }
  };
  try {
    page.element("alarm").click();
    page.service.uavs = [...page.service.uavs, uav("3:1", weak("none"))];
    await page.time.advance(2 * BEAT_MS);
    assert.deepEqual([tones, page.element("alarm-bar").hidden], [0, true]);
    page.service.uavs = page.service.uavs.map(({ id }) => uav(id, weak()));
    await page.time.advance(10_000);
    assert.ok(tones >= 6 && tones <= 10, `${tones}`); // two tones per alarm
    page.element("alarm-seen").click();
    const before = tones;
    await page.time.advance(5000);
    assert.equal(tones, before);
  } finally {
    delete globalThis.AudioContext;
  }
});
