// Answers of the last minutes, so that the operator can look back. Limited in time and in size:
// with many UAVs it covers less time.

/** Longest time that is kept. */
export const KEEP_MS = 300_000;
const KEEP_UAV_ENTRIES = 24_000; // some 25 MB: 300 s of 60 UAVs

/** Without values that the page does not show, as moments are kept for minutes. */
function slim({ recent_rejections: _, rejected: __, clock: ___, ...uav }) {
  return uav;
}

export class History {
  constructor() {
    this.moments = []; // oldest first
    this.entries = 0;
  }

  /** Keep a moment: `{at, stamp, uavs, …}`, `at` in milliseconds of this page's clock. */
  add({ uavs, ...rest }) {
    const kept = uavs.map(slim);
    this.moments.push({ ...rest, uavs: kept, byId: new Map(kept.map((uav) => [uav.id, uav])) });
    this.entries += kept.length;
    while (this.moments.length > 1 && this.isTooMuch(rest.at)) {
      this.entries -= this.moments.shift().uavs.length;
    }
  }

  isTooMuch(now) {
    return now - this.moments[0].at > KEEP_MS || this.entries > KEEP_UAV_ENTRIES;
  }

  get newest() {
    return this.moments.at(-1) ?? null;
  }

  /** Index of the first moment after `at`; the number of moments if there is none. */
  indexAfter(at) {
    let [low, high] = [0, this.moments.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.moments[middle].at > at) high = middle;
      else low = middle + 1;
    }
    return low;
  }

  /** The newest moment that is not after `at`, or else the oldest; null without any. */
  at(at) {
    return this.moments[Math.max(0, this.indexAfter(at) - 1)] ?? null;
  }

  /** The moment this many steps from the given one, or from the oldest if that was dropped. */
  stepFrom(moment, steps) {
    const here = this.indexAfter(moment.at) - 1;
    const index = Math.max(0, Math.min(this.moments.length - 1, here + steps));
    return this.moments[index] ?? null;
  }

  /** Moments after `from` and up to `to`, oldest first. */
  between(from, to) {
    return this.moments.slice(this.indexAfter(from), this.indexAfter(to));
  }
}
