// How the page asks: when, how often, what is made of answers that fail to come or are not what
// was asked for, and when it asks again.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { Service, beam, uav } from "./service.mjs";

const { startPolling } = await load("api.js");
const BEAT_MS = 850;

/** Polling, with the first answers there. */
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

test("everything is asked for at once, then each at its rate, five a second in all", async () => {
  const { time, service, answered } = await startPage();
  assert.deepEqual(answered.sort(), ["beams", "events", "links", "pattern", "readyz",
    "recordings", "status", "uavs", "weights"]);
  await time.advance(60 * BEAT_MS); // until everything is in its beat
  const since = time.now;
  await time.advance(60 * BEAT_MS);
  const counts = ["/v1/uavs", "/v1/beams", "/v1/pattern", "/v1/beams/weights", "/v1/status",
    "/readyz", "/v1/links", "/v1/events", "/v1/recordings"].map((place) => service.count(place, since + 1));
  assert.deepEqual(counts, [60, 60, 60, 15, 15, 20, 10, 10, 3]);
  const all = counts.reduce((sum, one) => sum + one);
  assert.ok(all / (60 * BEAT_MS / 1000) <= 5);
});

test("what is drawn together is asked for at the same moment", async () => {
  const { time, service } = await startPage();
  await time.advance(10_000);
  const uavs = timesOf(service, "/v1/uavs");
  assert.deepEqual(timesOf(service, "/v1/beams"), uavs);
  assert.deepEqual(timesOf(service, "/v1/pattern"), uavs);
  assert.ok(uavs.slice(1).every((at) => at % BEAT_MS === 0));
});

test("slow answers are spread: of links, events and weights one at a time", async () => {
  const { time, service } = await startPage();
  await time.advance(60_000);
  const [links, events, weights] = ["/v1/links", "/v1/events", "/v1/beams/weights"]
    .map((place) => timesOf(service, place).filter((at) => at > 10_000));
  const all = [...links, ...events, ...weights];
  assert.equal(new Set(all).size, all.length);
  assert.ok(links.length && events.length && weights.length);
});

test("nothing is taken from the browser's store: old answers would look new", async () => {
  const { service } = await startPage();
  const asked = service.asked.filter(({ path }) => path.startsWith("/v1/"));
  assert.deepEqual([...new Set(asked.map(({ cache }) => cache))], ["no-store"]);
});

test("a service that says nothing is given up after 2 s, and asked once at a time", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  await time.advance(BEAT_MS - (time.now % BEAT_MS)); // until it is asked
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
  test(`a wrong answer is none: ${problem}`, async () => {
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

test("an empty list is an answer, a missing one is none", async () => {
  const { time, service, feeds } = await startPage();
  service.uavs = [];
  await time.advance(BEAT_MS);
  assert.deepEqual(feeds.uavs.data.uavs, []);
  service.answers["/v1/uavs"] = { valid_at: "2026-11-20T13:00:09Z" };
  await time.advance(BEAT_MS);
  assert.equal(feeds.uavs.failures, 1);
});

test("not to be ready is an answer", async () => {
  const { feeds } = await startPage({
    answers: { "/readyz": { status: 503, body: '{"ready": false, "reasons": ["no link"]}' } },
  });
  assert.deepEqual(feeds.readyz.data, { ready: false, reasons: ["no link"] });
});

test("while the service is gone it is asked less often, every two seconds", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "gone";
  await time.advance(BEAT_MS);
  assert.equal(feeds.uavs.problem, "the service cannot be reached");
  const [failedAt] = timesOf(service, "/v1/uavs").slice(-1);
  await time.advance(10_000);
  const after = timesOf(service, "/v1/uavs").filter((at) => at > failedAt);
  assert.deepEqual(after.map((at) => at - failedAt), [1700, 3700, 5700, 7700, 9700]);
});

test("once it is back the beat is taken up again", async () => {
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

test("when the network comes back, or the page is looked at again, it asks at once", async () => {
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

test("the pattern is asked for the UAV that is looked at, whatever is in its name", async () => {
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
