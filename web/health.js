// Verdicts on the links to UAVs, worst first: the headline, and remedies for weak links.

import { $, make, setChildren, setText } from "./dom.js";
import { known } from "./format.js";

/** From worst to best; a UAV without a verdict is not a target, and comes last. */
export const LEVELS = ["none", "weak", "good"];
/** Colour and mark of each level. */
export const LEVEL_OF = { none: "bad", weak: "warn", good: "good" };
export const MARKS = { none: "✕", weak: "▲", good: "●" };
const MOST_SHOWN = 8;
const MOST_NAMED = 5;

export const rankOf = (uav) => (LEVELS.includes(uav.verdict)
  ? LEVELS.indexOf(uav.verdict) : LEVELS.length);

const COLLATOR = new Intl.Collator("en", { numeric: true });
const STEP_DB = 6; // links that differ by less rank equal, so that rows seldom change places

export const byId = (a, b) => COLLATOR.compare(a.id, b.id);

/** Gain of a link beyond what it needs, in steps; unknown is the lowest. */
function spareOf({ health }, gain) {
  const spareDb = (health?.[gain] ?? NaN) - (health?.needed_gain_db ?? NaN);
  return Number.isFinite(spareDb) ? Math.floor(spareDb / STEP_DB) : -Infinity;
}

const bySpare = (a, b, gain) => {
  const [one, other] = [spareOf(a, gain), spareOf(b, gain)];
  return one === other ? 0 : one - other;
};

/** The other nodes that serve a UAV, if this node does not; they assess its link. */
export const elsewhere = (uav) => (!uav.verdict && uav.served_by?.length
  ? uav.served_by.join(", ") : null);

/** The worst link first: by verdict, then by guaranteed gain, then by likely gain. */
export const worstFirst = (a, b) => rankOf(a) - rankOf(b)
  || bySpare(a, b, "guaranteed_gain_db") || bySpare(a, b, "likely_gain_db") || byId(a, b);

const of = (uavs, level) => uavs.filter((uav) => uav.verdict === level);

/** The headline, and its severity. */
export function headlineOf(uavs) {
  const judged = uavs.filter((uav) => rankOf(uav) < LEVELS.length);
  const others = uavs.filter(elsewhere).length;
  const besides = others ? `${others} with other nodes` : "";
  if (!judged.length) return { text: besides || "no link assessed yet", level: "wait" };
  const good = of(judged, "good").length;
  const text = [`${good} of ${judged.length} links good`, besides].filter(Boolean).join(" · ");
  const worst = LEVELS.find((level) => of(judged, level).length);
  return { text, level: LEVEL_OF[worst] };
}

export function showHeadline(uavs) {
  const { text, level } = headlineOf(uavs);
  $("headline").dataset.level = level;
  setText($("headline"), text);
}

/** Links that are not good, grouped by cause, the worst first. */
export function troublesOf(uavs) {
  const alike = new Map();
  for (const uav of [...uavs].sort(worstFirst)) {
    if (!["none", "weak"].includes(uav.verdict)) continue;
    const { cause, reason, remedy } = uav.health ?? {};
    const key = `${uav.verdict} ${cause}`;
    if (!alike.has(key)) alike.set(key, { level: uav.verdict, reason, remedy, ids: [] });
    const found = alike.get(key);
    found.ids.push(uav.id);
    found.differ ||= found.reason !== reason;
  }
  return [...alike.values()];
}

function troubleItem({ level, reason, remedy, ids, differ }, onSelect) {
  const names = ids.slice(0, MOST_NAMED).map((id) => {
    const pick = make("button", { type: "button", class: "name" }, id);
    pick.addEventListener("click", () => onSelect(id));
    return pick;
  });
  if (ids.length > MOST_NAMED) names.push(`and ${ids.length - MOST_NAMED} more`);
  const such = differ ? `such as: ${reason}` : reason;
  return make("li", { "data-level": LEVEL_OF[level] },
    make("p", { class: "who" }, ...names.flatMap((name) => [name, " "]), make("b", {}, level)),
    make("p", {}, such ?? "no reason given"),
    make("p", { class: "muted" }, remedy ? `→ ${remedy}` : ""));
}

/** Causes and remedies of weak links; empty if all are good. */
export function showTroubles(uavs, onSelect) {
  const all = troublesOf(uavs);
  const shown = all.slice(0, MOST_SHOWN);
  $("troubles-panel").hidden = !all.length;
  setChildren($("troubles"), shown, () => shown.map((one) => troubleItem(one, onSelect)));
}

/** The reason of a verdict as text: for the tooltip, and for screen readers. */
export function explain(uav) {
  const others = elsewhere(uav);
  if (others) return `Served by ${others}, which assesses its link`;
  const { reason, remedy, needed_gain_db: needed } = uav.health ?? {};
  if (uav.verdict === "good") {
    return known(needed) ? `Guaranteed gain is at least the ${needed.toFixed(1)} dB that it needs` : "";
  }
  return [reason, remedy].filter(Boolean).join(". To do: ");
}
