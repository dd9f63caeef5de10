// Functions for changing the page that all panels share.

export const $ = (id) => document.getElementById(id);
const TEXT_NODE = 3;

/** Set a text, unless it is unchanged: each write costs a layout. */
export function setText(element, text) {
  const only = element.firstChild;
  if (only?.nodeType === TEXT_NODE && only === element.lastChild) {
    if (only.data !== text) only.data = text; // the text node stays
  } else if (element.textContent !== text) element.textContent = text;
}

export function setAttribute(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

export function toggleAttribute(element, name, wanted) {
  if (element.hasAttribute(name) !== wanted) element.toggleAttribute(name, wanted);
}

/** An element with attributes and children; children are elements or text. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Call `choose` with the `data-id` of a clicked row. A double click, and the end of a selection of text, choose nothing. */
export function onRow(body, choose) {
  body.addEventListener("click", ({ target, detail }) => {
    const id = target.closest("[data-id]")?.dataset.id;
    if (id === undefined || detail > 1 || globalThis.getSelection?.()?.type === "Range") return;
    choose(id);
  });
}

/** Set the children of a list, unless `key`, which identifies its contents, is unchanged. */
export function setChildren(list, key, build) {
  const wanted = JSON.stringify(key);
  if (list.dataset.shown === wanted) return; // leave focus and selection alone
  list.replaceChildren(...build());
  list.dataset.shown = wanted; // only after `build` has succeeded
}

/** Fill a list with `[left, right, level?, title?]` lines; shows `none` without any. */
export function setPairs(list, pairs, none) {
  setChildren(list, [pairs, none], () => {
    if (!pairs.length) return [make("li", { class: "muted" }, none)];
    return pairs.map(([left, right, level = "", title = ""]) => make(
      "li", { "data-level": level, title }, make("span", {}, left), make("span", {}, right),
    ));
  });
}
