// What the page draws for each value of an enumeration is there for every value that the service
// has, and for no other.

import assert from "node:assert/strict";
import { test } from "node:test";

import { LABELS, load, readPage } from "./browser.mjs";

/** The values of an enumeration of words. */
function wordsOf(name) {
  return Object.keys(LABELS.enumerations[name]).sort();
}

test("every state of a UAV has its mark in the table and in the legend", () => {
  const legend = readPage("index.html").split('class="legend"')[1].split("</ul>")[0];
  const style = readPage("style.css");
  for (const state of wordsOf("TrackState")) {
    assert.match(legend, new RegExp(`</svg>${state}</li>`));
    const mark = `tr[data-state="${state}"] td[data-key="state"]::before { content: "`;
    assert.ok(style.includes(mark), `no mark for ${state}`);
  }
});

test("every verdict has exactly one mark and colour in the table", async () => {
  const { LEVELS, LEVEL_OF, MARKS } = await load("health.js");
  const style = readPage("style.css");
  for (const list of [LEVELS, Object.keys(LEVEL_OF), Object.keys(MARKS)]) {
    assert.deepEqual([...list].sort(), wordsOf("Level"));
  }
  for (const level of LEVELS) {
    const mark = `tr[data-verdict="${level}"] td[data-key="verdict"]::before { content: "`;
    assert.ok(style.includes(mark + MARKS[level]), level);
  }
});

test("signs of states and verdicts are distinct", () => {
  const style = readPage("style.css");
  const signs = (what) => [...style.matchAll(
    new RegExp(`tr\\[data-${what}="\\w+"\\] td\\[data-key="\\w+"\\]::before { content: "(.)"`, "g"),
  )].map((found) => found[1]);
  const [states, verdicts] = [signs("state"), signs("verdict")];
  assert.deepEqual([states.length, verdicts.length], [4, 3]);
  // A cross is shared by both: it means nothing is there.
  assert.deepEqual(states.filter((sign) => verdicts.includes(sign)), ["✕"]);
});

test("every event severity has exactly one mark", async () => {
  const { SEVERITY_LEVEL } = await load("lists.js");
  assert.deepEqual(Object.keys(SEVERITY_LEVEL).sort(), wordsOf("Severity"));
});
