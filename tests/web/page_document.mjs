// As much of a document as the page asks for: elements made from its own index.html, found by id
// and by selector, events that rise. It has no layout: elements are as large as a test says.

import { RecordingContext } from "./recording_canvas.mjs";
import { question } from "./selectors.mjs";

const VOID = ["input", "link", "meta", "br"];
const TOKENS = /<!doctype[^>]*>|<!--[^]*?-->|<(\/?)([\w-]+)([^>]*?)(\/?)>|[^<]+/g;
const REFLECTED = ["id", "title", "value", "min", "href"];

/** `data-short-name` and `shortName`. */
const hyphened = (name) => name.replace(/[A-Z]/g, (letter) => `-${letter.toLowerCase()}`);

export class PageElement {
  constructor(tag, document) {
    this.tagName = tag.toUpperCase();
    this.ownerDocument = document;
    this.parent = null;
    this.childNodes = []; // elements, and texts as they are
    this.attributes = new Map();
    this.listeners = [];
    this.pseudo = new Set(); // "active", "focus-visible": what the operator does to it
    [this.clientWidth, this.clientHeight] = [0, 0];
    this.dataset = new Proxy({}, {
      get: (_, name) => this.getAttribute(`data-${hyphened(name)}`) ?? undefined,
      set: (_, name, value) => this.setAttribute(`data-${hyphened(name)}`, value) ?? true,
    });
  }

  // --- attributes -------------------------------------------------------------------------------

  getAttribute(name) {
    return this.attributes.get(name) ?? null;
  }

  setAttribute(name, value) {
    this.attributes.set(name, String(value));
    if (name === "id") this.ownerDocument.ids.set(String(value), this);
  }

  hasAttribute(name) {
    return this.attributes.has(name);
  }

  toggleAttribute(name, wanted) {
    if (wanted) this.setAttribute(name, "");
    else this.attributes.delete(name);
  }

  get hidden() {
    return this.hasAttribute("hidden");
  }

  set hidden(wanted) {
    this.toggleAttribute("hidden", wanted);
  }

  // --- the tree ---------------------------------------------------------------------------------

  get children() {
    return this.childNodes.filter((node) => node instanceof PageElement);
  }

  get textContent() {
    return this.childNodes.map((node) => node.textContent ?? node).join("");
  }

  set textContent(text) {
    this.replaceChildren(String(text));
  }

  append(...nodes) {
    for (const node of nodes) this.insertBefore(node, null);
  }

  replaceChildren(...nodes) {
    for (const child of this.children) child.parent = null;
    this.childNodes = [];
    this.append(...nodes);
  }

  insertBefore(node, before) {
    if (!(node instanceof PageElement)) {
      this.childNodes.push(String(node));
      return;
    }
    node.remove();
    const index = before === null ? this.childNodes.length : this.childNodes.indexOf(before);
    this.childNodes.splice(index, 0, node);
    node.parent = this;
  }

  remove() {
    if (!this.parent) return;
    this.parent.childNodes = this.parent.childNodes.filter((node) => node !== this);
    this.parent = null;
  }

  /** Everything in it, in the order of the text. */
  everything(found = []) {
    for (const child of this.children) {
      found.push(child);
      child.everything(found);
    }
    return found;
  }

  matches(selectors) {
    return question(selectors)(this);
  }

  closest(selectors) {
    return this.matches(selectors) ? this : this.parent?.closest(selectors) ?? null;
  }

  querySelectorAll(selectors) {
    return this.everything().filter(question(selectors));
  }

  querySelector(selectors) {
    return this.querySelectorAll(selectors)[0] ?? null;
  }

  // --- tables -----------------------------------------------------------------------------------

  get tHead() {
    return this.querySelector("thead");
  }

  get tBodies() {
    return this.querySelectorAll("tbody");
  }

  get rows() {
    return this.querySelectorAll("tr");
  }

  // --- what is done to it -----------------------------------------------------------------------

  addEventListener(type, listener) {
    this.listeners.push({ type, listener });
  }

  /** An event that rises to the document; returns it, so that one sees whether it was taken. */
  dispatch(type, details = {}) {
    const event = { type, target: this, isTaken: false, ...details };
    event.preventDefault = () => { event.isTaken = true; };
    for (let at = this; at; at = at.parent ?? at.above) {
      at.listeners.filter((one) => one.type === type).forEach(({ listener }) => listener(event));
    }
    return event;
  }

  click(details) {
    return this.dispatch("click", details);
  }

  blur() {
    this.isBlurred = true;
  }

  scrollIntoView() {
    this.isRevealed = true;
  }

  showModal() {
    this.setAttribute("open", "");
  }

  getContext() {
    this.context ??= new RecordingContext();
    return this.context;
  }
}

for (const name of REFLECTED) {
  Object.defineProperty(PageElement.prototype, name, {
    get() { return this.getAttribute(name) ?? ""; },
    set(value) { this.setAttribute(name, value); },
  });
}

export class PageDocument {
  constructor(html) {
    this.listeners = [];
    this.hidden = false;
    this.ids = new Map();
    this.documentElement = this.parse(html);
    this.documentElement.above = this;
  }

  /** Markup as this page is written: every attribute in quotes, every element closed. */
  parse(html) {
    const root = new PageElement("#root", this);
    let open = root;
    for (const [token, end, tag, attributes, isEmpty] of html.matchAll(TOKENS)) {
      if (tag === undefined) {
        if (token[0] !== "<" && token.trim()) open.append(unescaped(token));
      } else if (end) {
        if (open.tagName !== tag.toUpperCase()) throw new Error(`${token} in ${open.tagName}`);
        open = open.parent;
      } else {
        const element = new PageElement(tag, this);
        for (const [, name, value = ""] of attributes.matchAll(/([\w-]+)(?:="([^"]*)")?/g)) {
          element.setAttribute(name, value);
        }
        open.append(element);
        if (!isEmpty && !VOID.includes(tag)) open = element;
      }
    }
    if (open !== root) throw new Error(`${open.tagName} is not closed`);
    const [top] = root.children;
    top.parent = null;
    return top;
  }

  createElement(tag) {
    return new PageElement(tag, this);
  }

  createElementNS(_, tag) {
    return new PageElement(tag, this);
  }

  getElementById(id) {
    return this.ids.get(id) ?? null;
  }

  querySelectorAll(selectors) {
    return this.documentElement.querySelectorAll(selectors);
  }

  querySelector(selectors) {
    return this.documentElement.querySelector(selectors);
  }

  get body() {
    return this.querySelector("body");
  }

  get title() {
    return this.querySelector("title").textContent;
  }

  set title(text) {
    this.querySelector("title").textContent = text;
  }

  addEventListener(type, listener) {
    this.listeners.push({ type, listener });
  }

  dispatch(type) {
    this.listeners.filter((one) => one.type === type).forEach(({ listener }) => listener({ type }));
  }
}

const unescaped = (text) => text.replace(/&lt;/g, "<").replace(/&gt;/g, ">").replace(/&amp;/g, "&");
