// Words that the page and the service share are the same in both: the page's lists are held
// against the enumerations in the Python source, wherever in the package they are.

import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";

import { ROOT, load, readPage } from "./browser.mjs";

const SOURCES = readdirSync(join(ROOT, "companion"), { recursive: true, encoding: "utf8" })
  .filter((name) => name.endsWith(".py"))
  .map((name) => readFileSync(join(ROOT, "companion", name), "utf8"));

/** The values of an enumeration of words. */
function wordsOf(name) {
  const found = SOURCES.map((text) => text.split(`\nclass ${name}(StrEnum):\n`)[1])
    .filter((body) => body !== undefined);
  assert.equal(found.length, 1, `${found.length} classes ${name}`);
  const body = found[0].split(/\n(?=\S)/)[0];
  const members = body.match(/^ {4}[A-Z]\w* *=.*$/gm);
  const words = members.map((line) => /^ +\w+ = "([\w-]+)"/.exec(line)?.[1]);
  assert.ok(words.length > 1 && words.every(Boolean), `${name} cannot be read`);
  return words.sort();
}

test("every reason for a rejection is explained, and no other", async () => {
  const { REASONS } = await load("panels.js");
  assert.deepEqual(Object.keys(REASONS).sort(), wordsOf("Reason"));
});

test("every method of making weights has its name, and no other", async () => {
  const { METHODS } = await load("panels.js");
  assert.deepEqual(Object.keys(METHODS).sort(), wordsOf("Method"));
});

test("every state of a UAV has its mark in the table and in the legend", () => {
  const legend = readPage("index.html").split('class="legend"')[1].split("</ul>")[0];
  const style = readPage("style.css");
  for (const state of wordsOf("TrackState")) {
    assert.match(legend, new RegExp(`</svg>${state}</li>`));
    const mark = `tr[data-state="${state}"] td[data-key="state"]::before { content: "`;
    assert.ok(style.includes(mark), `no mark for ${state}`);
  }
});

test("every verdict has its mark in the table and its colour, and no other", async () => {
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

test("no sign of a state is one of a verdict", () => {
  const style = readPage("style.css");
  const signs = (what) => [...style.matchAll(
    new RegExp(`tr\\[data-${what}="\\w+"\\] td\\[data-key="\\w+"\\]::before { content: "(.)"`, "g"),
  )].map((found) => found[1]);
  const [states, verdicts] = [signs("state"), signs("verdict")];
  assert.deepEqual([states.length, verdicts.length], [4, 3]);
  // A cross is the same in both: there is nothing.
  assert.deepEqual(states.filter((sign) => verdicts.includes(sign)), ["✕"]);
});

test("every severity of an event has its mark, and no other", async () => {
  const { SEVERITY_LEVEL } = await load("lists.js");
  assert.deepEqual(Object.keys(SEVERITY_LEVEL).sort(), wordsOf("Severity"));
});
