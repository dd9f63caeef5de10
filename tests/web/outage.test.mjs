// What the page says after a gap: from when to when, and whether the service restarted.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { stampAt } from "./service.mjs";

const { Outage } = await load("outage.js");

function openOutage() {
  const { element, text } = openBrowser();
  const outage = new Outage();
  return {
    element, text,
    /** Answers at a time of the service, whose clock is that of the page plus a constant. */
    answer(second, uptimeS, fields = {}) {
      outage.noteUavs(stampAt(second), second * 1000);
      outage.noteStatus({ time: stampAt(second), uptime_s: uptimeS, ...fields }, second * 1000);
    },
    /** Answers with the status alone, at another time of the page. */
    status(second, uptimeS, pageSecond) {
      outage.noteStatus({ time: stampAt(second), uptime_s: uptimeS }, pageSecond * 1000);
    },
    shown: () => [text("outage-title"), text("outage-detail").replaceAll("\u00a0", " ")],
  };
}

test("nothing is shown while answers arrive", () => {
  const { element, answer } = openOutage();
  for (const second of [0, 1, 2, 4]) answer(second, 100 + second);
  assert.ok(element("outage").hidden);
});

test("after a lost connection the gap is named, until it is acknowledged", () => {
  const { element, answer, shown } = openOutage();
  answer(1, 101);
  answer(21, 121);
  assert.deepEqual(shown(), ["CONNECTION RESTORED",
    "No data from 13:00:01 to 13:00:21 UTC (20 s). The service did not restart."]);
  answer(22, 122);
  assert.equal(element("outage").hidden, false);
  element("outage-seen").click();
  assert.ok(element("outage").hidden);
});

test("a restart is named with its time, also a quick one", () => {
  const { answer, shown } = openOutage();
  answer(1, 101);
  answer(31, 10);
  assert.deepEqual(shown(), ["SERVICE RESTARTED at 13:00:21 UTC",
    "No data from 13:00:01 to 13:00:31 UTC (30 s). Tracks and counts began again."]);
  const quick = openOutage();
  quick.answer(1, 101);
  quick.answer(3, 1);
  assert.equal(quick.shown()[0], "SERVICE RESTARTED at 13:00:02 UTC");
});

test("answers that come late, and a clock that is set, are no restart", () => {
  const { element, status, shown } = openOutage();
  status(1, 101, 1);
  status(2, 102, 5); // over a slow link
  status(6, 106, 6);
  status(67, 107, 7); // the service's clock was set
  assert.ok(element("outage").hidden);
  status(97, 10, 37);
  assert.equal(shown()[0], "SERVICE RESTARTED at 13:01:27 UTC");
});
