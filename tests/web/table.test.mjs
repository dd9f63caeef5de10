// The table of UAVs: which value is in which cell, what is warned of, and that a row stays the
// same element while its UAV does, so that focus and selection stay.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { array, beam, uav, weak } from "./service.mjs";

const { UavTable } = await load("table.js");
const plain = (text) => text.replaceAll("\u00a0", " ");

function openTable() {
  const browser = openBrowser();
  const chosen = [];
  const element = browser.element("uavs");
  const table = new UavTable(element, (id) => chosen.push(id));
  const body = element.querySelector("tbody");
  return {
    browser, element, table, chosen,
    rows: () => body.rows,
    ids: () => body.rows.map((row) => row.querySelector(".pick").textContent),
    show(uavs, { beams = [], sinceS = 0, selected = null, array: fields = {} } = {}) {
      table.update(uavs, {
        beams: new Map(beams.map((one) => [one.uav, one])), array: array(fields), sinceS, selected,
      });
    },
    cell: (key, row = 0) => body.rows[row].querySelector(`[data-key=${key}]`),
    texts(row = 0) {
      return Object.fromEntries(body.rows[row].querySelectorAll("td")
        .map((cell) => [cell.dataset.key, plain(cell.textContent)]));
    },
  };
}

test("every value is in its own column, with its unit", () => {
  const { show, texts } = openTable();
  show([uav("1:1", {
    state: "coasting", north_m: 30, east_m: -40, down_m: -120, speed_mps: 5.25, age_s: 0.5,
    dt_s: 0.25, latency_s: 0.03, bound_m: 4.2, error_p95_m: 0.75,
  })], { beams: [beam("1:1", {
    azimuth_deg: -12.5, elevation_deg: 8, pointing_bound_deg: 1.25, gain_db: 17.5,
    guaranteed_gain_db: 15.2,
  })] });
  assert.deepEqual(texts(), {
    verdict: "good", state: "coasting", range: "130 m", azimuth: "−12.5°", elevation: "+8.0°", speed: "5.3 m/s",
    age: "0.50 s", dt: "0.25 s", latency: "30 ms", bound: "4.2 m", usual: "0.8 m", pointing: "1.25°",
    gain: "17.5 dB", guaranteed: "15.2 dB",
  });
});

test("every column has a header, and cells name their feed", () => {
  const { element, show, rows } = openTable();
  show([uav("1:1")]);
  const heads = element.querySelectorAll("thead th").map((cell) => cell.dataset.key);
  const cells = rows()[0].children.map((cell) => cell.dataset.key ?? "id");
  assert.deepEqual(heads, cells);
  const onBeams = rows()[0].querySelectorAll("[data-feed=beams]").map(({ dataset }) => dataset.key);
  assert.deepEqual(onBeams, ["azimuth", "elevation", "pointing", "gain"]);
  assert.equal(rows()[0].querySelectorAll("[data-feed=uavs]").length, cells.length - 4);
});

test("unknown values are dashes: without a beam, without a position", () => {
  const { show, texts } = openTable();
  show([uav("1:1", { north_m: null, speed_mps: null, age_s: null, dt_s: null, latency_s: null,
    health: null })]);
  assert.deepEqual(texts(), {
    verdict: "good", state: "live", range: "–", azimuth: "–", elevation: "–", speed: "–", age: "–", dt: "–",
    latency: "–", bound: "4.2 m", usual: "–", pointing: "–", gain: "–", guaranteed: "–",
  });
});

test("ages grow without responses, with a warning above two seconds", () => {
  const { show, cell, rows } = openTable();
  show([uav("1:1", { age_s: 0.5 })], { sinceS: 1.5 });
  assert.equal(plain(cell("age").textContent), "2.00 s");
  assert.ok(cell("age").dataset.level === "" && !rows()[0].hasAttribute("data-old"));
  show([uav("1:1", { age_s: 0.5 })], { sinceS: 1.6 });
  assert.equal(plain(cell("age").textContent), "▲ 2.10 s");
  assert.ok(cell("age").dataset.level === "warn" && rows()[0].hasAttribute("data-old"));
  show([uav("1:1", { age_s: null })], { sinceS: 9 });
  assert.ok(cell("age").dataset.level === "" && !rows()[0].hasAttribute("data-old"));
});

test("a bound whose assumptions were refuted is marked", () => {
  const { show, cell } = openTable();
  show([uav("1:1", { assumptions: { limits_source: "raised" } })]);
  assert.deepEqual([plain(cell("bound").textContent), cell("bound").dataset.level],
    ["▲ 4.2 m", "warn"]);
  show([uav("1:1", { assumptions: { limits_source: "type" } })]);
  assert.deepEqual([plain(cell("bound").textContent), cell("bound").dataset.level], ["4.2 m", ""]);
});

test("a pointing bound above half the beamwidth is explained", () => {
  const { show, cell } = openTable();
  const shown = (fields, width = 10) => {
    show([uav("1:1")], { beams: [beam("1:1", fields)],
      array: { half_power_beamwidth_deg: width } });
    return [cell("pointing").textContent, cell("pointing").title];
  };
  assert.deepEqual(shown({ pointing_bound_deg: 5 }), ["5.00°", ""]);
  assert.match(shown({ pointing_bound_deg: 5.01 })[1], /may miss/);
  assert.match(shown({ pointing_bound_deg: 5.01, widened: true })[1], /is widened/);
  assert.deepEqual(shown({ pointing_bound_deg: 50 }, null), ["50.00°", ""]);
  assert.match(shown({ pointing_bound_deg: null })[1], /anywhere/);
});

test("a beam without any guaranteed gain is explained", () => {
  const { show, cell } = openTable();
  const unsure = { health: { needed_gain_db: 0, guaranteed_gain_db: null, likely_gain_db: 17 } };
  show([uav("1:1", unsure)], { beams: [beam("1:1")] });
  assert.equal(cell("guaranteed").textContent, "–");
  assert.match(cell("guaranteed").title, /No guarantee/);
  show([uav("1:1", unsure)]);
  assert.deepEqual([cell("guaranteed").textContent, cell("guaranteed").title], ["–", ""]);
});

test("a row shows its verdict, reason and remedy", () => {
  const { show, cell, rows } = openTable();
  show([uav("1:1", weak()), uav("2:1")]);
  assert.deepEqual([cell("verdict").textContent, cell("verdict").title, rows()[0].dataset.verdict],
    ["weak", "reports 1.1 s apart. To do: ask for 10 Hz", "weak"]);
  assert.match(cell("verdict", 1).title, /at least the 6.0 dB/);
  show([uav("3:1", { verdict: null, health: null })]);
  assert.deepEqual([cell("verdict").textContent, cell("verdict").title], ["–", ""]);
});

test("each UAV has its own beam", () => {
  const { show, texts } = openTable();
  show([uav("1:1"), uav("2:1")], { beams: [beam("2:1", { azimuth_deg: 20 }),
    beam("1:1", { azimuth_deg: 10 })] });
  assert.deepEqual([texts(0).azimuth, texts(1).azimuth], ["+10.0°", "+20.0°"]);
});

test("rows stay the same elements in the selected order", () => {
  const { show, rows, ids } = openTable();
  show([uav("2:1"), uav("10:1")]);
  const [two, ten] = rows();
  show([uav("1:1"), uav("2:1"), uav("10:1")]);
  assert.deepEqual(ids(), ["1:1", "2:1", "10:1"]);
  assert.deepEqual(rows().slice(1), [two, ten]);
  show([uav("10:1", weak()), uav("1:1")]);
  assert.deepEqual(ids(), ["10:1", "1:1"]);
  assert.equal(rows()[0], ten);
  show([]);
  assert.deepEqual(ids(), []);
});

test("a row shows its UAV's state and whether it is selected", () => {
  const { show, rows } = openTable();
  show([uav("1:1", { state: "lost" }), uav("2:1")], { selected: "2:1" });
  const shown = () => rows().map((row) => [row.dataset.state, row.hasAttribute("data-selected"),
    row.querySelector(".pick").getAttribute("aria-pressed")]);
  assert.deepEqual(shown(), [["lost", false, "false"], ["live", true, "true"]]);
  show([uav("1:1"), uav("2:1")], { selected: "1:1" });
  assert.deepEqual(shown(), [["live", true, "true"], ["live", false, "false"]]);
});

test("a click on a name selects that UAV, and a selected row can be scrolled into view", () => {
  const { show, rows, chosen, table } = openTable();
  show([uav("1:1"), uav("2:1")]);
  rows()[1].querySelector(".pick").click();
  assert.deepEqual(chosen, ["2:1"]);
  table.reveal("2:1");
  table.reveal("9:9");
  assert.deepEqual(rows().map(({ isRevealed = false }) => isRevealed), [false, true]);
});

test("a header sorts ascending, descending, then worst first; unknown values come last", () => {
  const { show, ids, element } = openTable();
  const uavs = [uav("1:1", { speed_mps: 5 }), uav("2:1", { speed_mps: null }),
    uav("3:1", { speed_mps: 1, ...weak() }), uav("10:1", { speed_mps: 9 })];
  const head = (key) => element.querySelectorAll("thead th")
    .find(({ dataset }) => dataset.key === key);
  const sorted = (key) => {
    head(key).querySelector("button").click();
    show(uavs);
    return [ids().join(" "), head(key).getAttribute("aria-sort")];
  };
  show(uavs);
  assert.deepEqual(ids(), ["3:1", "1:1", "2:1", "10:1"]);
  assert.deepEqual(sorted("speed"), ["3:1 1:1 10:1 2:1", "ascending"]);
  assert.deepEqual(sorted("speed"), ["10:1 1:1 3:1 2:1", "descending"]);
  assert.deepEqual(sorted("speed"), ["3:1 1:1 2:1 10:1", "none"]);
  assert.deepEqual(sorted("id"), ["1:1 2:1 3:1 10:1", "ascending"]);
});

test("UAVs can be searched, and good ones hidden", () => {
  const { show, ids, browser } = openTable();
  const uavs = ["1:1", "2:1", "3:1", "4:1", "5:1", "6:1"].map((id) => uav(id));
  show(uavs);
  assert.equal(browser.element("find").hidden, true);
  const many = [...uavs, uav("7:1", weak()), uav("icao:4CA7B3", { callsign: "SWR12A" })];
  show(many);
  assert.equal(browser.element("find").hidden, false);
  const found = (text) => {
    browser.element("search").value = text;
    show(many);
    return ids();
  };
  assert.deepEqual(found("swr"), ["icao:4CA7B3"]);
  assert.deepEqual(found("1.1 s"), ["7:1"]);
  assert.equal(found("").length, 8);
  browser.element("only-bad").checked = true;
  assert.deepEqual(found(""), ["7:1"]);
});
