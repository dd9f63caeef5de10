// The table of UAVs: one row per UAV, kept between updates so that focus and selection stay.

import { $, make, onRow, setAttribute, setText, toggleAttribute } from "./dom.js";
import * as format from "./format.js";
import { elsewhere, explain, rankOf } from "./health.js";
import { labelOf, meaningOf } from "./meanings.js";
import { Order } from "./order.js";

const halfWidthDeg = (array) =>
  format.known(array?.half_power_beamwidth_deg) ? array.half_power_beamwidth_deg / 2 : null;

/** The pointing bound with an explanation. Its effect on the link is in the verdict. */
function pointingBound({ beam, array }) {
  const bound = beam?.pointing_bound_deg;
  const text = format.degrees(bound, 2);
  const limit = halfWidthDeg(array);
  if (beam && !format.known(bound)) return { text, title: "No bound: the UAV can be anywhere" };
  if (!format.known(bound) || limit === null || bound <= limit) return { text };
  return { text, title: beam.widened ? "More than half the beamwidth: the beam is widened"
    : `More than half the beamwidth (${format.degrees(limit, 2)}): the beam may miss` };
}

/** The guaranteed gain that the verdict compares with the need, or why there is none. */
function guaranteedGain({ uav, beam }) {
  const gain = uav.health?.guaranteed_gain_db;
  const text = format.decibels(gain);
  if (!beam || format.known(gain)) return { text };
  return { text, title: "No guarantee: within its bound the UAV may be in a null, or out of"
    + " coverage" };
}

function range(uav) {
  const parts = [uav.north_m, uav.east_m, uav.down_m];
  return parts.every(format.known) ? Math.hypot(...parts) : null;
}

function bound({ uav }) {
  const text = format.length(uav.bound_m);
  if (uav.assumptions?.limits_source !== "raised") return { text };
  return {
    text: `▲ ${text}`, level: "warn",
    title: "Reports refuted an assumption about this aircraft, which was raised",
  };
}

/** Age from which on a UAV's values are shown as old. */
const OLD_S = 2;

const ageOf = ({ uav, sinceS }) => (format.known(uav.age_s) ? uav.age_s + sinceS : null);

function age(context) {
  const ageS = ageOf(context);
  const text = format.seconds(ageS);
  if (!(ageS > OLD_S)) return { text };
  return { text: `▲ ${text}`, level: "warn", title: "No recent report" };
}

/** The other nodes that serve a UAV, if this array has no beam for it. */
const servedBy = (uav) => (elsewhere(uav) ? `by ${elsewhere(uav)}` : null);

const STATES = ["live", "coasting", "stale", "lost"];

/**
 * Columns in order. `value`: class and name of the value, labelled by the service; `short`: label
 * for narrow screens; `feed`: answer with the value; `by`: sort key.
 */
const COLUMNS = [
  { key: "verdict", value: ["UavState", "verdict"], feed: "uavs",
    by: ({ uav }) => rankOf(uav),
    show: ({ uav }) => ({ text: uav.verdict ?? servedBy(uav) ?? format.UNKNOWN,
      title: explain(uav) }) },
  { key: "state", value: ["UavState", "state"], feed: "uavs", by: ({ uav }) => STATES.indexOf(uav.state),
    show: ({ uav }) => ({ text: uav.state }) },
  { key: "range", value: ["BeamState", "range_m"], feed: "uavs",
    by: ({ uav }) => range(uav), show: ({ uav }) => ({ text: format.length(range(uav)) }) },
  { key: "azimuth", value: ["BeamState", "azimuth_deg"], feed: "beams",
    by: ({ beam }) => beam?.azimuth_deg,
    show: ({ beam }) => ({ text: format.signedDegrees(beam?.azimuth_deg) }) },
  { key: "elevation", value: ["BeamState", "elevation_deg"], feed: "beams",
    by: ({ beam }) => beam?.elevation_deg,
    show: ({ beam }) => ({ text: format.signedDegrees(beam?.elevation_deg) }) },
  { key: "speed", value: ["UavState", "speed_mps"], feed: "uavs", by: ({ uav }) => uav.speed_mps,
    show: ({ uav }) => ({ text: format.speed(uav.speed_mps) }) },
  { key: "age", value: ["UavState", "age_s"], feed: "uavs",
    by: ({ uav }) => uav.age_s, show: age },
  { key: "dt", value: ["UavState", "dt_s"], feed: "uavs",
    by: ({ uav }) => uav.dt_s,
    show: ({ uav }) => ({ text: format.seconds(uav.dt_s) }) },
  { key: "latency", value: ["UavState", "latency_s"], feed: "uavs",
    by: ({ uav }) => uav.latency_s,
    show: ({ uav }) => ({ text: format.milliseconds(uav.latency_s) }) },
  { key: "bound", value: ["UavState", "bound_m"], feed: "uavs",
    by: ({ uav }) => uav.bound_m, show: bound },
  { key: "usual", value: ["UavState", "error_p95_m"], short: "Usual", feed: "uavs",
    by: ({ uav }) => uav.error_p95_m,
    show: ({ uav }) => ({ text: format.length(uav.error_p95_m) }) },
  { key: "pointing", value: ["BeamState", "pointing_bound_deg"], short: "Pointing", feed: "beams", by: ({ beam }) => beam?.pointing_bound_deg,
    show: pointingBound },
  { key: "gain", value: ["BeamState", "gain_db"], feed: "beams",
    by: ({ beam }) => beam?.gain_db,
    show: ({ beam }) => ({ text: format.decibels(beam?.gain_db) }) },
  { key: "guaranteed", value: ["LinkHealth", "guaranteed_gain_db"], short: "Guaranteed", feed: "uavs",
    by: ({ uav }) => uav.health?.guaranteed_gain_db, show: guaranteedGain },
];

const HEADS = [{ key: "id", value: ["UavState", "uav"] }, ...COLUMNS];

const nameCell = (cell, { value, short = labelOf(...value) }) =>
  setAttribute(cell, "data-label", short);

export class UavTable {
  constructor(table, onSelect, onOrder = () => {}) {
    this.body = table.tBodies[0];
    onRow(this.body, onSelect);
    this.rows = new Map();
    const head = table.tHead.rows[0];
    this.heads = HEADS.map(({ key }) => {
      const button = make("button", { type: "button", class: "sort" });
      const cell = make("th", { scope: "col", role: "columnheader", "data-key": key });
      cell.append(button);
      head.append(cell);
      return { cell, button };
    });
    this.showLabels();
    this.order = new Order(head, COLUMNS, onOrder);
    this.order.mark();
    // On small screens some columns are hidden until requested.
    $("all-columns").addEventListener("click", () => {
      const isAll = !table.hasAttribute("data-all");
      table.toggleAttribute("data-all", isAll);
      $("all-columns").setAttribute("aria-pressed", String(isAll));
    });
    this.ids = []; // in the order of the table
  }

  /** Label the columns with the service's labels, as far as they are loaded. */
  showLabels() {
    HEADS.forEach(({ value, short }, index) => {
      const { cell, button } = this.heads[index];
      setAttribute(cell, "title", meaningOf(...value) || labelOf(...value));
      setText(button, short ?? labelOf(...value));
    });
    for (const { cells } of this.rows.values()) {
      COLUMNS.forEach((column, index) => nameCell(cells[index].cell, column));
    }
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

  /** Scroll to a UAV's row. */
  reveal(id) {
    this.rows.get(id)?.line.scrollIntoView({ block: "nearest" });
  }

  addRow(id) {
    const line = make("tr", { role: "row", "data-id": id });
    const head = make("th", { scope: "row", role: "rowheader", "data-feed": "uavs" });
    const button = make("button", { type: "button", class: "pick" });
    button.textContent = id;
    head.append(button);
    line.append(head);
    const cells = COLUMNS.map((column) => {
      const cell = make("td", { role: "cell", "data-key": column.key, "data-feed": column.feed });
      nameCell(cell, column);
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
      setAttribute(cell, "title", oldS === undefined ? title : `Value from ${format.duration(oldS)} ago`);
    });
  }
}
