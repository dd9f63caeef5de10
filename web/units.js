// Lengths and speeds in the units that the user has selected; the service uses only metres and
// seconds. The browser stores the choice.

import { $ } from "./dom.js";

const KEY = "companion.units";

/** `metres` per unit; `far`: the unit for long distances; `field`: suffix in CSV headers. */
export const LENGTHS = {
  m: { name: "m", field: "m", metres: 1, far: { name: "km", metres: 1000 } },
  ft: { name: "ft", field: "ft", metres: 0.3048, far: { name: "nmi", metres: 1852 } },
};
/** `mps`: metres per second per unit. */
export const SPEEDS = {
  "m/s": { name: "m/s", field: "mps", mps: 1 },
  "kn": { name: "kn", field: "kn", mps: 1852 / 3600 },
  "km/h": { name: "km/h", field: "kmh", mps: 1 / 3.6 },
};

/** The selected units. */
export const units = { length: LENGTHS.m, speed: SPEEDS["m/s"] };

export const lengthOf = (metres) => metres / units.length.metres;
export const speedOf = (mps) => mps / units.speed.mps;

/** Select these; an unknown one is ignored. */
export function use({ length, speed }) {
  if (Object.hasOwn(LENGTHS, length)) units.length = LENGTHS[length];
  if (Object.hasOwn(SPEEDS, speed)) units.speed = SPEEDS[speed];
}

function remembered() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {}; // storage is blocked, or its content is invalid
  }
}

function remember() {
  try {
    localStorage.setItem(KEY, JSON.stringify({ length: units.length.name,
      speed: units.speed.name }));
  } catch {
    // storage is blocked: the choice holds until the page is closed
  }
}

/** Set up the two lists of units. */
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
