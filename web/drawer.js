// Details of one UAV, beside the page.

import { askOnce } from "./api.js";
import { $, make, setChildren, setText } from "./dom.js";
import * as format from "./format.js";
import { LEVEL_OF, elsewhere } from "./health.js";
import { labelOf, meaningOf } from "./meanings.js";
import { modeOf } from "./modes.js";

const ASK_MS = 2000;
const EVENTS_SHOWN = 8;
const NO_VOLTAGE = 65535; // SYS_STATUS: not measured

export class Drawer {
  constructor() {
    Object.assign(this, { id: null, messages: null, askedAt: -Infinity });
    $("drawer-close").addEventListener("click", () => this.close());
    $("copy").addEventListener("click", () => this.copy());
  }

  open(id) {
    if (this.id !== id) Object.assign(this, { id, messages: null, askedAt: -Infinity });
    $("drawer").hidden = false;
  }

  get isOpen() {
    return this.id !== null;
  }

  close() {
    this.id = null;
    $("drawer").hidden = true;
  }

  async copy() {
    const text = $("coordinates").textContent;
    try {
      await navigator.clipboard.writeText(text);
      setText($("copy"), "Copied");
    } catch {
      getSelection()?.selectAllChildren($("coordinates")); // for copying by hand
    }
  }

  /** Request its last messages, for battery and mode; a relayed aircraft has none. */
  async ask(now) {
    const [system, component] = this.id.split(":");
    if (!/^\d+$/.test(system) || now - this.askedAt < ASK_MS) return;
    this.askedAt = now;
    const { id } = this;
    const messages = await askOnce(
      `/v1/mavlink/vehicles/${system}/components/${component}/messages`,
    );
    if (id === this.id) this.messages = messages;
  }

  show({ uavs, events, links }, isLive, now) {
    if (!this.isOpen) return;
    const uav = uavs.find(({ id }) => id === this.id);
    if (!uav) {
      this.close();
      return;
    }
    if (isLive && isHeard(uav.id, links)) this.ask(now);
    setText($("drawer-title"), [uav.id, uav.callsign].filter(Boolean).join(" "));
    showVerdict(uav);
    const coordinates = coordinatesOf(uav);
    if ($("coordinates").textContent !== coordinates) setText($("copy"), "Copy");
    setText($("coordinates"), coordinates);
    const facts = factsOf(uav, isLive ? this.messages : null);
    setChildren($("drawer-facts"), facts, () => facts.map(([name, value, title = ""]) => make(
      "div", { title }, make("dt", {}, name), make("dd", {}, value),
    )));
    showLines($("drawer-rejections"), rejectionsOf(uav));
    showLines($("drawer-events"), eventsOf(uav, events));
  }
}

/** Whether a component is received here, and not only by another node. */
const isHeard = (uav, answer) => (answer?.links ?? [])
  .some(({ components }) => components?.some(({ id }) => id === uav));

function showVerdict(uav) {
  const { reason, remedy } = uav.health ?? {};
  $("drawer-verdict").dataset.level = LEVEL_OF[uav.verdict] ?? "wait";
  setText($("drawer-verdict"), verdictOf(uav));
  setText($("drawer-why"), [reason, remedy && `→ ${remedy}`].filter(Boolean).join(" "));
}

function verdictOf(uav) {
  if (uav.verdict) return `link ${uav.verdict}`;
  return elsewhere(uav) ? `served by ${elsewhere(uav)}` : "no link";
}

/** The form that maps and other programs accept: decimal degrees, and metres. */
function coordinatesOf({ lat_deg: lat, lon_deg: lon, alt_m: alt }) {
  if (![lat, lon].every(format.known)) return format.UNKNOWN;
  const up = format.known(alt) ? `, ${alt.toFixed(1)}` : "";
  return `${lat.toFixed(7)}, ${lon.toFixed(7)}${up}`;
}

function batteryOf(status) {
  if (!status) return format.UNKNOWN;
  const { voltage_battery: millivolts, battery_remaining: left } = status;
  return [
    format.known(left) && left >= 0 ? `${left} %` : null,
    format.known(millivolts) && millivolts !== NO_VOLTAGE ? `${(millivolts / 1000).toFixed(1)} V`
      : null,
  ].filter(Boolean).join(" · ") || format.UNKNOWN;
}

/** A fact with the service's label, and its meaning as a tooltip. */
const of = (kind, name, text) => [labelOf(kind, name), text, meaningOf(kind, name)];

function factsOf(uav, messages) {
  const message = (name) => messages?.[name]?.message;
  const { clock, assumptions, health } = uav;
  return [
    ["Mode", modeOf(message("HEARTBEAT")) ?? format.UNKNOWN],
    ["Battery", batteryOf(message("SYS_STATUS"))],
    of("UavState", "speed_mps", format.speed(uav.speed_mps)),
    of("UavState", "climb_rate_mps", format.speed(uav.climb_rate_mps)),
    of("LinkHealth", "needed_gain_db", format.decibels(health?.needed_gain_db)),
    of("LinkHealth", "likely_gain_db", format.decibels(health?.likely_gain_db)),
    of("LinkHealth", "guaranteed_gain_db", format.decibels(health?.guaranteed_gain_db)),
    of("UavState", "reports", `${format.count(uav.reports)}, ${format.seconds(uav.dt_s)} apart`),
    of("UavState", "latency_s", format.milliseconds(uav.latency_s)),
    of("UavState", "error_p95_m", format.length(uav.error_p95_m)),
    of("UavState", "bound_m", format.length(uav.bound_m)),
    ["Clock", clock ? `${clock.kind}, ${clock.guarantee}, to ${
      format.milliseconds(uav.clock_bound_s)}` : format.UNKNOWN],
    ["Assumed", assumptions?.speed_max_mps ? `${format.speed(assumptions.speed_max_mps)}, ${
      format.fixed(assumptions.acceleration_max_mps2, 1)} m/s² (${assumptions.limits_source})`
      : format.UNKNOWN],
  ];
}

const rejectionsOf = (uav) => (uav.recent_rejections ?? []).slice(-EVENTS_SHOWN).reverse()
  .map(({ at, reason, detail }) => [at, [reason, detail].filter(Boolean).join(": ")]);

/** Notices about this UAV: those whose text contains its id as a word. */
const eventsOf = (uav, answer) => (answer?.events ?? [])
  .filter(({ subject, text }) => subject === uav.id || text.match(/\w+:\w+/g)?.includes(uav.id))
  .slice(-EVENTS_SHOWN).reverse().map(({ at, text }) => [at, text]);

function showLines(list, lines) {
  list.closest("div").hidden = !lines.length;
  setChildren(list, lines, () => lines.map(([at, text]) => make("li", {},
    make("time", { datetime: at }, format.timeOfDay(at)), make("span", {}, text))));
}
