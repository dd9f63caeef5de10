// Parts of the page that fold. The browser remembers which ones the operator has opened or closed.
// With many UAVs the others marked `data-roomy` are closed, so that plan and table get the room.

import { $, toggleAttribute } from "./dom.js";

const KEY = "companion.folds";
const FEW = 8; // number of UAVs up to which there is room for everything

function remembered() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {}; // storage is blocked, or its content is invalid
  }
}

function remember(choices) {
  try {
    localStorage.setItem(KEY, JSON.stringify(choices));
  } catch {
    // storage is blocked: the choice holds until the page is closed
  }
}

export const isOpen = (id) => $(id).hasAttribute("open");

export class Folds {
  /** `onChange(id)` is called after a part was opened or closed. */
  constructor(onChange) {
    this.choices = remembered();
    for (const fold of document.querySelectorAll("details[data-fold]")) {
      if (fold.id in this.choices) toggleAttribute(fold, "open", this.choices[fold.id]);
      fold.querySelector("summary").addEventListener("click", () => {
        this.choices[fold.id] = !isOpen(fold.id); // it opens or closes after this event
        remember(this.choices);
      });
      fold.addEventListener("toggle", () => onChange(fold.id));
    }
  }

  /** Close what needs room if there are many UAVs, unless the operator has chosen. */
  makeRoom(uavs) {
    if (this.isRoomy || uavs <= FEW) return;
    this.isRoomy = true;
    for (const fold of document.querySelectorAll("details[data-roomy]")) {
      if (!(fold.id in this.choices)) toggleAttribute(fold, "open", false);
    }
  }
}
