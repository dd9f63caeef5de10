// Everything that is words: the banner and the chips, the center, the recording, a replay, the
// rejections, the beams.

import assert from "node:assert/strict";
import { test } from "node:test";

import { LABELS, load, openBrowser } from "./browser.mjs";
import { array, beam, beamsAnswer, stampAt, statusAnswer } from "./service.mjs";

const REASONS = LABELS.enumerations.Reason;
const panels = await load("panels.js");
const plain = (text) => text.replaceAll("\u00a0", " ").replaceAll("\u202f", ",");

/** `text` and `level` of what has an id, null while it is hidden. */
function openPanels() {
  const { element } = openBrowser();
  return {
    text: (id) => (element(id).hidden ? null : plain(element(id).textContent)),
    level: (id) => element(id).dataset.level,
    lines: (id) => element(id).children.map((line) => line.children
      .map((part) => plain(part.textContent)).join(" | ") || plain(line.textContent)),
    element,
  };
}

test("a good connection shows no banner and one status chip", () => {
  const { text, level } = openPanels();
  for (const [state, chip, wanted] of [["waiting", "connecting…", "wait"],
    ["live", "connected", "good"], ["late", "answers are late", "warn"]]) {
    panels.showConnection({ state }, stampAt(0));
    assert.deepEqual([text("banner"), text("connection"), level("connection")],
      [null, chip, wanted]);
  }
});

test("a bad connection shows a banner with its start and reason", () => {
  const { text, level } = openPanels();
  for (const [link, chip, title, detail] of [
    [{ state: "lost", silentS: 65.2, problem: "no answer within 2 s" }, "connection lost",
      "CONNECTION LOST", /for 1 min 05 s \(no answer within 2 s\)\. All values are from 13:00:07 UTC/],
    [{ state: "lost", never: true, silentS: 3, problem: "the service cannot be reached" },
      "not connected", "No connection", /No answer from the service yet \(the service cannot be reached\)/],
    [{ state: "partial", what: "beams, pattern", problem: "the service answered 500" },
      "some requests fail", "CONNECTION FAILING",
      /No answer for beams, pattern \(the service answered 500\)/],
    [{ state: "frozen", what: "UAVs" }, "estimates stopped", "ESTIMATES STOPPED",
      /has stopped at 13:00:07 UTC \(UAVs\)/],
  ]) {
    panels.showConnection(link, stampAt(7));
    assert.deepEqual([text("connection"), level("connection"), text("banner-title")],
      [chip, "bad", title]);
    assert.match(text("banner-detail"), detail);
    assert.notEqual(text("banner"), null);
  }
  const late = { state: "partial", what: "beams", problem: "no answer within 2 s" };
  panels.showConnection(late, stampAt(7), "this machine is overloaded: frames wait up to 2.0 s");
  assert.match(text("banner-detail"), /for beams \(this machine is overloaded: frames wait up to 2\.0 s/);
  for (const state of ["live", "token"]) { // the dialog says the latter
    panels.showConnection({ state }, stampAt(8));
    assert.equal(text("banner"), null);
  }
  assert.deepEqual([text("connection"), level("connection")], ["token needed", "warn"]);
});

test("a fault of the page itself is reported", () => {
  const { text } = openPanels();
  panels.showFault(new Error("no such thing"));
  assert.equal(text("banner-title"), "DISPLAY FAULT");
  assert.match(text("banner-detail"), /no such thing.*reload/);
});

test("readiness is shown, with the reason if not ready", () => {
  const { text, level } = openPanels();
  for (const [answer, chip, wanted, reasons] of [
    [null, "readiness –", "wait", null], [{ not_ready: [] }, "ready", "good", null],
    [{ not_ready: ["no link is up", "no carrier"] }, "not ready", "warn",
      "Not ready: no link is up; no carrier"],
  ]) {
    panels.showReadiness(answer);
    assert.deepEqual([text("readiness"), level("readiness"), text("reasons")],
      [chip, wanted, reasons]);
  }
});

test("service summary: version, uptime, rates", () => {
  const { text } = openPanels();
  panels.showStatus(statusAnswer());
  assert.deepEqual(["version", "uptime", "frames", "updates"].map(text),
    ["v1.2.3", "1 min 05 s", "120 /s", "20 /s"]);
});

test("the center shows position and heading, with a warning if old or unknown", () => {
  const { text, level } = openPanels();
  const show = (fields) => {
    panels.showStatus(statusAnswer({ center: { ...statusAnswer().center, ...fields } }));
    return [text("center"), level("center")];
  };
  assert.deepEqual(show({}),
    ["5:1 · 47.00000°, 8.00000° · 450 m · heading 090° · 0.10 s old", ""]);
  assert.deepEqual(show({ age_s: 3 })[1], "");
  assert.deepEqual(show({ age_s: 3.1 })[1], "warn");
  assert.deepEqual(show({ lat_deg: null, age_s: null }), ["5:1 · no position yet", "warn"]);
  assert.deepEqual(show({ lat_deg: null, age_s: null, unfit: "its attitude is too old" }),
    ["5:1 · its attitude is too old", "warn"]);
});

test("a degraded recording is bad, and its size is shown while it exists", () => {
  const { text, level, element } = openPanels();
  const show = (recording) => {
    panels.showStatus(statusAnswer({ recording }));
    return [text("recording"), level("recording")];
  };
  assert.deepEqual(show({ state: "recording", bytes: 2500, file: "a.mcap" }),
    ["recording · 2.5 kB", "good"]);
  assert.equal(element("recording").title, "a.mcap");
  assert.deepEqual(show({ state: "off", bytes: 0, file: null }), ["off", ""]);
  assert.deepEqual(show({ state: "degraded", bytes: 1, file: null }), ["degraded · 1 B", "bad"]);
});

test("machine lag is highlighted only when frames wait too long", () => {
  const { text, level } = openPanels();
  const show = (lag) => {
    panels.showStatus(statusAnswer({ arrival_lag: lag }));
    return [text("lag"), level("lag")];
  };
  const unknown = { newest_s: null, p95_s: null, max_s: null, behind: false };
  assert.deepEqual(show({ ...unknown, newest_s: 0, max_s: 0.0042 }), ["4 ms", ""]);
  assert.deepEqual(show({ ...unknown, newest_s: 0, max_s: 0.4 }), ["400 ms", ""]);
  assert.deepEqual(show({ ...unknown, newest_s: 0, max_s: 0.6 }), ["600 ms", "warn"]);
  assert.deepEqual(show({ ...unknown, newest_s: 0.9, max_s: 1.2, behind: true }),
    ["1200 ms", "bad"]);
  assert.deepEqual(show(unknown), ["–", ""]); // a replay, or a system without stamps
  assert.deepEqual(show(undefined), ["–", ""]);
});

test("a replay shows its log, progress and speed", () => {
  const { text, level } = openPanels();
  const show = (replay) => {
    panels.showStatus(statusAnswer({ replay }));
    return text("replay");
  };
  assert.equal(show(null), null);
  const replay = { log: "a.tlog", speed: 2, at_s: 12.4, of_s: 60, state: "running" };
  assert.equal(show(replay), "replay a.tlog · 12 of 60 s · 2×");
  assert.equal(level("replay"), "warn");
  assert.equal(show({ ...replay, speed: null, of_s: null }), "replay a.tlog · 12 s · max");
  assert.equal(show({ ...replay, state: "finished" }), "replay a.tlog · 12 of 60 s · finished");
  assert.equal(show(null), null);
});

test("rejections are listed most frequent first, each with its meaning", () => {
  const { lines, element } = openPanels();
  const rejections = new panels.Rejections();
  const counts = { "frozen": 2, "garbage": 12345, "out-of-order": 30, "not-known-here": 1 };
  rejections.note(counts, 0);
  rejections.show(counts, 0);
  assert.deepEqual(lines("rejections"), ["garbage | 12,345 B", "out-of-order | 30", "frozen | 2",
    "not-known-here | 1"]);
  const titles = element("rejections").children.map(({ title }) => title);
  assert.deepEqual(titles, [REASONS.garbage, REASONS["out-of-order"],
    REASONS.frozen, ""]);
  rejections.show({}, 0);
  assert.equal(element("rejections-panel").hidden, true);
});

test("counts that rise while the page is open show when; earlier ones do not", () => {
  const { lines } = openPanels();
  const rejections = new panels.Rejections();
  const at = (counts, now) => {
    rejections.note(counts, now);
    rejections.show(counts, now);
    return lines("rejections");
  };
  assert.deepEqual(at({ frozen: 2 }, 0), ["frozen | 2"]);
  assert.deepEqual(at({ frozen: 2, secret: 1 }, 1000), ["frozen | 2", "secret | 1 · now"]);
  assert.deepEqual(at({ frozen: 3, secret: 1 }, 8500),
    ["frozen | 3 · now", "secret | 1 · 5 s ago"]);
  assert.deepEqual(at({ frozen: 3, secret: 1 }, 70_000),
    ["frozen | 3 · 1 min 01 s ago", "secret | 1 · 1 min 09 s ago"]);
});

test("the very first rejection counts as new", () => {
  const { lines } = openPanels();
  const rejections = new panels.Rejections();
  rejections.note({}, 0);
  rejections.note({ frozen: 1 }, 1000);
  rejections.show({ frozen: 1 }, 1000);
  assert.deepEqual(lines("rejections"), ["frozen | 1 · now"]);
});

test("looking back marks no rejection as new", () => {
  const { lines } = openPanels();
  const rejections = new panels.Rejections();
  rejections.note({ frozen: 1 }, 0);
  rejections.note({ frozen: 5 }, 60_000);
  rejections.show({ frozen: 1 }, 1000); // before it rose
  assert.deepEqual(lines("rejections"), ["frozen | 1"]);
  rejections.show({ frozen: 5 }, 90_000);
  assert.deepEqual(lines("rejections"), ["frozen | 5 · 30 s ago"]);
});

test("one line shows method, number and condition of the beams; another the array and lead", () => {
  const { text } = openPanels();
  panels.showBeams(beamsAnswer([beam("1:1"), beam("2:1")], { condition_number: 2.345 }));
  assert.equal(text("beams-line"), "Zero forcing · 2 beams · condition number 2.35");
  assert.equal(text("beams-array"),
    "8 elements (ULA) · 5.8 GHz · beamwidth 10.00° · boresight 000° · lead 20 ms");
  panels.showBeams(beamsAnswer([beam("1:1")], {
    method: "mrt", condition_number: 123456, lead_ms: null, array: array({ kind: "ura" }),
  }));
  assert.equal(text("beams-line"), "Maximum ratio transmission · 1 beam · condition number 1.2e+5");
  assert.match(text("beams-array"), /\(URA\).* · lead –$/);
  panels.showBeams(beamsAnswer([], { condition_number: null, array: null }));
  assert.deepEqual([text("beams-line"), text("beams-array")],
    ["Zero forcing · no beams", "–"]);
});

test("unknown values are labelled, and no earlier value stays", () => {
  const { text, level, lines } = openPanels();
  const center = { ...statusAnswer().center, age_s: 9 };
  panels.showStatus(statusAnswer({ center, replay: { log: "a", at_s: 1, state: "running" } }));
  panels.showBeams(beamsAnswer([], { regularised: true }));
  panels.showStatus(null);
  panels.showBeams(null);
  assert.deepEqual(["version", "uptime", "frames", "updates", "center", "recording", "lag", "replay",
    "beams-line", "beams-array", "beams-warning"].map(text),
  ["", "–", "–", "–", "–", "–", "–", null, "–", "–", null]);
  assert.equal(level("center"), "");
});

test("held-back nulls are reported", () => {
  const { text } = openPanels();
  for (const beams of [[], [beam("1:1")]]) {
    panels.showBeams(beamsAnswer(beams));
    assert.equal(text("beams-warning"), null);
  }
  panels.showBeams(beamsAnswer([beam("1:1")], { regularised: true }));
  assert.match(text("beams-warning"), /^Nulls are not exact/);
  panels.showBeams(beamsAnswer([], { regularised: true })); // without beams, no nulls
  assert.equal(text("beams-warning"), null);
});
