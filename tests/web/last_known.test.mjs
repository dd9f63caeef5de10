// When the carrier or a beam is not known any more, the last picture stays, grey, with its age, and
// the cause stands there in the same words everywhere.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { circles } from "./plan_picture.mjs";
import { LAT, LON, stampAt, statusAnswer, uav, weak } from "./service.mjs";
import { BEAT_MS, openPage } from "./whole_page.mjs";

const { LastKnown, carrierOf, placedBy } = await load("last_known.js");
const CAUSE = "the attitude of the carrier 5:1 is too old";
const lastPose = (fields = {}) => ({
  at: stampAt(0), lat_deg: LAT, lon_deg: LON, alt_m: 450, heading_deg: 90, ...fields,
});

/** The service's responses while the carrier is unknown. */
function loseCarrier(service, behind = null) {
  const { answer } = service;
  service.beams = [];
  service.uavs = service.uavs.map(({ id }) => uav(id, {
    north_m: null, east_m: null, down_m: null, ...weak("none", { cause: "carrier", reason: CAUSE }),
  }));
  const center = { ...statusAnswer().center, lat_deg: null, lon_deg: null, heading_deg: null,
    age_s: null, unfit: CAUSE, last_known: lastPose() };
  service.status = statusAnswer({ center, health: { ...statusAnswer().health, behind } });
  service.answer = (path) => {
    const found = answer.call(service, path);
    return path === "/v1/beams" ? { ...found, unfit: CAUSE } : found;
  };
}

test("the carrier is at its present or last known position, with the reason", () => {
  const center = { ...statusAnswer().center, lat_deg: null, unfit: CAUSE, last_known: lastPose() };
  const status = statusAnswer({ center, time: stampAt(12) });
  assert.deepEqual(carrierOf(statusAnswer()).ageS, null);
  const { lat_deg: lat, heading_deg: heading, ageS, unfit } = carrierOf(status);
  assert.deepEqual([lat, heading, ageS, unfit], [LAT, 90, 12, CAUSE]);
  assert.deepEqual(carrierOf({ ...status, center: { ...center, last_known: null } }),
    { unfit: CAUSE, unseen: true });
  assert.equal(carrierOf(null), null);
  const late = { ...status, health: { behind: "this machine is overloaded" } };
  assert.equal(carrierOf(late).unfit, "this machine is overloaded");
});

test("a UAV without an offset is placed from the carrier's last position", () => {
  const placed = placedBy(uav("1:1", { north_m: null, east_m: null, down_m: null }), lastPose());
  assert.ok(Math.abs(placed.north_m - 100) < 0.2, placed.north_m);
  assert.deepEqual([placed.east_m, placed.down_m], [0, -50]);
  const known = uav("1:1");
  assert.equal(placedBy(known, lastPose()), known);
});

test("without the carrier the last view stays, with its age and the same cause", async () => {
  const page = await openPage();
  const range = page.cells("range")[0];
  loseCarrier(page.service);
  await page.time.advance(10_000);
  const plan = await page.drawn();
  plan.text("1:1".replace("1", "✕ 1"));
  plan.text(`${CAUSE}:`);
  assert.ok(plan.texts.some((text) => text.startsWith("carrier and beams from ")), plan.texts.join());
  assert.deepEqual(page.cells("range"), [range, range]);
  assert.deepEqual(page.cells("gain"), ["17.5 dB", "17.5 dB"]);
  const cell = page.document.querySelector("td[data-key=gain]");
  assert.ok(cell.hasAttribute("data-old"));
  assert.match(cell.title, /^Value from \d+.s ago$/);
  assert.match(page.text("troubles"), new RegExp(CAUSE));
  assert.match(page.text("center"), new RegExp(CAUSE));
  assert.match(page.document.querySelector(".focus-uav").textContent, /^1:1, as \d+.s ago$/);
});

test("the last weights of a beam are kept, and never used for another beam", () => {
  const last = new LastKnown();
  const [pattern, weights] = [{ patterns: [{ uav: "1:1" }, { uav: "2:1" }] }, { uavs: ["1:1"] }];
  const note = (uav, found) => last.note({ uavs: [], beams: [], pattern, ...found }, uav, 0);
  note("1:1", { weights });
  assert.equal(last.picture.weights, weights);
  for (const none of [null, { uavs: [] }]) {
    note("1:1", { weights: none });
    assert.equal(last.picture.weights, weights);
  }
  note("2:1", { weights });
  assert.equal(last.picture.weights, null);
});

test("on an overloaded machine the overload is the cause, not an old attitude", async () => {
  const page = await openPage();
  loseCarrier(page.service, "this machine is overloaded: frames wait up to 7.0 s");
  await page.time.advance(8 * BEAT_MS);
  const plan = await page.drawn();
  assert.ok(plan.texts.some((text) => text.startsWith("this machine is overloaded")), "on the plan");
  assert.ok(!plan.texts.some((text) => text.startsWith(CAUSE)), "no other cause");
  assert.doesNotMatch(page.text("center"), new RegExp(CAUSE));
});

test("before the carrier is known, UAVs are drawn around the first position", async () => {
  const page = await openPage();
  loseCarrier(page.service);
  const { center } = page.service.status;
  page.service.status = { ...page.service.status, center: { ...center, last_known: null } };
  await page.time.advance(3 * BEAT_MS);
  const plan = await page.drawn();
  plan.text("✕ 1:1");
  plan.text("✕ 2:1");
  assert.equal(circles(plan, 6).length, 2, "both UAVs");
  assert.equal(circles(plan, 9).length, 0, "no carrier");
  const last = new LastKnown();
  const uavs = [uav("1:1", { lat_deg: null }), uav("2:1")];
  assert.equal(last.middle({ unseen: true }, uavs), uavs[1]);
  assert.equal(last.middle({ unseen: true }, []), uavs[1], "it stays where it was");
  assert.equal(last.middle(center, uavs), center);
  assert.equal(last.middle(null, uavs), null, "without news of the carrier nothing is moved");
});
