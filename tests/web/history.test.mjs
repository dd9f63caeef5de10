// History of the page: at most five minutes, bounded in size, found by time.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { stampAt, uav } from "./service.mjs";

const { History, KEEP_MS, momentsOf } = await load("history.js");

function historyAt(...times) {
  const history = new History();
  for (const at of times) history.add({ at, stamp: `t${at}`, uavs: [uav("1:1")] });
  return history;
}

const timesOf = (moments) => moments.map(({ at }) => at);

test("entries are kept for five minutes", () => {
  assert.equal(KEEP_MS, 5 * 60 * 1000);
  assert.deepEqual(timesOf(historyAt(0, 1000, KEEP_MS).moments), [0, 1000, KEEP_MS]);
  assert.deepEqual(timesOf(historyAt(0, 1000, KEEP_MS + 1).moments), [1000, KEEP_MS + 1]);
  assert.deepEqual(timesOf(historyAt(0, 5 * KEEP_MS).moments), [5 * KEEP_MS]);
});

test("with many UAVs the history is shorter but always holds the newest", () => {
  const history = new History();
  const many = Array.from({ length: 10_000 }, (_, i) => uav(`${i}:1`));
  for (const at of [1, 2, 3, 4]) history.add({ at, uavs: many });
  assert.deepEqual(timesOf(history.moments), [2, 3, 4]);
  history.add({ at: 5, uavs: [...many, ...many, ...many, ...many] });
  assert.deepEqual(timesOf(history.moments), [5]);
  history.add({ at: 6, uavs: [] });
  history.add({ at: 7, uavs: many });
  assert.deepEqual(timesOf(history.moments), [6, 7]);
});

test("a time selects the newest entry not after it, or the oldest", () => {
  const history = historyAt(100, 200, 300);
  const found = (at) => history.at(at).at;
  assert.deepEqual([0, 100, 199, 200, 299, 300, 999].map(found),
    [100, 100, 100, 200, 200, 300, 300]);
  assert.equal(history.newest.at, 300);
});

test("an empty history has no entry", () => {
  const history = new History();
  assert.deepEqual([history.newest, history.at(5), history.stepFrom({ at: 5 }, -1)],
    [null, null, null]);
  assert.deepEqual(history.between(0, 10), []);
});

test("steps go to the adjacent entry and stop at the ends", () => {
  const history = historyAt(100, 200, 300);
  const [oldest, middle, newest] = history.moments;
  assert.equal(history.stepFrom(middle, -1), oldest);
  assert.equal(history.stepFrom(middle, 1), newest);
  assert.equal(history.stepFrom(newest, 1), newest);
  assert.equal(history.stepFrom(oldest, -1), oldest);
});

test("steps from a dropped entry continue from the oldest", () => {
  const history = historyAt(100, 200, 300);
  assert.equal(history.stepFrom({ at: 5 }, 1).at, 100);
  assert.equal(history.stepFrom({ at: 5 }, -1).at, 100);
});

test("a time range excludes its start and includes its end", () => {
  const history = historyAt(100, 200, 300);
  assert.deepEqual(timesOf(history.between(100, 300)), [200, 300]);
  assert.deepEqual(timesOf(history.between(99, 299)), [100, 200]);
});

test("an entry holds its UAVs by id, without values that are never shown", () => {
  const history = new History();
  history.add({ at: 1, uavs: [uav("1:1", { rejected: { frozen: 1 } }), uav("2:1")], beams: "b" });
  const { byId, uavs, beams } = history.newest;
  assert.deepEqual([...byId.keys()], ["1:1", "2:1"]);
  assert.equal(byId.get("2:1"), uavs[1]);
  assert.equal(beams, "b");
  for (const name of ["rejected", "recent_rejections", "clock"]) assert.ok(!(name in uavs[0]));
  assert.ok("fix" in uavs[0] && "velocity_ned_mps" in uavs[0]);
});

const sampled = (seconds, fields = {}) => {
  const column = (value) => seconds.map(() => value);
  return {
    valid_at: stampAt(seconds.at(-1) + 0.5), at: seconds.map(stampAt),
    carrier: { lat_deg: column(47), lon_deg: column(8), alt_m: column(450), heading_deg: column(90) },
    uavs: { "1:1": {
      state: column("live"), verdict: column("weak"), lat_deg: column(47.001), lon_deg: column(8),
      alt_m: column(500), age_s: column(0.2), innovation_m: column(1), latency_s: column(0.03),
      horizontal_bound_m: column(3), azimuth_deg: column(12), pointing_bound_deg: column(2),
      guaranteed_gain_db: column(null), gain_db: column(17), ...fields,
    } },
  };
};

test("samples of the service fill the time before, and gaps", () => {
  const history = historyAt(10_000, 11_000, 20_000);
  history.fill(momentsOf(sampled([1, 2, 10.2, 14, 19.5]), 20_500));
  // The newest sample is half a second old when it arrives: 19.5 s is this page's 20 s.
  assert.deepEqual(timesOf(history.moments), [1500, 2500, 10_000, 11_000, 14_500, 20_000]);
  const [{ uavs: [{ id, verdict, target }], beams: [beam], carrier, isSampled }] = history.moments;
  assert.deepEqual([id, verdict, target, isSampled], ["1:1", "weak", true, true]);
  assert.deepEqual([beam.uav, beam.azimuth_deg, beam.pointing_bound_deg], ["1:1", 12, 2]);
  assert.deepEqual([carrier.lat_deg, carrier.unfit], [47, null]);
});

test("a UAV is only in the samples in which it was tracked, and has a beam only if it had one", () => {
  const [before, after] = momentsOf(sampled([1, 2], {
    state: [null, "stale"], azimuth_deg: [null, null],
  }), 3000);
  assert.deepEqual([before.uavs.length, after.uavs.length, after.beams], [0, 1, []]);
  const unknown = sampled([1]);
  unknown.carrier.lat_deg = [null];
  assert.ok(momentsOf(unknown, 3000)[0].carrier.unseen);
});
