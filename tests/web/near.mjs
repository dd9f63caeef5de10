// Comparison of numbers up to rounding.

import assert from "node:assert/strict";

/** `actual` and `wanted` are numbers, or lists of them, or points {x, y}. */
export function near(actual, wanted, tolerance = 1e-6, what = "") {
  if (Array.isArray(wanted)) {
    assert.equal(actual.length, wanted.length, what);
    wanted.forEach((one, i) => near(actual[i], one, tolerance, `${what}[${i}]`));
  } else if (typeof wanted === "object") {
    near([actual.x, actual.y], [wanted.x, wanted.y], tolerance, what);
  } else {
    assert.ok(Math.abs(actual - wanted) <= tolerance, `${what} ${actual} is not ${wanted}`);
  }
}
