// Where each UAV has been. Points are kept on the earth, not relative to the carrier, so that a
// trail stays where it was flown when the carrier moves.

import { known } from "./format.js";

const KEEP_MS = 45_000;
const SPACING_MS = 300;
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

export class Trails {
  constructor() {
    this.byUav = new Map();
  }

  /** Take the positions of one answer; forget UAVs that it no longer has. */
  add(uavs, now) {
    const present = new Set(uavs.map((uav) => uav.id));
    for (const id of this.byUav.keys()) if (!present.has(id)) this.byUav.delete(id);
    for (const uav of uavs) {
      if (!known(uav.lat_deg) || !known(uav.lon_deg)) continue;
      const points = this.byUav.get(uav.id) ?? [];
      this.byUav.set(uav.id, points);
      if (points.length && now - points.at(-1).at < SPACING_MS) continue;
      points.push({
        at: now, latDeg: uav.lat_deg, lonDeg: uav.lon_deg, measured: uav.state === "live",
      });
      while (now - points[0].at > KEEP_MS) points.shift();
    }
  }

  /**
   * The trail of a UAV in metres relative to the carrier, oldest first, ending at the UAV:
   * `{north, east, age: 0 new … 1 old, measured, at}`.
   */
  of(uav, now) {
    const points = this.byUav.get(uav.id) ?? [];
    const scale = metresPerDegree(uav.lat_deg);
    const trail = points.map((point) => ({
      north: uav.north_m + (point.latDeg - uav.lat_deg) * scale.north,
      east: uav.east_m + wrapDegrees(point.lonDeg - uav.lon_deg) * scale.east,
      age: Math.min(1, (now - point.at) / KEEP_MS),
      measured: point.measured,
      at: point.at,
    }));
    trail.push({
      north: uav.north_m, east: uav.east_m, age: 0, measured: uav.state === "live", at: now,
    });
    return trail;
  }
}

const wrapDegrees = (angle) => ((((angle + 180) % 360) + 360) % 360) - 180;
