// The keyboard and the choice of theme.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser, themeColours } from "./browser.mjs";

const { setUpKeys } = await load("keys.js");
const { setUpTheme } = await load("theme.js");

function openKeys() {
  const browser = openBrowser();
  const done = [];
  const names = [" ", "ArrowLeft", "Shift+ArrowLeft", "t", "?"];
  setUpKeys(Object.fromEntries(names.map((name) => [name, () => done.push(name)])),
    (n) => done.push(n));
  const { body } = browser.document;
  const press = (key, { on = body, ...how } = {}) =>
    on.dispatch("keydown", { key, ...how }).isTaken;
  return { browser, done, press };
}

test("each key has only its own action, in upper or lower case", () => {
  const { done, press } = openKeys();
  assert.ok([" ", "ArrowLeft", "t", "T", "?", "7"].map((key) => press(key)).every(Boolean));
  assert.deepEqual(done, [" ", "ArrowLeft", "t", "t", "?", 7]);
  assert.ok(!press("x") && !press("0") && !press("F5"));
  assert.equal(done.length, 6);
});

test("Shift with an arrow key jumps", () => {
  const { done, press } = openKeys();
  press("ArrowLeft", { shiftKey: true });
  press("?", { shiftKey: true });
  assert.deepEqual(done, ["Shift+ArrowLeft", "?"]);
});

test("browser shortcuts are not intercepted", () => {
  const { done, press } = openKeys();
  for (const held of ["ctrlKey", "altKey", "metaKey", "isComposing"]) {
    assert.equal(press("t", { [held]: true }), false);
  }
  assert.deepEqual(done, []);
});

test("the help dialog receives all keys while open", () => {
  const { browser, done, press } = openKeys();
  browser.element("help").showModal();
  assert.ok(!press("t") && !press(" "));
  assert.deepEqual(done, []);
});

test("the slider receives arrow keys; other keys go to the page", () => {
  const { browser, done, press } = openKeys();
  const on = browser.element("scrub");
  for (const key of ["ArrowLeft", "ArrowUp", "Home", "End"]) assert.ok(!press(key, { on }), key);
  assert.ok(press(" ", { on }));
  assert.deepEqual(done, [" "]);
});

test("Space presses a button focused by keyboard, not one that was clicked", () => {
  const { browser, done, press } = openKeys();
  const on = browser.element("theme");
  on.pseudo.add("focus-visible");
  assert.equal(press(" ", { on }), false);
  on.pseudo.clear();
  assert.ok(press(" ", { on }));
  assert.deepEqual(done, [" "]);
  assert.ok(on.isBlurred); // otherwise releasing the key would press it
});

function openTheme(storage) {
  const browser = openBrowser(storage === undefined ? {} : { storage });
  let changes = 0;
  const button = browser.element("theme");
  const toggle = setUpTheme(button, () => { changes += 1; });
  return { browser, button, toggle, changes: () => changes,
    theme: () => browser.document.documentElement.dataset.theme };
}

test("the page is dark until light is selected; the button names the other theme", () => {
  const { button, theme, toggle, changes } = openTheme();
  assert.deepEqual([theme(), button.textContent, changes()], ["dark", "Light", 1]);
  button.click();
  assert.deepEqual([theme(), button.textContent, changes()], ["light", "Dark", 2]);
  toggle();
  assert.deepEqual([theme(), button.textContent, changes()], ["dark", "Light", 3]);
});

test("the selected theme is stored", () => {
  const { button, browser: { storage } } = openTheme();
  button.click();
  const again = openTheme(storage);
  assert.equal(again.theme(), "light");
  again.button.click();
  assert.equal(openTheme(storage).theme(), "dark");
});

test("without browser storage the theme holds until the page is closed", () => {
  const refuse = () => { throw new Error("SecurityError"); };
  const { button, theme } = openTheme({ getItem: refuse, setItem: refuse });
  assert.equal(theme(), "dark");
  button.click();
  assert.equal(theme(), "light");
});

test("the light theme changes every colour except the shared warning colours", () => {
  const [dark, light] = [themeColours("dark"), themeColours("light")];
  const same = Object.keys(dark).filter((name) => dark[name] === light[name]);
  assert.deepEqual(same.sort(), ["bad-bg", "font", "on-past", "past"]);
});
