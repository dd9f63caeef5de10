// Answers of the last minutes, so that the operator can look back. Limited in time and in size:
// with many UAVs it covers less time.

import { worstFirst } from "./health.js";

/** Longest time that is kept. */
export const KEEP_MS = 300_000;
const KEEP_UAV_ENTRIES = 36_000; // some 38 MB: 300 s of 100 UAVs
const APART_MS = 1500; // samples nearer than this to a moment of this page are not needed

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

  /** Add samples of the service (`momentsOf`) where this page has no moments of its own. */
  fill(samples) {
    const isMissing = ({ at }) => !this.moments.some((own) => Math.abs(own.at - at) < APART_MS);
    this.moments = [...this.moments, ...samples.filter(isMissing)].sort((a, b) => a.at - b.at);
    this.entries = this.moments.reduce((sum, { uavs }) => sum + uavs.length, 0);
    const now = this.newest?.at ?? 0;
    while (this.moments.length > 1 && this.isTooMuch(now)) {
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

const BEAM_VALUES = ["azimuth_deg", "pointing_bound_deg", "guaranteed_gain_db", "gain_db"];

/** The moments of an answer of /v1/history, oldest first; `now`: its arrival. */
export function momentsOf(answer, now) {
  const ofUavs = Object.entries(answer.uavs);
  const valuesAt = (columns, i) => Object.fromEntries(
    Object.entries(columns).map(([name, column]) => [name, column[i]]),
  );
  return answer.at.map((stamp, i) => {
    const all = ofUavs.filter(([, columns]) => columns.state[i] !== null)
      .map(([id, columns]) => ({ id, target: true, ...valuesAt(columns, i) }));
    const uavs = all.map(({ azimuth_deg: _, pointing_bound_deg: __, gain_db: ___,
      guaranteed_gain_db: ____, ...uav }) => uav).sort(worstFirst);
    const beams = all.filter(({ azimuth_deg: azimuth }) => azimuth !== null).map((one) => ({
      uav: one.id, ...Object.fromEntries(BEAM_VALUES.map((name) => [name, one[name]])),
    }));
    const place = valuesAt(answer.carrier, i);
    const carrier = place.lat_deg === null ? { unfit: "position unknown", unseen: true }
      : { ...place, ageS: null, unfit: null };
    return {
      at: now - (Date.parse(answer.valid_at) - Date.parse(stamp)), stamp, uavs, beams, carrier,
      byId: new Map(uavs.map((uav) => [uav.id, uav])),
      answer: null, status: null, links: null, events: null, fleet: null, isSampled: true,
    };
  });
}
