// The whole page as an operator works with it: who is shown, in which order, who is chosen, and
// what pausing and looking back show.

import assert from "node:assert/strict";
import { test } from "node:test";

import { near } from "./near.mjs";
import { circles } from "./plan_picture.mjs";
import { beam, patternAnswer, stampAt, uav } from "./service.mjs";
import { BEAT_MS, openPage, turnBeams } from "./whole_page.mjs";

test("UAVs are sorted numerically, not alphabetically", async () => {
  const page = await openPage({ ids: ["10:1", "icao:4CA7B3", "2:1", "1:1", "2:10", "2:9"] });
  assert.deepEqual(page.rows(), ["1:1", "2:1", "2:9", "2:10", "10:1", "icao:4CA7B3"]);
});

test("UAVs are counted by state, best first", async () => {
  const page = await openPage();
  page.service.uavs = ["lost", "live", "stale", "coasting", "live"]
    .map((state, i) => uav(`${i}:1`, { state }));
  await page.time.advance(BEAT_MS);
  assert.equal(page.text("uavs-count"), "2 live · 1 coasting · 1 stale · 1 lost");
  assert.ok(page.element("uavs-empty").hidden);
  page.service.uavs = [];
  await page.time.advance(BEAT_MS);
  assert.equal(page.text("uavs-count"), "");
  assert.equal(page.text("uavs-empty"), "No UAV has reported a position.");
  assert.equal(page.element("uavs-empty").hidden, false);
});

test("number keys select a row, arrows the next, Escape clears the selection", async () => {
  const page = await openPage({ ids: ["1:1", "2:1", "10:1"] });
  const after = (key) => {
    page.press(key);
    return page.chosen().join();
  };
  const keys = ["3", "3", "ArrowUp", "ArrowDown", "ArrowDown", "9", "Escape", "Escape"];
  assert.deepEqual(keys.map(after), ["10:1", "10:1", "2:1", "10:1", "10:1", "10:1", "", ""]);
  assert.equal(after("ArrowUp"), "10:1");
  page.press("Escape");
  assert.equal(after("ArrowDown"), "1:1");
});

test("a click on row or symbol selects, a second one clears", async () => {
  const page = await openPage();
  page.document.querySelectorAll(".pick")[1].click();
  assert.deepEqual(page.chosen(), ["2:1"]);
  page.service.uavs = [uav("1:1"), uav("2:1", { north_m: -100 })];
  await page.time.advance(BEAT_MS);
  const symbols = circles(await page.drawn(), 6);
  const click = ({ x, y }) => page.element("plan").click({ offsetX: x, offsetY: y });
  click(symbols[0]);
  assert.deepEqual(page.chosen(), ["1:1"]);
  assert.equal(circles(await page.drawn(), 15).length > 0, true);
  click(symbols[0]);
  assert.deepEqual(page.chosen(), []);
});

test("a selected UAV that vanishes is deselected", async () => {
  const page = await openPage();
  page.press("2");
  page.service.uavs = [uav("1:1")];
  await page.time.advance(BEAT_MS);
  assert.deepEqual([page.rows(), page.chosen()], [["1:1"], []]);
  page.service.uavs = [uav("1:1"), uav("2:1")];
  await page.time.advance(BEAT_MS);
  assert.deepEqual(page.chosen(), []);
});

test("the pattern is that of the selected UAV at once, or of the first with a beam", async () => {
  const page = await openPage({ ids: ["1:1", "2:1", "10:1"] });
  page.service.beams = [beam("10:1"), beam("2:1")];
  await page.time.advance(5 * BEAT_MS);
  const asked = () => page.service.asked.filter(({ path }) => path.startsWith("/v1/pattern"))
    .at(-1).path.split("uav=")[1];
  assert.equal(decodeURIComponent(asked()), "2:1");
  page.press("3");
  await page.time.advance(10);
  assert.equal(decodeURIComponent(asked()), "10:1");
  const names = page.document.querySelectorAll(".focus-uav").map(({ textContent }) => textContent);
  assert.deepEqual(names, ["10:1"]);
  page.press("1"); // selected, but without a beam
  await page.time.advance(10);
  assert.equal(decodeURIComponent(asked()), "2:1");
});

test("the target in the pattern is where the beam was at the time of the pattern", async () => {
  const page = await openPage({ ids: ["1:1"] });
  turnBeams(page.service);
  await page.time.advance(3 * BEAT_MS);
  const target = () => page.document.querySelector("[data-fact=target] dd").textContent;
  assert.equal(target(), page.cells("azimuth")[0]);
  const then = target();
  const { seconds } = page.service;
  page.service.answers["/v1/pattern"] = { ...patternAnswer("1:1"), valid_at: stampAt(seconds) };
  await page.time.advance(2 * BEAT_MS);
  assert.notEqual(page.cells("azimuth")[0], then);
  assert.equal(target(), then);
});

test("a paused page stops and is labelled, while new data is kept", async () => {
  const page = await openPage({ ids: ["1:1"] });
  turnBeams(page.service);
  await page.time.advance(4 * BEAT_MS);
  page.press(" ");
  const [paused] = page.cells("azimuth");
  await page.time.advance(3 * BEAT_MS);
  assert.deepEqual(page.cells("azimuth"), [paused]);
  assert.equal(page.document.title, "PAUSED · companion");
  assert.equal(page.element("past").hidden, false);
  const plan = await page.drawn();
  assert.ok(plan.texts.some((text) => /^NOT LIVE – \d.s ago$/.test(text)));
  page.press("ArrowRight"); // into data received meanwhile
  const [next] = page.cells("azimuth");
  assert.notEqual(next, paused);
  page.press("ArrowLeft");
  assert.deepEqual(page.cells("azimuth"), [paused]);
  page.press("End");
  assert.equal(page.document.title, "1 of 1 links good · companion");
  assert.ok(page.element("past").hidden);
  near(Number.parseFloat(page.cells("azimuth")[0]), page.service.seconds * 10, 10);
});

test("past values are not struck out when the service is lost", async () => {
  const page = await openPage();
  await page.time.advance(3 * BEAT_MS);
  page.press(" ");
  page.service.mode = "gone";
  await page.time.advance(5000);
  assert.deepEqual(page.marked("lost").filter((name) => name !== "recordings"), []);
  assert.equal(page.text("banner-title"), "CONNECTION LOST"); // the present state
  assert.ok((await page.drawn()).drawn.some(({ strokeStyle }) =>
    strokeStyle === page.colour("live")));
  page.press(" ");
  await page.time.advance(200);
  assert.ok(page.marked("lost").includes("uavs"));
});

test("values unknown at the displayed time are shown as unknown", async () => {
  const page = await openPage({ answers: { "/v1/status": { status: 500, body: "{}" } } });
  await page.time.advance(2 * BEAT_MS);
  delete page.service.answers["/v1/status"];
  page.service.status.rejected = { frozen: 3 };
  await page.time.advance(8 * BEAT_MS);
  assert.deepEqual([page.text("version"), page.text("uptime")], ["v1.2.3", "1\u00a0min 05\u00a0s"]);
  assert.match(page.text("rejections"), /^frozen3/);
  page.press("Home");
  assert.deepEqual(["version", "uptime", "center", "recording", "frames", "rejections"]
    .map(page.text), ["", "–", "–", "–", "–", "–"]);
  page.press("End");
  assert.equal(page.text("uptime"), "1\u00a0min 05\u00a0s");
});

test("beams unknown at the displayed time are not shown", async () => {
  const page = await openPage({ answers: { "/v1/beams": { status: 500, body: "{}" } } });
  await page.time.advance(2 * BEAT_MS);
  delete page.service.answers["/v1/beams"];
  await page.time.advance(4 * BEAT_MS);
  assert.match(page.text("beams-line"), /2 beams/);
  page.press("Home");
  assert.deepEqual(["beams-line", "beams-array"].map(page.text), ["–", "–"]);
  assert.deepEqual(page.cells("azimuth"), ["–", "–"]);
});

test("the scale stays as set by button, key or wheel until Fit", async () => {
  const page = await openPage();
  const fits = () => page.element("zoom-fit").getAttribute("aria-pressed");
  const px = async () => 200 - circles(await page.drawn(), 6)[0].y;
  const before = await px();
  const wheel = (deltaY) => page.element("plan").dispatch("wheel", { deltaY });
  for (const [larger, smaller] of [
    [() => page.press("+"), () => page.press("-")],
    [() => page.element("zoom-in").click(), () => page.element("zoom-out").click()],
    [() => [-30, -30].map(wheel), () => wheel(60)],
  ]) {
    larger();
    await page.time.advance(2000);
    assert.ok(await px() > before && fits() === "false");
    smaller();
    await page.time.advance(2000);
    near(await px(), before);
  }
  page.press("-");
  page.press("0");
  await page.time.advance(2000);
  near(await px(), before);
  assert.equal(fits(), "true");
});

test("the theme changes every canvas", async () => {
  const page = await openPage();
  page.press("t");
  const plan = await page.drawn();
  assert.equal(circles(plan, 6)[0].strokeStyle, page.colour("live"));
  for (const id of ["pattern", "elements"]) {
    const picture = page.element(id).getContext();
    assert.equal(picture.of("rect").filter(({ width }) => width === 400).at(-1).fillStyle,
      page.colour("plan"));
  }
  assert.equal(page.root.dataset.theme, "light");
});
