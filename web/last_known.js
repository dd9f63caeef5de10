// The last known state of the carrier and of each beam. It stays on the page, grey and with its age,
// since an empty picture would tell an operator less.

import { known } from "./format.js";
import { elsewhere } from "./health.js";
import { metresPerDegree, wrapDegrees } from "./trails.js";

export class LastKnown {
  constructor() {
    this.beams = new Map(); // by UAV: {beam, at}
    this.picture = null; // {uav, pattern, weights, patternBeams, at} of the beam that was shown
    this.first = null; // first known position of a UAV
  }

  /** Centre of the view: the carrier; a UAV's first position while the carrier's is unknown. */
  middle(carrier, uavs) {
    this.first ??= uavs.find(({ lat_deg: lat }) => known(lat)) ?? null;
    return carrier?.unseen ? this.first : carrier;
  }

  /** Store the state at `at`. */
  note({ uavs, beams, answer, pattern, weights, patternBeams }, uav, at) {
    const present = new Set(uavs.map(({ id }) => id));
    for (const id of this.beams.keys()) if (!present.has(id)) this.beams.delete(id);
    for (const beam of beams) this.beams.set(beam.uav, { beam, at });
    if (answer?.array) this.array = answer.array;
    if (uav !== null && pattern?.patterns.some((one) => one.uav === uav)) {
      // Weights are requested less often: those of the same beam are kept until new ones arrive.
      const before = this.picture?.uav === uav ? this.picture.weights : null;
      const has = weights?.uavs?.includes(uav);
      this.picture = { uav, pattern, weights: has ? weights : before, patternBeams, at };
    }
  }

  /**
   * The present beams, then the last beams of UAVs without one, with their age; except of UAVs that
   * another node serves now.
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
 * Position of the carrier, present or last: `{lat_deg, lon_deg, heading_deg, ageS, unfit}`; null
 * without a status. `ageS` is null for the present one; `unfit` is the reason why it is unknown;
 * `unseen`: it was never known.
 */
export function carrierOf(status) {
  const center = status?.center;
  if (!center) return null;
  // If this machine is overloaded, that is why its data of the carrier are old.
  const unfit = status.health?.behind ?? center.unfit;
  const last = known(center.lat_deg) ? center : center.last_known;
  if (!last) return { unfit, unseen: true };
  const ageS = last === center ? null : (Date.parse(status.time) - Date.parse(last.at)) / 1000;
  return { ...last, ageS, unfit };
}

/** A UAV with its offset from the carrier's last position, if the present one is unknown. */
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
