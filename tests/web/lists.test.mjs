// Links, events and recordings: content, order and severity of each line.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { linkAnswer, stampAt } from "./service.mjs";

const { showEvents, showLinks, showRecordings } = await load("lists.js");
const plain = (text) => text.replaceAll("\u00a0", " ").replaceAll("\u202f", ",");

function openLists() {
  const { element } = openBrowser();
  return { element, items: (id) => element(id).children };
}

/** Appearance of the single link. */
function shownLink(fields) {
  const { items } = openLists();
  showLinks({ links: [linkAnswer(fields)] });
  const [item] = items("links");
  const facts = item.querySelectorAll("dl div").map(({ children: [name, value] }) =>
    [name.textContent, plain(value.textContent)]);
  const [head] = item.children;
  return { head: head.children.map((part) => plain(part.textContent)).join(" | "),
    level: head.dataset.level, facts: Object.fromEntries(facts), item };
}

test("a link shows its address, counts and received senders", () => {
  const { head, level, facts, item } = shownLink();
  assert.deepEqual([head, level], ["udpin:0.0.0.0:14550 | up", "good"]);
  assert.deepEqual(facts, { "Frames": "12,345", "Bad CRC": "0", "Gaps": "3", "First": "50 %",
    "Latency": "2 / 5 ms" });
  assert.equal(item.children.at(-1).textContent, "receives 1:1");
});

test("a silent link is a warning, a link that is down is bad", () => {
  assert.equal(shownLink({ age_s: 3.5 }).level, "good");
  const { head, level } = shownLink({ age_s: 65 });
  assert.deepEqual([head, level], ["udpin:0.0.0.0:14550 | up · silent 1 min 05 s", "warn"]);
  for (const state of ["down", "connecting"]) {
    const shown = shownLink({ state, age_s: 65 });
    assert.deepEqual([shown.head, shown.level], [`udpin:0.0.0.0:14550 | ${state}`, "bad"]);
  }
});

test("events are listed newest first, with time and severity", () => {
  const { items } = openLists();
  showEvents({ events: [
    { at: stampAt(1), severity: "info", text: "1:1 is live" },
    { at: stampAt(2), severity: "warning", text: "1:1 is coasting" },
    { at: stampAt(3), severity: "error", text: "disk full" },
    { at: stampAt(4), severity: "unheard-of", text: "?" },
  ] });
  assert.deepEqual(items("events").map((item) => [item.dataset.level,
    ...item.children.map(({ textContent }) => textContent)]), [
    ["warn", "13:00:04", "?"], ["bad", "13:00:03", "disk full"],
    ["warn", "13:00:02", "1:1 is coasting"], ["", "13:00:01", "1:1 is live"],
  ]);
});

test("only the newest sixty events are shown", () => {
  const { items } = openLists();
  showEvents({ events: Array.from({ length: 100 }, (_, i) =>
    ({ at: stampAt(i), severity: "info", text: `${i}` })) });
  const texts = items("events").map((item) => item.children[1].textContent);
  assert.deepEqual([texts.length, texts[0], texts.at(-1)], [60, "99", "40"]);
});

test("an empty list differs from an unknown one", () => {
  const { element } = openLists();
  showLinks(null);
  showEvents(null);
  assert.deepEqual([element("links").textContent, element("events").textContent], ["–", "–"]);
  showLinks({ links: [] });
  showEvents({ events: [] });
  assert.deepEqual([element("links").textContent, element("events").textContent],
    ["none", "none"]);
});

test("unchanged elements are kept, so that a selection stays", () => {
  const { items } = openLists();
  showLinks({ links: [linkAnswer()] });
  const [before] = items("links");
  showLinks({ links: [linkAnswer()] });
  assert.equal(items("links")[0], before);
  showLinks({ links: [linkAnswer({ gaps: 4 })] });
  assert.notEqual(items("links")[0], before);
});

test("recordings are linked by name, with any characters", () => {
  const { element, items } = openLists();
  showRecordings({ recordings: [{ name: "a b/c.mcap", bytes: 1500, state: "finished" }] });
  assert.equal(element("recordings-panel").hidden, false);
  const [link, facts] = items("recordings")[0].children;
  assert.deepEqual([link.textContent, link.href], ["a b/c.mcap", "/v1/recordings/a%20b%2Fc.mcap"]);
  assert.equal(plain(facts.textContent), "1.5 kB · finished");
  showRecordings(null);
  assert.equal(element("recordings-panel").hidden, true);
});
