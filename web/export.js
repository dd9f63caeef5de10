// Export of the displayed data: the table as CSV, the plan view as PNG.

import { make } from "./dom.js";
import { known } from "./format.js";
import { lengthOf, speedOf, units } from "./units.js";

const FIELDS = ["id", "verdict", "state", "lat_deg", "lon_deg", "alt_m", "north_m", "east_m",
  "down_m", "speed_mps", "age_s", "dt_s", "latency_s", "bound_m", "error_p95_m"];
const OF_BEAM = ["azimuth_deg", "elevation_deg", "range_m", "pointing_bound_deg", "gain_db",
  "guaranteed_gain_db"];

/** Name and value in the selected units, rounded to a thousandth; SI values unchanged. */
function inUnits(name, value) {
  const [, stem, unit] = /^(.*)_(m|mps)$/.exec(name) ?? [];
  if (stem === undefined) return [name, value];
  const [{ field }, convert] = unit === "m" ? [units.length, lengthOf] : [units.speed, speedOf];
  if (field === unit || !known(value)) return [`${stem}_${field}`, value];
  return [`${stem}_${field}`, Number(convert(value).toFixed(3))];
}

const quoted = (value) => (/[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : value);
const cell = (value) => quoted(value === null || value === undefined ? "" : String(value));

/** Comma-separated values, one line per UAV; unknown values are empty, never 0. */
export function csvOf({ stamp, uavs, beams }) {
  const byId = new Map(beams.filter(({ oldS }) => oldS === undefined)
    .map((beam) => [beam.uav, beam]));
  const named = [...FIELDS, ...OF_BEAM].map((name) => inUnits(name)[0]);
  const head = ["valid_at", ...named, "cause", "reason"];
  const valuesOf = (names, from) => names.map((name) => inUnits(name, from?.[name])[1]);
  const lines = uavs.map((uav) => [stamp, ...valuesOf(FIELDS, uav),
    ...valuesOf(OF_BEAM, byId.get(uav.id)), uav.health?.cause, uav.health?.reason]);
  return [head, ...lines].map((line) => line.map(cell).join(",")).join("\n").concat("\n");
}

export function save(blob, name) {
  const url = URL.createObjectURL(blob);
  make("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
