// Lengths and speeds in the units that the reader has chosen; the service knows metres and seconds
// alone. The choice is remembered in this browser.

import { $ } from "./dom.js";

const KEY = "companion.units";

/** `metres` in one; `far`: the unit of what is long, its `metres` too. `field`: as headers name it. */
export const LENGTHS = {
  m: { name: "m", field: "m", metres: 1, far: { name: "km", metres: 1000 } },
  ft: { name: "ft", field: "ft", metres: 0.3048, far: { name: "nmi", metres: 1852 } },
};
/** `mps`: metres per second in one. */
export const SPEEDS = {
  "m/s": { name: "m/s", field: "mps", mps: 1 },
  "kn": { name: "kn", field: "kn", mps: 1852 / 3600 },
  "km/h": { name: "km/h", field: "kmh", mps: 1 / 3.6 },
};

/** The units that are used now. */
export const units = { length: LENGTHS.m, speed: SPEEDS["m/s"] };

export const lengthOf = (metres) => metres / units.length.metres;
export const speedOf = (mps) => mps / units.speed.mps;

/** Use these; one that is not known is left as it is. */
export function use({ length, speed }) {
  if (Object.hasOwn(LENGTHS, length)) units.length = LENGTHS[length];
  if (Object.hasOwn(SPEEDS, speed)) units.speed = SPEEDS[speed];
}

function remembered() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {}; // storage is refused to this page, or holds what is none of ours
  }
}

function remember() {
  try {
    localStorage.setItem(KEY, JSON.stringify({ length: units.length.name,
      speed: units.speed.name }));
  } catch {
    // storage is refused to this page: the choice holds until it is closed
  }
}

/** The two lists to choose from. */
export function setUpUnits(onChange) {
  use(remembered());
  const [length, speed] = [$("unit-length"), $("unit-speed")];
  [length.value, speed.value] = [units.length.name, units.speed.name];
  for (const list of [length, speed]) {
    list.addEventListener("change", () => {
      use({ length: length.value, speed: speed.value });
      remember();
      onChange();
    });
  }
}
