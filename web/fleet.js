// The fleet, if this node is in one: its nodes, the UAVs that each serves, the offers of each node,
// and the newest handovers.

import { $, make, onRow, setAttribute, setChildren, setText, toggleAttribute } from "./dom.js";
import * as format from "./format.js";
import { byId } from "./health.js";
import { labelOf, meaningOf } from "./meanings.js";
import { placedBy } from "./last_known.js";

const HANDOVERS_KEPT = 30;
/** Severity of each state of a node. */
export const NODE_LEVELS = {
  here: "good", there: "good", silent: "warn", aside: "bad", gone: "bad",
};

/** The part of an answer kept in the history: with the newest handovers only. */
export const slimFleet = (answer) => answer
  && { ...answer, handovers: answer.handovers.slice(-HANDOVERS_KEPT) };

/** The other nodes with a known position, relative to the centre of the plan view. */
export function nodesAround(answer, middle) {
  return (answer?.nodes ?? []).filter((one) => !one.is_self && one.place)
    .map(({ node, state, place }) => placedBy({ node, state, ...place }, middle))
    .filter(({ north_m: north, east_m: east }) => format.known(north) && format.known(east));
}

// --- nodes --------------------------------------------------------------------------------------

function clockOf({ clock_offset_s: offsetS, clock_doubt_s: doubtS }) {
  if (!format.known(offsetS)) return format.UNKNOWN;
  const isFar = Math.abs(offsetS) >= 1; // in seconds then
  const [unit, each] = isFar ? ["s", 1] : ["ms", 1000];
  return [format.fixed(offsetS * each, isFar ? 3 : 1, { signed: true }), "±",
    format.fixed((doubtS / 2) * each, isFar ? 3 : 1), unit].join("\u00a0");
}

const NODE_VALUES = [
  ["serves", ({ serves, most }) => serves + (format.known(most) ? ` of ${most}` : "")],
  ["clock_offset_s", clockOf],
  ["way_p99_ms", ({ way_p99_ms: ms }) => format.milliseconds(format.known(ms) ? ms / 1000 : null)],
  ["used", ({ used }) => format.count(used)],
];

function nodeItem(one) {
  const since = ["silent", "gone"].includes(one.state) && format.known(one.heard_s)
    ? ` ${format.duration(one.heard_s)}` : "";
  const head = make("p", { class: "link-head", "data-level": NODE_LEVELS[one.state] ?? "warn" },
    make("span", {}, one.node), make("b", {}, one.is_self ? "this node" : one.state + since));
  const facts = NODE_VALUES.slice(0, one.is_self ? 1 : undefined).map(([name, show]) => make(
    "div", { title: meaningOf("FleetNode", name) },
    make("dt", {}, labelOf("FleetNode", name)), make("dd", {}, show(one)),
  ));
  const item = make("li", {}, head, make("dl", { class: "link-facts" }, ...facts));
  if (one.reason) item.append(make("p", { class: "muted" }, `not trusted: it ${one.reason}`));
  return item;
}

function trafficOf({ sent_bps: sent, heard_bps: heard, damaged, untold }) {
  const parts = [`sent ${format.bitsPerSecond(sent)}`, `received ${format.bitsPerSecond(heard)}`];
  if (damaged) parts.push(`▲ ${format.count(damaged)} malformed`);
  if (untold) parts.push(`▲ ${format.count(untold)} not shared`);
  return parts.join(" · ");
}

// --- served UAVs --------------------------------------------------------------------------------

/** The nodes that serve a UAV as text, and the severity; `rank`: the worst has the lowest. */
export function servingOf({ served_by: by, handing_to: to, unconfirmed }) {
  const parts = [by.join(" and ") || "no node"];
  if (by.length > 1) parts[0] = `twice: ${parts[0]}`;
  if (to && !by.includes(to)) parts[0] += ` → ${to}`;
  if (unconfirmed) parts.push("unconfirmed");
  const bad = by.length === 0;
  const warn = by.length > 1 || unconfirmed;
  const title = [
    bad ? "No node serves it" : "",
    by.length > 1 ? "During a handover, or while the fleet is partitioned" : "",
    to ? `Being handed over to ${to}` : "",
    unconfirmed ? "Only one node receives it, though others should" : "",
  ].filter(Boolean).join(". ");
  return { text: parts.join(" · "), title, level: bad ? "bad" : warn ? "warn" : "",
    rank: bad ? 0 : warn ? 1 : to ? 2 : 3 };
}

/** An offer: guaranteed gain, likely gain, SINR. */
function offerOf(offer) {
  if (!offer) return { text: format.UNKNOWN, title: "no offer" };
  const { sure_db: sure, likely_db: likely, sinr_db: sinr, heard_s: heardS } = offer;
  const heard = format.known(heardS) ? `received ${format.seconds(heardS)} ago`
    : "never received there";
  if (!format.known(sinr)) return { text: format.UNKNOWN, title: `cannot serve it; ${heard}` };
  return {
    text: `${format.fixed(sure, 1)} / ${format.fixed(likely, 1)} · ${format.fixed(sinr)}`,
    title: `guaranteed ${format.decibels(sure)}, likely ${format.decibels(likely)}, SINR ${
      format.decibels(sinr)}; ${heard}`,
  };
}

const asId = ({ uav }) => ({ id: uav });
const ORDERS = {
  id: (a, b) => byId(asId(a), asId(b)),
  served: (a, b) => servingOf(a).rank - servingOf(b).rank || ORDERS.id(a, b),
};

export class FleetView {
  constructor(onSelect) {
    Object.assign(this, { rows: new Map(), nodes: null, order: "served", last: null });
    [this.head, this.body] = [$("fleet-uavs").tHead.rows[0], $("fleet-uavs").tBodies[0]];
    onRow(this.body, onSelect);
    this.head.addEventListener("click", (event) => {
      const key = event.target.closest("th")?.dataset.key;
      if (!(key in ORDERS)) return;
      this.order = key;
      if (this.last) this.show(...this.last);
    });
  }

  /** Show an answer of /v1/fleet; all of it is hidden if this node is not in a fleet. */
  show(answer, selected) {
    this.last = [answer, selected];
    const has = Boolean(answer?.node);
    for (const id of ["fleet-panel", "fleet"]) $(id).hidden = !has;
    for (const one of $("legend").querySelectorAll("[data-fleet]")) one.hidden = !has;
    if (!has) return;
    setText($("fleet-site"), answer.site ?? "");
    setChildren($("fleet-nodes"), answer.nodes, () => answer.nodes.map(nodeItem));
    setText($("fleet-traffic"), trafficOf(answer));
    this.showUavs(answer, selected);
    showHandovers(answer.handovers);
  }

  showUavs({ nodes, uavs }, selected) {
    const offering = nodes.filter(({ state }) => !["aside", "gone"].includes(state));
    const names = offering.map(({ node }) => node);
    this.makeColumns(names);
    const present = new Set(uavs.map(({ uav }) => uav));
    for (const [id, { line }] of this.rows) {
      if (present.has(id)) continue;
      line.remove();
      this.rows.delete(id);
    }
    [...uavs].sort(ORDERS[this.order]).forEach((uav, index) => {
      const row = this.rows.get(uav.uav) ?? this.addRow(uav.uav, names);
      if (this.body.rows[index] !== row.line) {
        this.body.insertBefore(row.line, this.body.rows[index] ?? null);
      }
      fill(row, uav, names, uav.uav === selected);
    });
    $("fleet-empty").hidden = uavs.length > 0;
  }

  /** A column for each node; the rows are rebuilt if the nodes have changed. */
  makeColumns(names) {
    setAttribute(this.head.children[0], "aria-sort", this.order === "id" ? "ascending" : "none");
    setAttribute(this.head.children[1], "aria-sort",
      this.order === "served" ? "ascending" : "none");
    if (names.join() === this.nodes) return;
    this.nodes = names.join();
    const fixed = [...this.head.children].slice(0, 2);
    this.head.replaceChildren(...fixed, ...names.map((name) => make(
      "th", { scope: "col", role: "columnheader" }, name,
    )));
    for (const { line } of this.rows.values()) line.remove();
    this.rows.clear();
  }

  addRow(id, names) {
    const button = make("button", { type: "button", class: "pick" }, id);
    const cells = ["Served by", ...names].map((label, index) => make("td", {
      role: "cell", "data-label": label, "data-key": index ? "offer" : "served",
    }, make("span", {}, "")));
    const line = make("tr", { role: "row", "data-id": id },
      make("th", { scope: "row", role: "rowheader" }, button), ...cells);
    const row = { line, button, cells };
    this.rows.set(id, row);
    return row;
  }
}

function fill({ line, button, cells: [served, ...offers] }, uav, names, isSelected) {
  setAttribute(button, "aria-pressed", String(isSelected));
  toggleAttribute(line, "data-selected", isSelected);
  const { text, title, level } = servingOf(uav);
  setText(served.children[0], text);
  setAttribute(served, "title", title);
  setAttribute(served, "data-level", level);
  offers.forEach((cell, index) => {
    const said = offerOf(uav.offers.find(({ node }) => node === names[index]));
    setText(cell.children[0], said.text);
    setAttribute(cell, "title", said.title);
    toggleAttribute(cell, "data-serves", uav.served_by.includes(names[index]));
  });
}

/** The newest first. */
function showHandovers(handovers) {
  const shown = handovers.slice(-HANDOVERS_KEPT).reverse();
  setChildren($("fleet-handovers"), shown, () => (shown.length
    ? shown.map(({ time, uav, before, after }) => make("li", {},
      make("time", { datetime: time }, format.timeOfDay(time)),
      make("span", {}, `${uav}: ${before ?? "none"} → ${after ?? "none"}`)))
    : [make("li", { class: "muted" }, "none")]));
}
