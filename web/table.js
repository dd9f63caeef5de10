// The table of UAVs: one row a UAV, kept between updates so that focus and selection stay.

import { $, make, setAttribute, setText, toggleAttribute } from "./dom.js";
import * as format from "./format.js";
import { elsewhere, explain, rankOf } from "./health.js";
import { Order } from "./order.js";

const halfWidthDeg = (array) =>
  format.known(array?.half_power_beamwidth_deg) ? array.half_power_beamwidth_deg / 2 : null;

/** The pointing bound, and what it means. Whether the link suffers by it is in the verdict. */
function pointingBound({ beam, array }) {
  const bound = beam?.pointing_bound_deg;
  const text = format.degrees(bound, 2);
  const limit = halfWidthDeg(array);
  if (beam && !format.known(bound)) return { text, title: "No bound: the UAV can be anywhere" };
  if (!format.known(bound) || limit === null || bound <= limit) return { text };
  return { text, title: beam.widened ? "More than half the beamwidth: the beam is broadened"
    : `More than half the beamwidth (${format.degrees(limit, 2)}): the beam may miss` };
}

/** The guaranteed gain, or what it means that there is none. */
function guaranteedGain({ beam }) {
  const text = format.decibels(beam?.guaranteed_gain_db);
  if (!beam || format.known(beam.guaranteed_gain_db)) return { text };
  return { text, title: "Nothing is guaranteed: within its bound the UAV may be in a null, or out"
    + " of coverage" };
}

function range(uav) {
  const parts = [uav.north_m, uav.east_m, uav.down_m];
  return parts.every(format.known) ? Math.hypot(...parts) : null;
}

function bound({ uav }) {
  const text = format.length(uav.bound_m);
  if (uav.assumptions?.source !== "raised") return { text };
  return {
    text: `▲ ${text}`, level: "warn",
    title: "Its reports refuted what was assumed of this aircraft: it was raised",
  };
}

/** Older than this, a UAV's values are drawn as old. */
const OLD_S = 2;

const ageOf = ({ uav, sinceS }) => (format.known(uav.age_s) ? uav.age_s + sinceS : null);

function age(context) {
  const ageS = ageOf(context);
  const text = format.seconds(ageS);
  if (!(ageS > OLD_S)) return { text };
  return { text: `▲ ${text}`, level: "warn", title: "No report lately" };
}

/** Whom no beam of this array is for, for another node serves it. */
const servedBy = (uav) => (elsewhere(uav) ? `by ${elsewhere(uav)}` : null);

const STATES = ["live", "coasting", "stale", "lost"];

/**
 * Columns in their order. `feed`: which answer a value stands on; `short`: for narrow screens; `by`:
 * what it is sorted by.
 */
const COLUMNS = [
  { key: "verdict", label: "Link", feed: "uavs", title: "Whether its beam has the gain it needs",
    by: ({ uav }) => rankOf(uav),
    show: ({ uav }) => ({ text: uav.verdict ?? servedBy(uav) ?? format.UNKNOWN,
      title: explain(uav) }) },
  { key: "state", label: "State", feed: "uavs", by: ({ uav }) => STATES.indexOf(uav.state),
    show: ({ uav }) => ({ text: uav.state }) },
  { key: "range", label: "Range", feed: "uavs", title: "Slant range from the carrier",
    by: ({ uav }) => range(uav), show: ({ uav }) => ({ text: format.length(range(uav)) }) },
  { key: "azimuth", label: "Azimuth", feed: "beams", title: "Right of the array's boresight",
    by: ({ beam }) => beam?.azimuth_deg,
    show: ({ beam }) => ({ text: format.signedDegrees(beam?.azimuth_deg) }) },
  { key: "elevation", label: "Elevation", feed: "beams", title: "Above the array's boresight",
    by: ({ beam }) => beam?.elevation_deg,
    show: ({ beam }) => ({ text: format.signedDegrees(beam?.elevation_deg) }) },
  { key: "speed", label: "Speed", feed: "uavs", by: ({ uav }) => uav.speed_mps,
    show: ({ uav }) => ({ text: format.speed(uav.speed_mps) }) },
  { key: "age", label: "Age", feed: "uavs", title: "Since the newest accepted report",
    by: ({ uav }) => uav.age_s, show: age },
  { key: "dt", label: "ΔT", feed: "uavs", title: "Last interval between reports",
    by: ({ uav }) => uav.dt_s,
    show: ({ uav }) => ({ text: format.seconds(uav.dt_s) }) },
  { key: "latency", label: "Latency", feed: "uavs",
    title: "From when it was true to arrival; below 0: the autopilot says where it will be",
    by: ({ uav }) => uav.latency_s,
    show: ({ uav }) => ({ text: format.milliseconds(uav.latency_s) }) },
  { key: "bound", label: "Bound", feed: "uavs", title: "Guaranteed position error, at most",
    by: ({ uav }) => uav.bound_m, show: bound },
  { key: "usual", label: "Usual error", short: "Usual", feed: "uavs",
    title: "Usual error: 95 of 100 predictions at this age were nearer, of late",
    by: ({ uav }) => uav.error_p95_m,
    show: ({ uav }) => ({ text: format.length(uav.error_p95_m) }) },
  { key: "pointing", label: "Pointing bound", short: "Pointing", feed: "beams",
    title: "Pointing bound: how far the true direction can lie from the beam", by: ({ beam }) => beam?.pointing_bound_deg,
    show: pointingBound },
  { key: "gain", label: "Gain", feed: "beams", title: "Array gain towards the prediction",
    by: ({ beam }) => beam?.gain_db,
    show: ({ beam }) => ({ text: format.decibels(beam?.gain_db) }) },
  { key: "guaranteed", label: "Guaranteed gain", short: "Guaranteed", feed: "beams",
    title: "Guaranteed gain: the least gain wherever the UAV truly is within its bound", by: ({ beam }) => beam?.guaranteed_gain_db,
    show: guaranteedGain },
];

export class UavTable {
  constructor(table, onSelect, onOrder = () => {}) {
    this.body = table.tBodies[0];
    this.onSelect = onSelect;
    this.rows = new Map();
    const head = table.tHead.rows[0];
    for (const { label, title, key, short = label } of [{ label: "UAV", key: "id" }, ...COLUMNS]) {
      const cell = make("th", { scope: "col", role: "columnheader", "data-key": key });
      cell.title = title ?? label;
      cell.append(make("button", { type: "button", class: "sort" }, short));
      head.append(cell);
    }
    this.order = new Order(head, COLUMNS, onOrder);
    this.order.mark();
    // Where there is little room, some columns are folded until they are asked for.
    $("all-columns").addEventListener("click", () => {
      const isAll = !table.hasAttribute("data-all");
      table.toggleAttribute("data-all", isAll);
      $("all-columns").setAttribute("aria-pressed", String(isAll));
    });
    this.ids = []; // as they stand in the table
  }

  /** Show these UAVs. `sinceS`: seconds since the answer came. */
  update(all, { beams, array, sinceS, selected }) {
    const uavs = this.order.arrange(all, beams);
    this.ids = uavs.map(({ id }) => id);
    const present = new Set(uavs.map((uav) => uav.id));
    for (const [id, row] of this.rows) {
      if (!present.has(id)) {
        row.line.remove();
        this.rows.delete(id);
      }
    }
    uavs.forEach((uav, index) => {
      const row = this.rows.get(uav.id) ?? this.addRow(uav.id);
      if (this.body.rows[index] !== row.line) {
        this.body.insertBefore(row.line, this.body.rows[index] ?? null);
      }
      this.fill(row, { uav, beam: beams.get(uav.id), array, sinceS }, uav.id === selected);
    });
  }

  /** Bring a UAV's row into sight. */
  reveal(id) {
    this.rows.get(id)?.line.scrollIntoView({ block: "nearest" });
  }

  addRow(id) {
    const line = make("tr", { role: "row" });
    const head = make("th", { scope: "row", role: "rowheader", "data-feed": "uavs" });
    const button = make("button", { type: "button", class: "pick" });
    button.textContent = id;
    button.addEventListener("click", () => this.onSelect(id));
    head.append(button);
    line.append(head);
    const cells = COLUMNS.map(({ key, label, short = label, feed }) => {
      const cell = make("td", {
        role: "cell", "data-key": key, "data-label": short, "data-feed": feed,
      });
      const value = make("span");
      cell.append(value);
      line.append(cell);
      return { cell, value };
    });
    const row = { line, button, cells };
    this.rows.set(id, row);
    return row;
  }

  fill(row, context, isSelected) {
    setAttribute(row.line, "data-state", context.uav.state);
    setAttribute(row.line, "data-verdict", context.uav.verdict ?? "");
    toggleAttribute(row.line, "data-elsewhere", Boolean(elsewhere(context.uav)));
    toggleAttribute(row.line, "data-old", ageOf(context) > OLD_S);
    toggleAttribute(row.line, "data-selected", isSelected);
    setAttribute(row.button, "aria-pressed", String(isSelected));
    COLUMNS.forEach((column, index) => {
      const { cell, value } = row.cells[index];
      const { text, level = "", title = "" } = column.show(context);
      const oldS = column.feed === "beams" ? context.beam?.oldS : undefined;
      setText(value, text);
      toggleAttribute(cell, "data-old", oldS !== undefined);
      setAttribute(cell, "data-level", level);
      setAttribute(cell, "title", oldS === undefined ? title : `As ${format.duration(oldS)} ago`);
    });
  }
}
