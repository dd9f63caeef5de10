// How far answers may be trusted as time passes without new ones, and what the connection as a
// whole is called.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { Service } from "./service.mjs";

const { LOST_MS, connection, startPolling } = await load("api.js");
const BEAT_MS = 850;

/** Polling that has run for ten seconds, and whose feeds have all been asked just now. */
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

/** When, in milliseconds, the health of a feed becomes each of these. */
async function changes(time, feed, untilMs) {
  const found = [];
  for (const start = time.now; time.now - start <= untilMs; await time.advance(10)) {
    const health = feed.health();
    if (found.at(-1)?.[1] !== health) found.push([time.now - start, health]);
  }
  return found;
}

test("an answer is late after two seconds without another, and lost after three", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  assert.deepEqual(await changes(time, feeds.uavs, 5000), [[0, "live"], [2010, "late"],
    [3010, "lost"]]);
  assert.equal(feeds.uavs.isTrusted(), false);
  assert.notEqual(feeds.uavs.data, null); // what was known last is kept, to be struck
});

test("a slow answer is given its own period more", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  const periodMs = 4 * BEAT_MS;
  assert.deepEqual(await changes(time, feeds.status, 8000),
    [[0, "live"], [periodMs + 1160, "late"], [periodMs + 2160, "lost"]]);
});

test("an answer that is late is still trusted", async () => {
  const { time, service, feeds } = await startPage();
  service.mode = "silent";
  await time.advance(2500);
  assert.deepEqual([feeds.uavs.health(), feeds.uavs.isTrusted()], ["late", true]);
});

test("a service whose time stands still is frozen, though it answers", async () => {
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

test("a service that has nothing to tell yet has not stopped", async () => {
  const { time, service, feeds } = await startPage();
  service.answers["/v1/uavs"] = { valid_at: null, uavs: [] };
  await time.advance(10_000);
  assert.equal(feeds.uavs.health(), "live");
});

test("while all is well the connection is live", async () => {
  const { time, feeds, state } = await startPage();
  for (let i = 0; i < 60; i += 1) {
    assert.equal(state(), "live", JSON.stringify(connection(feeds)));
    await time.advance(197);
  }
});

test("until the first answers it waits, and then says that there is no connection", async () => {
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
  test(`a service that is ${mode} is late after 2 s, lost after 3 s, and heals`, async () => {
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

test("where one answer alone fails, it is named", async () => {
  const { time, service, feeds } = await startPage();
  service.answers["/v1/beams"] = { status: 500, body: "{}" };
  await time.advance(3100);
  assert.deepEqual(connection(feeds),
    { state: "partial", what: "beams", problem: "the service answered 500" });
  assert.equal(feeds.uavs.health(), "live");
});

test("what there is nothing to ask about is no part of the connection", async () => {
  const { time, feeds, context, state } = await startPage();
  context.beamed = null;
  await time.advance(10_000);
  assert.deepEqual([feeds.pattern.health(), feeds.pattern.data, state()], ["idle", null, "live"]);
});

test("a question that failed and is no longer asked hides no lost connection", async () => {
  const { time, service, feeds, context } = await startPage();
  service.beams = []; // the beam is gone, and its pattern was just asked for
  await time.advance(BEAT_MS);
  assert.equal(feeds.pattern.problem, "the service answered 404");
  context.beamed = null;
  await time.advance(5000);
  assert.equal(feeds.pattern.health(), "idle");
  service.mode = "gone";
  await time.advance(3500);
  assert.equal(connection(feeds).state, "lost");
});
