// The scale of the plan view: the radius of the outermost ring in metres, and when it changes.

import { units } from "./units.js";

/** Round numbers for the outermost ring and for the distance between rings. */
const ROUND = [0, 1, 2, 3, 4, 5, 6].flatMap((power) => [
  [1, 0.25], [1.5, 0.5], [2, 0.5], [3, 1], [4, 1], [5, 1], [6, 2], [8, 2],
].map(([radius, step]) => [radius * 10 ** power, step * 10 ** power]));

/** Both in metres, round in the selected units: 50 m … 800 km, 200 ft … 400 nmi. */
function scalesIn({ metres, far }) {
  const near = ROUND.map((pair) => pair.map((value) => value * metres))
    .filter(([radiusM]) => radiusM >= 50 && radiusM < far.metres);
  const long = ROUND.map((pair) => pair.map((value) => value * far.metres))
    .filter(([radiusM]) => radiusM <= 800_000);
  return [...near, ...long];
}

const SHRINK_AFTER_MS = 4000; // delay before zooming in again, so that the scale does not oscillate

export class Scale {
  constructor() {
    this.scales = scalesIn(units.length);
    this.fit = true; // fit the UAVs; false after the operator has zoomed
    this.level = this.scales.findIndex(([radius]) => radius >= 200);
    [this.radiusM] = this.scales[this.level]; // the drawn radius, which approaches that of the level
    this.roomyAt = null;
    this.everFitted = false;
    this.stillness = window.matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** The outermost ring and the distance between rings, metres. */
  get rings() {
    return this.scales[this.level];
  }

  /** Select rings that are round in the new units, at nearly the same scale. */
  changeUnits() {
    const [radiusM] = this.rings;
    this.scales = scalesIn(units.length);
    const level = this.scales.findIndex(([found]) => found >= radiusM * 0.95);
    this.level = level < 0 ? this.scales.length - 1 : level;
  }

  /** Fit these ranges, metres: zoom out at once, zoom in only after a while. */
  follow(rangesM, now) {
    if (!this.fit || !rangesM.length) return;
    const needM = Math.max(...rangesM) * 1.06;
    const found = this.scales.findIndex(([radius]) => radius >= needM);
    const wanted = found < 0 ? this.scales.length - 1 : found;
    if (wanted >= this.level) this.roomyAt = null;
    else this.roomyAt ??= now;
    const roomyLong = this.roomyAt !== null && now - this.roomyAt > SHRINK_AFTER_MS;
    if (wanted <= this.level && !roomyLong && this.everFitted) return;
    this.level = wanted;
    if (!this.everFitted) [this.radiusM] = this.scales[wanted];
    this.everFitted = true;
    this.roomyAt = null;
  }

  zoom(steps) {
    this.fit = false;
    this.level = Math.max(0, Math.min(this.scales.length - 1, this.level - steps));
  }

  /** Fit the UAVs again; on request, so zoom in at once. */
  fitAll() {
    this.fit = true;
    this.roomyAt = -Infinity;
  }

  get isMoving() {
    return this.radiusM !== this.scales[this.level][0];
  }

  /** Move the drawn radius towards its goal. Returns whether it is still moving. */
  ease() {
    const [goalM] = this.scales[this.level];
    const ratio = goalM / this.radiusM;
    if (this.stillness.matches || Math.abs(Math.log(ratio)) < 0.004) {
      this.radiusM = goalM;
      return false;
    }
    this.radiusM *= ratio ** 0.22;
    return true;
  }
}
