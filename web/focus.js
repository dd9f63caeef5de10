// One beam looked at closely: its pattern, and what every element does for it.

import { $, make, setChildren, setText } from "./dom.js";
import { elementsOf, makeElements } from "./elements.js";
import * as format from "./format.js";
import { directionFacts, makePattern } from "./pattern.js";

export class Focus {
  constructor() {
    this.pattern = makePattern($("pattern"));
    this.elements = makeElements($("elements"));
    this.shown = {}; // what the elements were last worked out from
  }

  recolour() {
    this.pattern.recolour();
    this.elements.recolour();
  }

  /** `oldS`: how old it is, where it is the last that was known; else null. */
  show({ pattern, weights, patternBeams }, uav, { isLive, oldS, patternTrusted, weightsTrusted }) {
    const label = oldS === null ? uav ?? "" : `${uav}, as ${format.duration(oldS)} ago`;
    const entry = pattern?.patterns.find((one) => one.uav === uav) ?? null;
    const beam = entry && patternBeams?.beams.find((one) => one.uav === uav);
    for (const name of document.querySelectorAll(".focus-uav")) setText(name, label);
    // Only the pattern of the UAV that was looked at then has been asked for.
    const none = uav === null ? "no beam" : isLive ? "waiting…" : "not asked for at that time";
    this.pattern.show({ answer: pattern, entry, beam, trusted: patternTrusted, none });
    const facts = directionFacts(entry, beam);
    setChildren($("pattern-facts"), facts, () => facts.map(([label, text]) => make(
      "div", { "data-fact": label }, make("dt", {}, label), make("dd", {}, text),
    )));
    if (this.shown.weights !== weights || this.shown.uav !== uav) {
      this.shown = { weights, uav, elements: elementsOf(weights, uav) };
    }
    this.elements.show({ elements: this.shown.elements, trusted: weightsTrusted });
  }
}
