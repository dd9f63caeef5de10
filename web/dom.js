// The few things that every panel does to the page.

export const $ = (id) => document.getElementById(id);
const TEXT_NODE = 3;

/** Nothing is written that stands there already: each write costs a layout. */
export function setText(element, text) {
  const only = element.firstChild;
  if (only?.nodeType === TEXT_NODE && only === element.lastChild) {
    if (only.data !== text) only.data = text; // the box of the text stays
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

/** Put these children into a list, unless it shows the same already: `key` says what it shows. */
export function setChildren(list, key, build) {
  const wanted = JSON.stringify(key);
  if (list.dataset.shown === wanted) return; // leave focus and selection alone
  list.replaceChildren(...build());
  list.dataset.shown = wanted; // not before: what cannot be built is not shown
}

/** Fill a list with `[left, right, level?, title?]` lines; says `none` where there are none. */
export function setPairs(list, pairs, none) {
  setChildren(list, [pairs, none], () => {
    if (!pairs.length) return [make("li", { class: "muted" }, none)];
    return pairs.map(([left, right, level = "", title = ""]) => make(
      "li", { "data-level": level, title }, make("span", {}, left), make("span", {}, right),
    ));
  });
}
