// How far answers may be trusted as time passes without new ones, and what the connection as a
// whole is called.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { Service } from "./service.mjs";

const { LOST_MS, connection, startPolling } = await load("api.js");
const BEAT_MS = 850;

/** Polling that has run for ten seconds, with every feed just requested. */
async function startPage({ mode = "answers", beamed = "1:1" } = {}) {
  const { time } = openBrowser();
  const service = new Service(time);
  service.mode = mode;
  const context = { beamed };
  const feeds = startPolling(() => context, () => {});
  await time.advance(0);
  if (mode === "answers") await time.advance(60 * BEAT_MS - time.now);
  return { time, service, feeds, context, state: () => connection(feeds).state };
}

/** Times in milliseconds at which the health of a feed becomes each of these. */
async function changes(time, feed, untilMs) {
  const found = [];
  for (const start = time.now; time.now - start <= untilMs; await time.advance(10)) {
    const health = feed.health();
    if (found.at(-1)?.[1] !== health) found.push([time.now - start, health]);
  }
  return found;
}

test("a feed is late two seconds after its last response, and lost after three", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  assert.deepEqual(await changes(time, feeds.uavs, 5000), [[0, "live"], [2010, "late"],
    [3010, "lost"]]);
  assert.equal(feeds.uavs.isTrusted(), false);
  assert.notEqual(feeds.uavs.data, null); // the last data is kept, to be struck out
});

test("a slow feed is allowed one more period", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  const periodMs = 4 * BEAT_MS;
  assert.deepEqual(await changes(time, feeds.status, 8000),
    [[0, "live"], [periodMs + 1160, "late"], [periodMs + 2160, "lost"]]);
});

test("a late response is still trusted", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  await time.advance(2500);
  assert.deepEqual([feeds.uavs.health(), feeds.uavs.isTrusted()], ["late", true]);
});

test("a responding service whose time does not advance is frozen", async () => {
  const { time, service, feeds, state } = await startPage();
  service.mode = "frozen";
  await time.advance(BEAT_MS + 3000);
  assert.deepEqual([feeds.uavs.health(), feeds.uavs.isTrusted()], ["frozen", false]);
  assert.equal(state(), "frozen");
  assert.match(connection(feeds).what, /^UAVs, beams/);
  service.mode = "answers";
  await time.advance(5 * BEAT_MS);
  assert.deepEqual([feeds.uavs.health(), state()], ["live", "live"]);
});

test("a service without data yet does not count as stopped", async () => {
  const { time, service, feeds } = await startPage();
  service.answers["/v1/uavs"] = { valid_at: null, uavs: [] };
  await time.advance(10_000);
  assert.equal(feeds.uavs.health(), "live");
});

test("the connection is live while all responses are timely", async () => {
  const { time, feeds, state } = await startPage();
  for (let i = 0; i < 60; i += 1) {
    assert.equal(state(), "live", JSON.stringify(connection(feeds)));
    await time.advance(197);
  }
});

test("it waits for the first responses, then reports no connection", async () => {
  const { time, feeds, state } = await startPage({ mode: "silent" });
  assert.equal(state(), "waiting");
  await time.advance(LOST_MS);
  assert.equal(state(), "waiting");
  await time.advance(10);
  const { state: lost, never, problem, silentS } = connection(feeds);
  assert.deepEqual([lost, never, problem], ["lost", true, "no answer within 2 s"]);
  assert.ok(silentS > 3 && silentS < 3.1);
});

for (const mode of ["silent", "gone"]) {
  test(`a service that is ${mode} is late after 2 s, lost after 3 s, and recovers`, async () => {
    const { time, service, feeds, state } = await startPage();
    service.mode = mode;
    await time.advance(2010);
    assert.equal(state(), "late");
    await time.advance(980);
    assert.notEqual(state(), "lost");
    await time.advance(20);
    const { state: lost, never, silentS } = connection(feeds);
    assert.deepEqual([lost, never], ["lost", false]);
    assert.ok(Math.abs(silentS - 3.01) < 1e-9);
    service.mode = "answers";
    await time.advance(15_000);
    assert.equal(state(), "live");
  });
}

test("a single failing feed is named", async () => {
  const { time, service, feeds } = await startPage();
  service.answers["/v1/beams"] = { status: 500, body: "{}" };
  await time.advance(3100);
  assert.deepEqual(connection(feeds),
    { state: "partial", what: "beams", problem: "the service answered 500" });
  assert.equal(feeds.uavs.health(), "live");
});

test("feeds that are not requested do not affect the connection", async () => {
  const { time, feeds, context, state } = await startPage();
  context.beamed = null;
  await time.advance(10_000);
  assert.deepEqual([feeds.pattern.health(), feeds.pattern.data, state()], ["idle", null, "live"]);
});

test("a failed feed that is no longer requested does not hide a lost connection", async () => {
  const { time, service, feeds, context } = await startPage();
  service.beams = []; // the beam has vanished, and its pattern was just requested
  await time.advance(BEAT_MS);
  assert.equal(feeds.pattern.problem, "the service answered 404");
  context.beamed = null;
  await time.advance(5000);
  assert.equal(feeds.pattern.health(), "idle");
  service.mode = "gone";
  await time.advance(3500);
  assert.equal(connection(feeds).state, "lost");
});
