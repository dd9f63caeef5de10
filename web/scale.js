// The scale of the plan view: how many metres the outermost ring stands for, and when that changes.

/** Radius of the outermost ring and distance between rings, metres: 50 m … 800 km. */
const SCALES = [1, 2, 3, 4, 5].flatMap((power) => [
  [1, 0.25], [1.5, 0.5], [2, 0.5], [3, 1], [4, 1], [5, 1], [6, 2], [8, 2],
].map(([radius, step]) => [radius * 10 ** power, step * 10 ** power]))
  .filter(([radius]) => radius >= 50);

const SHRINK_AFTER_MS = 4000; // do not zoom in again at once: the picture would breathe

export class Scale {
  constructor() {
    this.fit = true; // follow the UAVs; false once the operator has chosen
    this.level = SCALES.findIndex(([radius]) => radius >= 200);
    [this.radiusM] = SCALES[this.level]; // what is drawn: follows the level, eased
    this.roomyAt = null;
    this.everFitted = false;
    this.stillness = window.matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** The outermost ring and the distance between rings, metres. */
  get rings() {
    return SCALES[this.level];
  }

  /** Hold these ranges, metres: wider at once, narrower only after a while. */
  follow(rangesM, now) {
    if (!this.fit || !rangesM.length) return;
    const needM = Math.max(...rangesM) * 1.06;
    const found = SCALES.findIndex(([radius]) => radius >= needM);
    const wanted = found < 0 ? SCALES.length - 1 : found;
    if (wanted >= this.level) this.roomyAt = null;
    else this.roomyAt ??= now;
    const roomyLong = this.roomyAt !== null && now - this.roomyAt > SHRINK_AFTER_MS;
    if (wanted <= this.level && !roomyLong && this.everFitted) return;
    this.level = wanted;
    if (!this.everFitted) [this.radiusM] = SCALES[wanted];
    this.everFitted = true;
    this.roomyAt = null;
  }

  zoom(steps) {
    this.fit = false;
    this.level = Math.max(0, Math.min(SCALES.length - 1, this.level - steps));
  }

  /** Follow the UAVs again; asked for, so it narrows at once. */
  fitAll() {
    this.fit = true;
    this.roomyAt = -Infinity;
  }

  get isMoving() {
    return this.radiusM !== SCALES[this.level][0];
  }

  /** Move what is drawn towards what is wanted. True while it is on its way. */
  ease() {
    const [goalM] = SCALES[this.level];
    const ratio = goalM / this.radiusM;
    if (this.stillness.matches || Math.abs(Math.log(ratio)) < 0.004) {
      this.radiusM = goalM;
      return false;
    }
    this.radiusM *= ratio ** 0.22;
    return true;
  }
}
