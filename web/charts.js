// Time series of the last minutes, one line per UAV: one chart for each value that must stay small
// (or, for gain, large). Drawn by uPlot, which is loaded as a plain script (vendor/README.md).

import { $, make, setChildren, setText } from "./dom.js";
import { known } from "./format.js";
import { fontOf, readColours } from "./surface.js";
import { lengthOf, units } from "./units.js";

const SPANS_S = [30, 60, 180]; // the shortest that contains all samples is used
const GAP_MS = 2500; // no line across a longer gap
const MOST_LINES = 7; // number of hues that are easy to distinguish
const REDRAW_MS = 2000; // a second is less than a pixel
const LASTING_MS = 10_000;
/** Every line also has its own dash, so that no UAV is identified by colour alone. */
const DASHES = [[], [7, 3], [2, 3], [10, 3, 2, 3], [4, 2], [14, 4], [2, 6]];
const HUES = DASHES.map((_, i) => `line${i}`);

const CHARTS = [
  { id: "pointing", of: (_, beam) => beam?.pointing_bound_deg },
  { id: "innovation", of: (uav) => (known(uav.innovation_m) ? lengthOf(uav.innovation_m) : null) },
  { id: "latency", of: (uav) => (known(uav.latency_s) ? uav.latency_s * 1000 : null) },
  { id: "gain", of: (_, beam) => beam?.guaranteed_gain_db },
];

const COLLATOR = new Intl.Collator("en", { numeric: true });

/** UAVs to draw: the selected one, then those with the worst links; in a stable order. */
function chosenFew(uavs, selected) {
  const ids = uavs.map((uav) => uav.id);
  const few = ids.slice(0, MOST_LINES);
  if (selected !== null && !few.includes(selected)) few[few.length - 1] = selected;
  return few.sort(COLLATOR.compare);
}

/** Columns for uPlot: seconds before now, then the values of each UAV; null for unknown. */
function columns(moments, ids, of, now) {
  const table = [[], ...ids.map(() => [])];
  const row = (at, values) => [(at - now) / 1000, ...values].forEach((v, i) => table[i].push(v));
  moments.forEach((moment, i) => {
    const before = moments[i - 1];
    if (before && moment.at - before.at > GAP_MS) row(before.at + 1, ids.map(() => null));
    const beams = new Map(moment.beams.map((beam) => [beam.uav, beam]));
    row(moment.at, ids.map((id) => {
      const uav = moment.byId.get(id);
      const value = uav && of(uav, beams.get(id));
      return known(value) ? value : null;
    }));
  });
  return table;
}

export class Charts {
  constructor(onPick) {
    Object.assign(this, { onPick, plots: [], ids: null, selected: null, drawnAt: -Infinity, pastAt: null });
    [this.spanS] = SPANS_S;
    for (const { id } of CHARTS) {
      new ResizeObserver(() => this.fit()).observe($(`chart-${id}`));
    }
    this.recolour();
  }

  recolour() {
    this.colour = readColours([...HUES, "grid", "muted", "mark"]);
    this.font = `11px ${fontOf()}`;
    this.ids = null; // rebuilt with the new colours
  }

  changeUnits() {
    setText($("innovation-unit"), units.length.name);
    this.drawnAt = -Infinity;
  }

  fit() {
    for (const { plot, box } of this.plots) {
      if (box.clientWidth) plot.setSize({ width: box.clientWidth, height: box.clientHeight });
    }
  }

  /** `pastAt`: the moment shown by the page, null while it is live. */
  show(history, uavs, { selected, pastAt, now }) {
    const ids = this.lasting(chosenFew(uavs, selected), uavs, selected, now);
    const changed = this.ids === null || ids.join() !== this.ids.join()
      || selected !== this.selected;
    const due = pastAt !== this.pastAt || now - this.drawnAt > REDRAW_MS;
    if (!changed && !due) return;
    Object.assign(this, { selected, pastAt, drawnAt: now, now });
    if (changed) this.build(ids, uavs.length);
    const begins = history.moments[0]?.at ?? Infinity;
    const oldestS = (now - Math.min(now, begins)) / 1000;
    this.spanS = SPANS_S.find((spanS) => spanS >= oldestS) ?? SPANS_S.at(-1);
    const moments = history.between(now - this.spanS * 1000, now);
    CHARTS.forEach(({ of }, i) => this.plots[i].plot.setData(columns(moments, ids, of, now)));
  }

  /** Keep the lines for a while although other links are now worse: changing them is expensive. */
  lasting(wanted, uavs, selected, now) {
    const present = new Set(uavs.map(({ id }) => id));
    const stay = this.ids?.length === wanted.length && this.ids.every((id) => present.has(id))
      && selected === this.selected && now - this.builtAt < LASTING_MS;
    return stay ? this.ids : wanted;
  }

  build(ids, total) {
    Object.assign(this, { ids, builtAt: this.now });
    // All sizes are read at once: reading after each change would cause a layout each time.
    const sizes = CHARTS.map(({ id }) => $(`chart-${id}`))
      .map(({ clientWidth, clientHeight }) => [clientWidth, clientHeight]);
    this.plots.forEach(({ plot }) => plot.destroy());
    this.plots = CHARTS.map(({ id }, i) => {
      const box = $(`chart-${id}`);
      const empty = [[], ...ids.map(() => [])];
      return { box, plot: new globalThis.uPlot(this.options(sizes[i]), empty, box) };
    });
    this.plots.forEach(({ plot }) => {
      plot.over.addEventListener("click", () => {
        this.onPick(this.now + plot.posToVal(plot.cursor.left, "x") * 1000);
      });
    });
    showKey(ids, total);
  }

  options([width, height]) {
    const axis = {
      stroke: this.colour.muted, font: this.font, ticks: { show: false },
      grid: { stroke: this.colour.grid, width: 1 },
    };
    return {
      width: Math.max(60, width), height: Math.max(60, height),
      padding: [8, 16, 0, 0], legend: { show: false },
      cursor: { y: false, points: { show: false }, drag: { x: false, y: false } },
      scales: { x: { time: false, range: () => [-this.spanS, 0] } },
      axes: [
        { ...axis, size: 24, incrs: [10, 20, 60], values: (_, marks) => marks.map(agoLabel) },
        { ...axis, size: 40, space: 24, values: (_, marks) => marks.map(plain) },
      ],
      series: [{}, ...this.ids.map((id, i) => ({
        stroke: this.colour[HUES[i]], dash: DASHES[i], points: { show: false },
        width: id === this.selected ? 2.6 : 1.4,
      }))],
      hooks: { draw: [(plot) => this.markPast(plot)] },
    };
  }

  /** Mark the moment that the rest of the page shows. */
  markPast(plot) {
    if (this.pastAt === null) return;
    const { left, top, width, height } = plot.bbox;
    const x = plot.valToPos((this.pastAt - this.now) / 1000, "x", true);
    if (x < left || x > left + width) return;
    plot.ctx.save();
    plot.ctx.fillStyle = this.colour.mark;
    plot.ctx.fillRect(x - 1.5, top, 3, height);
    plot.ctx.restore();
  }
}

const plain = (value) => String(value).replace("-", "−");

function agoLabel(seconds) {
  if (seconds === 0) return "now";
  return seconds % 60 ? `−${-seconds} s` : `−${-seconds / 60} min`;
}

/** The legend: the line of each UAV. */
function showKey(ids, total) {
  setChildren($("series-key"), [ids, total], () => {
    const names = ids.map((id, i) => {
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("viewBox", "0 0 28 8");
      svg.setAttribute("aria-hidden", "true");
      const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
      path.setAttribute("d", "M0 4H28");
      path.setAttribute("stroke-dasharray", DASHES[i].join(" "));
      path.setAttribute("class", `line${i}`);
      svg.append(path);
      return make("li", {}, svg, id);
    });
    if (total > ids.length) names.push(make("li", { class: "muted" }, `of ${total} UAVs`));
    return names;
  });
}
