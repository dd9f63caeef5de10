// Details of one beam: its pattern, and phase and amplitude of every element.

import { $, make, setChildren, setText } from "./dom.js";
import { elementsOf, makeElements } from "./elements.js";
import * as format from "./format.js";
import { directionFacts, makePattern } from "./pattern.js";

export class Focus {
  constructor() {
    this.pattern = makePattern($("pattern"));
    this.elements = makeElements($("elements"));
    this.shown = {}; // input of the last computation of the elements
  }

  recolour() {
    this.pattern.recolour();
    this.elements.recolour();
  }

  /** `oldS`: age of the last known beam, if it is shown; else null. */
  show({ pattern, weights, patternBeams }, uav, { isLive, oldS, patternTrusted, weightsTrusted }) {
    const label = oldS === null ? uav ?? "" : `${uav}, as ${format.duration(oldS)} ago`;
    const entry = pattern?.patterns.find((one) => one.uav === uav) ?? null;
    const beam = entry && patternBeams?.beams.find((one) => one.uav === uav);
    for (const name of document.querySelectorAll(".focus-uav")) setText(name, label);
    // Only the pattern of the UAV that was shown at that time was requested.
    const none = uav === null ? "no beam" : isLive ? "waiting…" : "not stored for that time";
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
