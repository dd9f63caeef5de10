// Selectors of style sheets, as far as the page and its tests use them.

/** Conditions on an element for one part of a selector. */
function testOf(part) {
  const name = part.slice(1);
  if (part[0] === ".") {
    return (element) => (element.getAttribute("class") ?? "").split(" ").includes(name);
  }
  if (part[0] === "#") return (element) => element.id === name;
  if (part[0] === ":") return (element) => element.pseudo.has(name);
  if (part[0] !== "[") return (element) => element.tagName === part.toUpperCase();
  const [attribute, value] = part.slice(1, -1).split("=");
  return value === undefined ? (element) => element.hasAttribute(attribute)
    : (element) => element.getAttribute(attribute) === value.replace(/"/g, "");
}

/** A selector such as `thead th, .pick[aria-pressed=true]` as a question to an element. */
function questionOf(selectors) {
  const alternatives = selectors.split(",").map((selector) =>
    selector.trim().split(/\s+/).map((step) => {
      const parts = step.match(/:[\w-]+|[.#]?[\w-]+|\[[^\]]*\]/g);
      if (parts?.join("") !== step) throw new Error(`no such selector here: ${selector}`);
      const tests = parts.map(testOf);
      return (element) => tests.every((test) => test(element));
    }));
  return (element) => alternatives.some((steps) => {
    if (!steps.at(-1)(element)) return false;
    let above = element.parent;
    for (const step of steps.slice(0, -1).reverse()) {
      while (above && !step(above)) above = above.parent;
      if (!above) return false;
      above = above.parent;
    }
    return true;
  });
}

const QUESTIONS = new Map();

/** The same, cached. */
export function question(selectors) {
  if (!QUESTIONS.has(selectors)) QUESTIONS.set(selectors, questionOf(selectors));
  return QUESTIONS.get(selectors);
}
