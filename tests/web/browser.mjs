// The browser that a module of the page finds itself in: a document made from index.html, the
// colours of style.css, canvases that record, time that passes when a test says so. The modules
// are the page's own. WEB_ROOT names another directory to take them from.

import { readFileSync } from "node:fs";
import { register } from "node:module";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

import { PageDocument } from "./page_document.mjs";
import { VirtualTime } from "./virtual_time.mjs";

register("./as_modules.mjs", import.meta.url);

export const ROOT = join(dirname(fileURLToPath(import.meta.url)), "..", "..");
export const WEB_ROOT = resolve(process.env.WEB_ROOT ?? join(ROOT, "web"));

export const readPage = (name) => readFileSync(join(WEB_ROOT, name), "utf8");

/** A module of the page; with `anew` a fresh instance, so that it starts again. */
export const load = (name, anew = "") => import(pathToFileURL(join(WEB_ROOT, name)).href + anew);

/** The answer of /v1/labels, which the service made for these tests. */
export const LABELS = JSON.parse(readFileSync(process.env.LABELS, "utf8"));
(await load("meanings.js")).learn(LABELS);

/** The properties that style.css gives the root in a theme: `live` to `#27c498`. */
export function themeColours(theme) {
  const style = readPage("style.css");
  const block = (selector) => style.slice(style.indexOf(`\n${selector} {`)).split("}")[0];
  const text = block(":root") + (theme === "light" ? block(':root[data-theme="light"]') : "");
  return Object.fromEntries([...text.matchAll(/--([\w-]+):\s*([^;]+);/g)].map((m) => m.slice(1)));
}

class Storage {
  constructor() {
    this.kept = new Map();
  }

  getItem(key) {
    return this.kept.get(key) ?? null;
  }

  setItem(key, value) {
    this.kept.set(key, String(value));
  }
}

/** Install a new browser; returns the controls for a test. */
export function openBrowser({ ratio = 1, still = false, storage = new Storage() } = {}) {
  const time = new VirtualTime();
  const document = new PageDocument(readPage("index.html"));
  const observers = [];
  const windowListeners = [];
  time.install();
  globalThis.document = document;
  globalThis.localStorage = storage;
  globalThis.window = {
    devicePixelRatio: ratio,
    matchMedia: () => ({ matches: still }),
    addEventListener: (type, listener) => windowListeners.push({ type, listener }),
  };
  globalThis.getComputedStyle = (element) => {
    const values = themeColours(element.dataset.theme);
    return { getPropertyValue: (name) => values[name.slice(2)] ?? "" };
  };
  globalThis.ResizeObserver = class {
    constructor(callback) {
      this.callback = callback;
    }

    observe(element) {
      observers.push({ element, callback: this.callback });
      time.add(this.callback, 0, { isFrame: true }); // reports the initial size as well
    }
  };
  return {
    time, document, storage,
    element: (id) => document.getElementById(id),
    text: (id) => document.getElementById(id).textContent,
    colour: (name) => themeColours(document.documentElement.dataset.theme)[name],
    /** Lay an element out at a size, and notify its observers. */
    resize(id, width, height) {
      const element = document.getElementById(id);
      [element.clientWidth, element.clientHeight] = [width, height];
      observers.filter((one) => one.element === element).forEach(({ callback }) => callback());
      return element;
    },
    onWindow: (type) => windowListeners.filter((one) => one.type === type)
      .forEach(({ listener }) => listener({ type })),
  };
}
