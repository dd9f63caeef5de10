// What was known last of the carrier and of each beam: it stays on the page, grey and with its age,
// for nothing tells an operator less than an empty picture.

import { known } from "./format.js";
import { elsewhere } from "./health.js";
import { metresPerDegree, wrapDegrees } from "./trails.js";

export class LastKnown {
  constructor() {
    this.beams = new Map(); // by UAV: {beam, at}
    this.picture = null; // {uav, pattern, weights, patternBeams, at} of the beam that was looked at
    this.first = null; // where a UAV was first seen
  }

  /** The place that UAVs are seen from: the carrier's; where a UAV was first, while none is known. */
  middle(carrier, uavs) {
    this.first ??= uavs.find(({ lat_deg: lat }) => known(lat)) ?? null;
    return carrier?.unseen ? this.first : carrier;
  }

  /** Take in what is true at `at`. */
  note({ uavs, beams, answer, pattern, weights, patternBeams }, uav, at) {
    const present = new Set(uavs.map(({ id }) => id));
    for (const id of this.beams.keys()) if (!present.has(id)) this.beams.delete(id);
    for (const beam of beams) this.beams.set(beam.uav, { beam, at });
    if (answer?.array) this.array = answer.array;
    if (uav !== null && pattern?.patterns.some((one) => one.uav === uav)) {
      // Weights are asked for less often: those of the same beam stay until there are others.
      const before = this.picture?.uav === uav ? this.picture.weights : null;
      const has = weights?.uavs?.includes(uav);
      this.picture = { uav, pattern, weights: has ? weights : before, patternBeams, at };
    }
  }

  /**
   * The present beams, and after them the last ones of UAVs that have none, with their age; of one
   * that another node serves now there is none to be missed.
   */
  beamsOf(uavs, beams, now) {
    const fresh = new Set(beams.map(({ uav }) => uav));
    const isOld = (uav) => !fresh.has(uav.id) && this.beams.has(uav.id) && !elsewhere(uav);
    const old = uavs.filter(isOld).map(({ id }) => {
      const { beam, at } = this.beams.get(id);
      return { ...beam, oldS: (now - at) / 1000 };
    });
    return [...beams, ...old];
  }
}

/**
 * Where the carrier is, or was: `{lat_deg, lon_deg, heading_deg, ageS, unfit}`; null without news.
 * `ageS` is null while that is true; `unfit` says what is wrong with it; `unseen`: it never was
 * known.
 */
export function carrierOf(status) {
  const center = status?.center;
  if (!center) return null;
  // Where this machine does not keep up, that is why its news of the carrier is old.
  const unfit = status.health?.behind ?? center.unfit;
  const last = known(center.lat_deg) ? center : center.last_known;
  if (!last) return { unfit, unseen: true };
  const ageS = last === center ? null : (Date.parse(status.time) - Date.parse(last.at)) / 1000;
  return { ...last, ageS, unfit };
}

/** A UAV with its offset from where the carrier was last, where it has none from where it is. */
export function placedBy(uav, carrier) {
  if (known(uav.north_m) || !known(uav.lat_deg) || !known(carrier?.lat_deg)) return uav;
  const scale = metresPerDegree(carrier.lat_deg);
  return {
    ...uav,
    north_m: (uav.lat_deg - carrier.lat_deg) * scale.north,
    east_m: wrapDegrees(uav.lon_deg - carrier.lon_deg) * scale.east,
    down_m: known(uav.alt_m) && known(carrier.alt_m) ? carrier.alt_m - uav.alt_m : null,
  };
}
