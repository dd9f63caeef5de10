// How the page asks: when, how often, what is made of answers that fail to come or are not what
// was asked for, and when it asks again.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { Service, beam, uav } from "./service.mjs";

const { startPolling } = await load("api.js");
const BEAT_MS = 850;

/** Polling after the first responses. */
async function startPage({ beamed = "1:1", mode = "answers", answers = {} } = {}) {
  const browser = openBrowser();
  const { time } = browser;
  const service = new Service(time);
  Object.assign(service, { mode, answers });
  const context = { beamed };
  const answered = [];
  const feeds = startPolling(() => context, (name) => answered.push(name));
  await time.advance(0);
  return { browser, time, service, context, feeds, answered };
}

const timesOf = (service, place) =>
  service.asked.filter(({ path }) => path.split("?")[0] === place).map(({ at }) => at);

test("all feeds are requested at once, then each at its rate, five per second in all", async () => {
  const { time, service, answered } = await startPage();
  assert.deepEqual(answered.sort(), ["beams", "events", "links", "pattern", "recordings",
    "status", "uavs", "weights"]);
  await time.advance(60 * BEAT_MS); // until every feed is at its own rate
  const since = time.now;
  await time.advance(60 * BEAT_MS);
  const counts = ["/v1/uavs", "/v1/beams", "/v1/pattern", "/v1/beams/weights", "/v1/status",
    "/v1/links", "/v1/events", "/v1/recordings"].map((place) => service.count(place, since + 1));
  assert.deepEqual(counts, [60, 60, 60, 15, 15, 10, 10, 3]);
  const all = counts.reduce((sum, one) => sum + one);
  assert.ok(all / (60 * BEAT_MS / 1000) <= 5);
});

test("feeds drawn together are requested together", async () => {
  const { time, service } = await startPage();
  await time.advance(10_000);
  const uavs = timesOf(service, "/v1/uavs");
  assert.deepEqual(timesOf(service, "/v1/beams"), uavs);
  assert.deepEqual(timesOf(service, "/v1/pattern"), uavs);
  assert.ok(uavs.slice(1).every((at) => at % BEAT_MS === 0));
});

test("slow feeds are spread: links, events and weights one at a time", async () => {
  const { time, service } = await startPage();
  await time.advance(60_000);
  const [links, events, weights] = ["/v1/links", "/v1/events", "/v1/beams/weights"]
    .map((place) => timesOf(service, place).filter((at) => at > 10_000));
  const all = [...links, ...events, ...weights];
  assert.equal(new Set(all).size, all.length);
  assert.ok(links.length && events.length && weights.length);
});

test("the browser cache is not used: old responses would look new", async () => {
  const { service } = await startPage();
  const asked = service.asked.filter(({ path }) => path.startsWith("/v1/"));
  assert.deepEqual([...new Set(asked.map(({ cache }) => cache))], ["no-store"]);
});

test("a silent service times out after 2 s, with one request at a time", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  await time.advance(BEAT_MS - (time.now % BEAT_MS)); // until it is requested
  await time.advance(1999);
  assert.equal(feeds.uavs.failures, 0);
  await time.advance(1);
  assert.deepEqual([feeds.uavs.failures, feeds.uavs.problem], [1, "no answer within 2 s"]);
  await time.advance(30_000);
  assert.equal(service.mostOpen, 1);
  assert.ok(feeds.uavs.failures > 5);
});

const WRONG = {
  "the service answered 500": { status: 500, body: "{}" },
  "the service answered 503": { status: 503, body: "{}" },
  "the service answered 404": { status: 404, body: "{}" },
  "the answer is not JSON": { body: "<html>" },
  "unexpected answer": { uavs: [{ name: "1:1" }] },
};

for (const [problem, answer] of Object.entries(WRONG)) {
  test(`a malformed response is ignored: ${problem}`, async () => {
    const { time, service, feeds } = await startPage();
    const before = feeds.uavs.data;
    service.answers["/v1/uavs"] = answer;
    await time.advance(BEAT_MS);
    assert.equal(feeds.uavs.data, before);
    assert.deepEqual([feeds.uavs.failures, feeds.uavs.problem], [1, problem]);
    delete service.answers["/v1/uavs"];
    await time.advance(5000);
    assert.deepEqual([feeds.uavs.failures, feeds.uavs.problem], [0, ""]);
    assert.notEqual(feeds.uavs.data, before);
  });
}

test("an empty list is a valid response, a missing one is not", async () => {
  const { time, service, feeds } = await startPage();
  service.uavs = [];
  await time.advance(BEAT_MS);
  assert.deepEqual(feeds.uavs.data.uavs, []);
  service.answers["/v1/uavs"] = { valid_at: "2026-11-20T13:00:09Z" };
  await time.advance(BEAT_MS);
  assert.equal(feeds.uavs.failures, 1);
});

test("an absent service is polled every two seconds only", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "gone";
  await time.advance(BEAT_MS);
  assert.equal(feeds.uavs.problem, "the service cannot be reached");
  const [failedAt] = timesOf(service, "/v1/uavs").slice(-1);
  await time.advance(10_000);
  const after = timesOf(service, "/v1/uavs").filter((at) => at > failedAt);
  assert.deepEqual(after.map((at) => at - failedAt), [1700, 3700, 5700, 7700, 9700]);
});

test("normal polling resumes when the service returns", async () => {
  const { time, service } = await startPage();
  service.mode = "gone";
  await time.advance(10_000);
  service.mode = "answers";
  const since = time.now;
  await time.advance(10_000);
  const asked = timesOf(service, "/v1/uavs").filter((at) => at > since);
  assert.ok(asked[0] - since <= 2000);
  assert.ok(asked.slice(1).every((at) => at % BEAT_MS === 0));
  assert.equal(asked[2] - asked[1], BEAT_MS);
});

test("it polls at once when the network or the page's visibility returns", async () => {
  const { browser, time, service } = await startPage();
  service.mode = "gone";
  await time.advance(10_050);
  service.mode = "answers";
  const wakes = [() => browser.onWindow("online"),
    () => browser.document.dispatch("visibilitychange")];
  for (const wake of wakes) {
    const before = service.count("/v1/uavs");
    wake();
    await time.advance(0);
    assert.equal(service.count("/v1/uavs"), before + 1);
  }
  browser.document.hidden = true;
  const before = service.count("/v1/uavs");
  browser.document.dispatch("visibilitychange");
  await time.advance(0);
  assert.equal(service.count("/v1/uavs"), before);
});

test("the pattern is requested for the selected UAV, with any characters in its id", async () => {
  const { time, service, context } = await startPage({ beamed: null });
  await time.advance(5000);
  assert.equal(service.count("/v1/pattern") + service.count("/v1/beams/weights"), 0);
  service.uavs = [uav("icao:4CA7B3")];
  service.beams = [beam("icao:4CA7B3")];
  context.beamed = "icao:4CA7B3";
  await time.advance(BEAT_MS);
  const { path } = service.asked.find((one) => one.path.startsWith("/v1/pattern"));
  assert.equal(path, "/v1/pattern?points=361&uav=icao%3A4CA7B3");
});
