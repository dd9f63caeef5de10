// The scale of the plan view: how many metres the outermost ring stands for, and when that changes.

import { units } from "./units.js";

/** Round numbers for the outermost ring and for the distance between rings. */
const ROUND = [0, 1, 2, 3, 4, 5, 6].flatMap((power) => [
  [1, 0.25], [1.5, 0.5], [2, 0.5], [3, 1], [4, 1], [5, 1], [6, 2], [8, 2],
].map(([radius, step]) => [radius * 10 ** power, step * 10 ** power]));

/** Both in metres, round in the units that are used: 50 m … 800 km, 200 ft … 400 nmi. */
function scalesIn({ metres, far }) {
  const near = ROUND.map((pair) => pair.map((value) => value * metres))
    .filter(([radiusM]) => radiusM >= 50 && radiusM < far.metres);
  const long = ROUND.map((pair) => pair.map((value) => value * far.metres))
    .filter(([radiusM]) => radiusM <= 800_000);
  return [...near, ...long];
}

const SHRINK_AFTER_MS = 4000; // do not zoom in again at once: the picture would breathe

export class Scale {
  constructor() {
    this.scales = scalesIn(units.length);
    this.fit = true; // follow the UAVs; false once the operator has chosen
    this.level = this.scales.findIndex(([radius]) => radius >= 200);
    [this.radiusM] = this.scales[this.level]; // what is drawn: follows the level, eased
    this.roomyAt = null;
    this.everFitted = false;
    this.stillness = window.matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** The outermost ring and the distance between rings, metres. */
  get rings() {
    return this.scales[this.level];
  }

  /** Rings that are round in the units that are used now, hardly another picture. */
  changeUnits() {
    const [radiusM] = this.rings;
    this.scales = scalesIn(units.length);
    const level = this.scales.findIndex(([found]) => found >= radiusM * 0.95);
    this.level = level < 0 ? this.scales.length - 1 : level;
  }

  /** Hold these ranges, metres: wider at once, narrower only after a while. */
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

  /** Follow the UAVs again; asked for, so it narrows at once. */
  fitAll() {
    this.fit = true;
    this.roomyAt = -Infinity;
  }

  get isMoving() {
    return this.radiusM !== this.scales[this.level][0];
  }

  /** Move what is drawn towards what is wanted. True while it is on its way. */
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
