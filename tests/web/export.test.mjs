// Exports: the values of the table, with units in their names.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { beam, stampAt, uav, weak } from "./service.mjs";
import { openPage } from "./whole_page.mjs";

const { csvOf } = await load("export.js");

test("one line per UAV, unknown values are empty, and commas are quoted", () => {
  const text = csvOf({ stamp: stampAt(0), beams: [beam("1:1"), beam("2:1", { oldS: 3 })],
    uavs: [uav("1:1", weak("weak", { reason: "late, so to say" })), uav("2:1", { alt_m: null })] });
  const [head, one, two, end] = text.split("\n");
  assert.equal(end, "");
  const names = head.split(",");
  assert.deepEqual(names.slice(0, 3), ["valid_at", "id", "verdict"]);
  assert.ok(one.endsWith(',rate,"late, so to say"'), one);
  const second = Object.fromEntries(two.split(",").map((value, i) => [names[i], value]));
  assert.deepEqual([second.id, second.alt_m, second.gain_db, second.lat_deg],
    ["2:1", "", "", "47.0009"]);
});

test("settings are shown, changed ones before defaults", async () => {
  const page = await openPage();
  page.service.answers["/v1/settings"] = { sections: { link: {
    needed_db: { value: 6, default: 0, source: "file", file: "mast.toml" },
    needed_sinr_db: { value: null, default: null, source: "default", file: null },
  }, server: { listen: { value: "[::]:1", default: "[::]:1", source: "option", file: null } } } };
  page.element("settings-open").click();
  await page.time.advance(100);
  assert.equal(page.text("settings-set"), "[link]needed_db6 – from file mast.toml, default 0"
    + "[server]listen[::]:1 – from the option, default [::]:1");
  assert.equal(page.text("settings-default"), "[link]needed_sinr_db–");
  assert.ok(page.element("settings").hasAttribute("open"));
});
