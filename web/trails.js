// Trails of the UAVs. Points are stored as Earth coordinates, not relative to the carrier, so that a
// trail stays in place when the carrier moves.

import { known } from "./format.js";

const KEEP_MS = 45_000;
const FIXES_MS = 12_000;
const WGS84_A_M = 6378137.0;
const WGS84_E2 = 6.69437999014e-3;

/** Metres north and east for a degree of latitude and of longitude (WGS84 radii of curvature). */
export function metresPerDegree(latDeg) {
  const lat = (latDeg * Math.PI) / 180;
  const w2 = 1 - WGS84_E2 * Math.sin(lat) ** 2;
  const perDegree = Math.PI / 180;
  return {
    north: (perDegree * WGS84_A_M * (1 - WGS84_E2)) / w2 ** 1.5,
    east: (perDegree * WGS84_A_M * Math.cos(lat)) / Math.sqrt(w2),
  };
}

/**
 * The trail of a UAV in metres relative to the carrier, oldest first, ending at the UAV:
 * `{north, east, velocity, age: 0 new … 1 old, measured, at}`. `at` is the displayed time.
 */
export function trailOf(uav, history, at) {
  const scale = metresPerDegree(uav.lat_deg);
  const moments = history.between(at - KEEP_MS, at);
  return moments.flatMap((moment) => {
    const then = moment.byId.get(uav.id);
    if (!known(then?.lat_deg) || !known(then.lon_deg)) return [];
    return [{
      north: uav.north_m + (then.lat_deg - uav.lat_deg) * scale.north,
      east: uav.east_m + wrapDegrees(then.lon_deg - uav.lon_deg) * scale.east,
      velocity: then.velocity_ned_mps,
      age: Math.min(1, (at - moment.at) / KEEP_MS),
      measured: then.state === "live",
      at: moment.at,
    }];
  });
}

/**
 * Reported positions of a UAV in metres relative to the carrier: `{north, east, age: 0 … 1}`, the
 * newest reports, each once.
 */
export function fixesOf(uav, history, at) {
  const scale = metresPerDegree(uav.lat_deg);
  const seen = new Map();
  for (const moment of history.between(at - FIXES_MS, at)) {
    const fix = moment.byId.get(uav.id)?.fix;
    if (known(fix?.lat_deg) && known(fix.lon_deg)) seen.set(fix.at, { fix, shownAt: moment.at });
  }
  return [...seen.values()].map(({ fix, shownAt }) => ({
    north: uav.north_m + (fix.lat_deg - uav.lat_deg) * scale.north,
    east: uav.east_m + wrapDegrees(fix.lon_deg - uav.lon_deg) * scale.east,
    age: Math.min(1, (at - shownAt) / FIXES_MS),
  }));
}

export const wrapDegrees = (angle) => ((((angle + 180) % 360) + 360) % 360) - 180;
