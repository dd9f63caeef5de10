// Conversion of numbers to text. Unknown (null, undefined, NaN, infinite) is a dash, never 0.

import { lengthOf, speedOf, units } from "./units.js";

export const UNKNOWN = "–";
const NBSP = "\u00a0";
const MINUS = "\u2212";

export const known = (value) => typeof value === "number" && Number.isFinite(value);

/** A number with a fixed count of decimals and a real minus sign; "-0.0" is written "0.0". */
export function fixed(value, decimals = 0, { signed = false } = {}) {
  if (!known(value)) return UNKNOWN;
  const text = Math.abs(value).toFixed(decimals);
  const isZero = Number(text) === 0;
  if (isZero) return text;
  if (value < 0) return MINUS + text;
  return signed ? `+${text}` : text;
}

/** The same with its unit; an unknown value has none. */
function withUnit(value, decimals, unit, options) {
  return known(value) ? fixed(value, decimals, options) + unit : UNKNOWN;
}

/** Metres in the selected unit; from ten thousand of it on in the unit for long distances. */
export function length(metres) {
  if (!known(metres)) return UNKNOWN;
  const { name, far } = units.length;
  const value = lengthOf(metres);
  if (Math.abs(value) >= 9999.5) return withUnit(metres / far.metres, 1, NBSP + far.name);
  return withUnit(value, Math.abs(value) < 99.95 ? 1 : 0, NBSP + name);
}

export const degrees = (value, decimals = 1) => withUnit(value, decimals, "°");
export const signedDegrees = (value) => withUnit(value, 1, "°", { signed: true });
/** Metres per second in the selected unit. */
export const speed = (mps) =>
  withUnit(known(mps) ? speedOf(mps) : null, 1, NBSP + units.speed.name);
export const decibels = (value) => withUnit(value, 1, `${NBSP}dB`);
export const perSecond = (value) => withUnit(value, value < 10 ? 1 : 0, `${NBSP}/s`);

/** A bearing as three digits, 000° to 359°. */
export function bearing(value) {
  if (!known(value)) return UNKNOWN;
  const whole = ((Math.round(value) % 360) + 360) % 360;
  return `${String(whole).padStart(3, "0")}°`;
}

/** Seconds, with fewer decimals for larger values. */
export function seconds(value) {
  if (!known(value)) return UNKNOWN;
  const size = Math.abs(value);
  return withUnit(value, size < 9.995 ? 2 : size < 99.95 ? 1 : 0, `${NBSP}s`);
}

/** Least time written in seconds instead of milliseconds. */
const LONG_S = 9.9995;

export function milliseconds(valueS) {
  if (!known(valueS)) return UNKNOWN;
  return Math.abs(valueS) >= LONG_S
    ? seconds(valueS)
    : withUnit(valueS * 1000, 0, `${NBSP}ms`);
}

/** Two times in milliseconds: 2 / 5 ms. Each has its own unit if they differ. */
export function millisecondsRange(fromS, toS) {
  if (!known(fromS) || !known(toS)) return UNKNOWN;
  const from = Math.abs(toS) >= LONG_S ? milliseconds(fromS) : fixed(fromS * 1000);
  return `${from} / ${milliseconds(toS)}`;
}

/** A share of one as a percentage. */
export const share = (value) => withUnit(known(value) ? value * 100 : null, 0, `${NBSP}%`);

/** A readable duration: 42 s, 3 min 05 s, 2 h 07 min, 3 d 04 h. */
export function duration(valueS) {
  if (!known(valueS)) return UNKNOWN;
  const whole = Math.max(0, Math.floor(valueS));
  const two = (part) => String(part).padStart(2, "0");
  if (whole < 60) return `${whole}${NBSP}s`;
  if (whole < 3600) return `${Math.floor(whole / 60)}${NBSP}min ${two(whole % 60)}${NBSP}s`;
  const hours = Math.floor(whole / 3600);
  if (hours < 24) return `${hours}${NBSP}h ${two(Math.floor((whole % 3600) / 60))}${NBSP}min`;
  return `${Math.floor(hours / 24)}${NBSP}d ${two(hours % 24)}${NBSP}h`;
}

export function bytes(value) {
  if (!known(value)) return UNKNOWN;
  const units = ["B", "kB", "MB", "GB", "TB"];
  let scaled = value;
  let unit = 0;
  while (scaled >= 999.5 && unit < units.length - 1) {
    scaled /= 1000;
    unit += 1;
  }
  return withUnit(scaled, unit === 0 || scaled >= 99.95 ? 0 : 1, NBSP + units[unit]);
}

export function bitsPerSecond(value) {
  return known(value) && value >= 999.5 ? withUnit(value / 1000, value < 99_950 ? 1 : 0, `${NBSP}kbit/s`)
    : withUnit(value, 0, `${NBSP}bit/s`);
}

/** A count, with thousands separated by a narrow space: 12 345. */
export function count(value) {
  if (!known(value)) return UNKNOWN;
  return fixed(value, 0).replace(/\B(?=(\d{3})+(?!\d))/g, "\u202f");
}

export function hertz(value) {
  if (!known(value)) return UNKNOWN;
  if (value >= 1e9) return `${Number((value / 1e9).toFixed(2))}${NBSP}GHz`;
  if (value >= 1e6) return `${Number((value / 1e6).toFixed(2))}${NBSP}MHz`;
  return `${Number(value.toFixed(0))}${NBSP}Hz`;
}

/** The time of day of an RFC 3339 stamp, in UTC: 13:00:05. */
export function timeOfDay(stamp) {
  const date = new Date(stamp ?? NaN);
  return Number.isNaN(date.getTime()) ? UNKNOWN : date.toISOString().slice(11, 19);
}

/** The same with its zone: 13:00:05 UTC. */
export function clock(stamp) {
  const time = timeOfDay(stamp);
  return time === UNKNOWN ? UNKNOWN : `${time} UTC`;
}

/** Latitude and longitude with five decimals, about a metre. */
export function position(latDeg, lonDeg) {
  if (!known(latDeg) || !known(lonDeg)) return UNKNOWN;
  return `${fixed(latDeg, 5)}°, ${fixed(lonDeg, 5)}°`;
}
