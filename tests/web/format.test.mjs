// Numbers as the page writes them: the unit, the decimals, and a dash for unknown values.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";

process.env.TZ = "America/Lima"; // five hours off, so that local time would be noticed
const format = await load("format.js");

/** `_` stands for the space that does not break, `,` in counts for the narrow one. */
const plain = (text) => text.replaceAll("\u00a0", "_").replaceAll("\u202f", ",");

const WRITTEN = {
  length: [[0, "0.0_m"], [4.24, "4.2_m"], [99.94, "99.9_m"], [99.96, "100_m"], [-412.3, "−412_m"],
    [9999.4, "9999_m"], [9999.5, "10.0_km"], [123456, "123.5_km"]],
  degrees: [[12.34, "12.3°"], [-0.04, "0.0°"]],
  signedDegrees: [[12.34, "+12.3°"], [-12.36, "−12.4°"], [0, "0.0°"], [-0.01, "0.0°"]],
  speed: [[5, "5.0_m/s"]],
  decibels: [[17.54, "17.5_dB"], [-13.2, "−13.2_dB"]],
  perSecond: [[0, "0.0_/s"], [9.94, "9.9_/s"], [120.4, "120_/s"]],
  bearing: [[0, "000°"], [7.4, "007°"], [359.4, "359°"], [359.6, "000°"], [-90, "270°"],
    [450, "090°"]],
  seconds: [[0.25, "0.25_s"], [9.994, "9.99_s"], [9.996, "10.0_s"], [99.94, "99.9_s"],
    [99.96, "100_s"], [-0.25, "−0.25_s"]],
  milliseconds: [[0.03, "30_ms"], [0.0004, "0_ms"], [1.5, "1500_ms"], [9.9994, "9999_ms"],
    [9.9996, "10.0_s"], [-0.02, "−20_ms"]],
  share: [[0, "0_%"], [0.5, "50_%"], [1, "100_%"]],
  duration: [[0, "0_s"], [59.9, "59_s"], [60, "1_min 00_s"], [185, "3_min 05_s"],
    [3599, "59_min 59_s"], [7620, "2_h 07_min"], [86_400, "1_d 00_h"], [273_600, "3_d 04_h"],
    [-3, "0_s"]],
  bytes: [[0, "0_B"], [999, "999_B"], [1000, "1.0_kB"], [1500, "1.5_kB"], [99_960, "100_kB"],
    [999_499, "999_kB"], [999_500, "1.0_MB"], [2e9, "2.0_GB"], [5e15, "5000_TB"]],
  count: [[0, "0"], [999, "999"], [1000, "1,000"], [12345, "12,345"], [1234567, "1,234,567"]],
  hertz: [[5.8e9, "5.8_GHz"], [28e9, "28_GHz"], [915e6, "915_MHz"], [433.92e6, "433.92_MHz"],
    [50, "50_Hz"]],
};

for (const [name, pairs] of Object.entries(WRITTEN)) {
  test(`${name}: ${pairs.map(([value, text]) => `${value} is ${text}`).join(", ")}`, () => {
    for (const [value, text] of pairs) assert.equal(plain(format[name](value)), text);
  });

  test(`${name}: an unknown value is a dash, never 0`, () => {
    for (const value of [null, undefined, NaN, Infinity, -Infinity, "5"]) {
      assert.equal(format[name](value), "–", `${value}`);
    }
  });
}

test("a number alone: its decimals, its sign, and a dash for none", () => {
  const { fixed } = format;
  assert.deepEqual([fixed(2.345, 2), fixed(-0.6), fixed(-1.6), fixed(7, 1, { signed: true })],
    ["2.35", "−1", "−2", "+7.0"]);
  for (const value of [null, undefined, NaN, Infinity, "5"]) assert.equal(fixed(value, 1), "–");
});

test("two durations share a unit or have one each", () => {
  const range = (from, to) => plain(format.millisecondsRange(from, to));
  assert.equal(range(0.002, 0.005), "2 / 5_ms");
  assert.equal(range(0.5, 9.9), "500 / 9900_ms");
  assert.equal(range(0.5, 12), "500_ms / 12.0_s");
  assert.equal(range(11, 12), "11.0_s / 12.0_s");
  assert.equal(range(null, 0.005), "–");
  assert.equal(range(0.002, undefined), "–");
});

test("a position has five decimals, north and east positive", () => {
  assert.equal(format.position(47.3977, -8.54561), "47.39770°, −8.54561°");
  assert.equal(format.position(null, 8), "–");
  assert.equal(format.position(47, null), "–");
});

test("time of day is the stamp's in UTC, in any browser time zone", () => {
  assert.equal(format.timeOfDay("2026-11-20T13:00:05.9Z"), "13:00:05");
  assert.equal(format.timeOfDay("2026-11-20T13:00:05+02:00"), "11:00:05");
  assert.equal(format.clock("2026-11-20T13:00:05Z"), "13:00:05 UTC");
  for (const stamp of [null, undefined, "", "soon"]) {
    assert.deepEqual([format.timeOfDay(stamp), format.clock(stamp)], ["–", "–"]);
  }
});
