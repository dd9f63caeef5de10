// The time series: values passed to the chart library, their order and time span.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { near } from "./near.mjs";
import { Plot, WIDTH } from "./recording_plot.mjs";
import { beam, stampAt, uav } from "./service.mjs";

const { Charts } = await load("charts.js");
const { History } = await load("history.js");
const NAMES = ["pointing", "innovation", "latency", "gain"];

function openCharts() {
  const browser = openBrowser();
  Plot.install();
  const picked = [];
  const history = new History();
  const charts = new Charts((at) => picked.push(at));
  return {
    browser, charts, history, picked,
    plots: () => Object.fromEntries(Plot.made.filter((plot) => !plot.isDestroyed)
      .map((plot) => [plot.box.id.replace("chart-", ""), plot])),
    add: (at, uavs, beams = []) => history.add({ at, uavs, beams }),
    show({ now = 10_000, selected = null, pastAt = null, uavs } = {}) {
      charts.show(history, uavs ?? history.newest?.uavs ?? [], { selected, pastAt, now });
    },
  };
}

test("each chart has its own value; latency is in milliseconds", () => {
  const { add, show, plots } = openCharts();
  add(9000, [uav("1:1", { innovation_m: 0.4, latency_s: 0.03 })],
    [beam("1:1", { pointing_bound_deg: 1.5, guaranteed_gain_db: 15.2 })]);
  show();
  assert.deepEqual(Object.keys(plots()), NAMES);
  const values = NAMES.map((name) => plots()[name].data);
  assert.deepEqual(values.map(([times]) => times), Array(4).fill([-1]));
  assert.deepEqual(values.map(([, [value]]) => value), [1.5, 0.4, 30, 15.2]);
});

test("each UAV has its own line, and unknown values are gaps, not 0", () => {
  const { add, show, plots } = openCharts();
  add(8000, [uav("1:1", { innovation_m: 1 })]);
  add(9000, [uav("1:1", { innovation_m: null }), uav("2:1", { innovation_m: 2 })]);
  show();
  assert.deepEqual(plots().innovation.data, [[-2, -1], [1, null], [null, 2]]);
  assert.deepEqual(plots().gain.data, [[-2, -1], [null, null], [null, null]]);
});

test("innovation uses the selected unit from the next redraw on", async () => {
  const { use } = await load("units.js");
  const { add, show, plots, charts } = openCharts();
  add(9000, [uav("1:1", { innovation_m: 3.048, latency_s: 0.03 })]);
  show();
  use({ length: "ft" });
  charts.changeUnits();
  show();
  use({ length: "m" });
  assert.deepEqual([plots().innovation.data[1], plots().latency.data[1]], [[10], [30]]);
});

test("no line is drawn across a gap in the received data", () => {
  const { add, show, plots } = openCharts();
  for (const at of [5000, 7500, 10_001]) add(at, [uav("1:1", { innovation_m: 1 })]);
  show({ now: 10_001 });
  const [times, values] = plots().innovation.data;
  assert.deepEqual(values, [1, 1, null, 1]);
  near(times[2], -2.5);
});

test("time axis ends now and uses the shortest span that holds the data", () => {
  for (const [ago, span] of [[5, 30], [30, 30], [30.1, 60], [61, 180], [290, 180]]) {
    const { add, show, plots } = openCharts();
    add(1000, [uav("1:1")]);
    show({ now: 1000 + ago * 1000 });
    assert.deepEqual(plots().latency.range, [-span, 0], `${ago} s`);
    if (ago > span) assert.deepEqual(plots().latency.data[0], []); // older than the shown span
  }
});

test("at most seven lines, always with the selected UAV, and the total is stated", () => {
  const { browser, add, show, plots } = openCharts();
  add(9000, Array.from({ length: 9 }, (_, i) => uav(`${i}:1`, { innovation_m: i })));
  show({ selected: "8:1" });
  const drawn = plots().innovation.data.slice(1).map(([value]) => value);
  assert.deepEqual(drawn, [0, 1, 2, 3, 4, 5, 8]);
  const key = browser.element("series-key").children.map(({ textContent }) => textContent);
  assert.deepEqual(key, ["0:1", "1:1", "2:1", "3:1", "4:1", "5:1", "8:1", "of 9 UAVs"]);
  show({ selected: "2:1" });
  assert.equal(plots().innovation.data.at(-1)[0], 6);
});

test("lines stay for ten seconds when others become worst, and vanish with their UAV", () => {
  const { browser, add, show } = openCharts();
  const key = () => browser.element("series-key").children.map(({ textContent }) => textContent);
  const ids = (...order) => order.map((n) => uav(`${n}:1`));
  const few = ["1:1", "2:1", "3:1", "4:1", "5:1", "6:1", "7:1"];
  add(9000, ids(1, 2, 3, 4, 5, 6, 7, 8));
  show();
  assert.deepEqual(key().slice(0, 7), few);
  show({ uavs: ids(8, 7, 6, 5, 4, 3, 2, 1), now: 15_000 });
  assert.deepEqual(key().slice(0, 7), few);
  show({ uavs: ids(8, 7, 6, 5, 4, 3, 2), now: 16_000 });
  assert.deepEqual(key(), ["2:1", "3:1", "4:1", "5:1", "6:1", "7:1", "8:1"]);
  show({ uavs: ids(1, 2, 3, 4, 5, 6, 7, 8), now: 27_000 });
  assert.deepEqual(key().slice(0, 7), few);
});

test("lines differ by hue and dash as in the legend, and the selected one by width", () => {
  const { browser, add, show, plots } = openCharts();
  add(9000, [uav("1:1"), uav("2:1"), uav("3:1")]);
  show({ selected: "2:1" });
  const [, ...lines] = plots().gain.options.series;
  assert.deepEqual(lines.map(({ stroke }) => stroke),
    ["line0", "line1", "line2"].map((name) => browser.colour(name)));
  const dashes = lines.map(({ dash }) => dash.join(" "));
  assert.equal(new Set(dashes).size, 3);
  const key = browser.element("series-key").querySelectorAll("path");
  assert.deepEqual(key.map((path) => path.getAttribute("stroke-dasharray")), dashes);
  assert.deepEqual(key.map((path) => path.getAttribute("class")), ["line0", "line1", "line2"]);
  assert.ok(lines[1].width > lines[0].width && lines[0].width === lines[2].width);
});

test("a click selects the time under it within the shown span", async () => {
  const { browser, add, show, plots, picked } = openCharts();
  add(9000, [uav("1:1")]);
  show({ now: 10_000 });
  browser.time.now = 10_500; // the chart is unchanged since it was drawn
  const plot = plots().pointing;
  plot.cursor.left = WIDTH * 0.9;
  plot.over.click();
  near(picked, [10_000 - 3000]);
});

test("the displayed time is marked on the chart", () => {
  const { browser, add, show, plots } = openCharts();
  add(9000, [uav("1:1")]);
  const marks = () => {
    const plot = plots().gain;
    plot.ctx.forget();
    plot.options.hooks.draw[0](plot);
    return plot.ctx.of("rect");
  };
  show();
  assert.deepEqual(marks(), []);
  show({ pastAt: 10_000 - 15_000 });
  const [mark] = marks();
  near(mark.x + mark.width / 2, 10 + WIDTH / 2);
  assert.equal(mark.fillStyle, browser.colour("mark"));
  show({ pastAt: 10_000 - 31_000 });
  assert.deepEqual(marks(), []);
});

test("charts are redrawn for a new time, and every two seconds", () => {
  const { add, show, plots, history } = openCharts();
  add(9000, [uav("1:1")]);
  show();
  const drawnAgain = (settings) => {
    plots().gain.data = null;
    show(settings);
    return plots().gain.data !== null;
  };
  assert.equal(drawnAgain({ now: 12_000 }), false);
  assert.equal(drawnAgain({ now: 12_001 }), true);
  assert.equal(drawnAgain({ now: 12_002, pastAt: 9000 }), true);
  assert.equal(drawnAgain({ now: 12_003, pastAt: 9000 }), false);
  assert.equal(history.moments.length, 1);
});

test("a new theme redraws the charts in its colours; a new size resizes them", () => {
  const { browser, add, show, plots, charts } = openCharts();
  add(9000, [uav("1:1")]);
  show();
  const [before] = [plots().gain];
  browser.document.documentElement.dataset.theme = "light";
  charts.recolour();
  show();
  assert.ok(before.isDestroyed);
  assert.equal(plots().gain.options.series[1].stroke, browser.colour("line0"));
  browser.resize("chart-gain", 320, 90);
  assert.deepEqual(plots().gain.size, { width: 320, height: 90 });
});

test("axes show the age, and values with a true minus sign", () => {
  const { add, show, plots } = openCharts();
  add(9000, [uav("1:1")]);
  show();
  const [x, y] = plots().gain.options.axes;
  assert.deepEqual(x.values(null, [-60, -30, 0]), ["−1 min", "−30 s", "now"]);
  assert.deepEqual(y.values(null, [-5, 0, 5]), ["−5", "0", "5"]);
});
