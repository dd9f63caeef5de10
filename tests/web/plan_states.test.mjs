// What the plan view says of how far things may be believed, whom it makes room for, and whom a
// click chooses.

import assert from "node:assert/strict";
import { test } from "node:test";

import { near } from "./near.mjs";
import {
  CENTRE, OUTER_PX, arrows, circles, ellipses, linesFrom, openPlan, wedges,
} from "./plan_picture.mjs";
import { array, beam, uav } from "./service.mjs";

const COLOUR_OF = { live: "live", coasting: "coast", stale: "stale" };

for (const [state, name] of Object.entries(COLOUR_OF)) {
  test(`a UAV that is ${state} has the colour of that state, filled only while live`, async () => {
    const view = await openPlan();
    const picture = view.show({ uavs: [uav("1:1", { state })] });
    assert.equal(circles(picture, 6)[0].strokeStyle, view.browser.colour(name));
    const inside = view.browser.colour(state === "live" ? "live" : "plan");
    assert.equal(circles(picture, 6, "fill")[0].fillStyle, inside);
    assert.equal(ellipses(picture)[0].strokeStyle, view.browser.colour(name));
  });
}

test("a UAV that is lost is a cross", async () => {
  const view = await openPlan();
  const lost = uav("1:1", { state: "lost", horizontal_bound_m: null });
  const picture = view.show({ uavs: [lost, uav("2:1", { north_m: -100 })] });
  const y = CENTRE.y - (100 * OUTER_PX) / 150;
  const cross = picture.of("stroke", ({ path }) => path.some((point) => point.y === y - 6));
  const ends = cross[0].path.filter(({ op }) => op !== "close");
  near(ends, [{ x: 194, y: y - 6 }, { x: 206, y: y + 6 }, { x: 206, y: y - 6 },
    { x: 194, y: y + 6 }]);
  assert.equal(cross[0].strokeStyle, view.browser.colour("stale"));
});

test("nothing looks live while the responses are not", async () => {
  const view = await openPlan();
  const flying = uav("1:1", { velocity_ned_mps: [10, 0, 0] });
  const scene = { uavs: [flying], beams: [beam("1:1")], array: array(), carrier: { heading_deg: 0 } };
  let picture = view.show({ ...scene, uavsLive: false, beamsLive: false });
  for (const name of ["live", "coast", "beam", "bore"]) {
    const colour = view.browser.colour(name);
    const shown = picture.drawn.filter(({ fillStyle, strokeStyle }) =>
      [fillStyle, strokeStyle].some((style) => (style.stops ?? [["", style]])
        .some(([, one]) => one.startsWith(colour))));
    assert.deepEqual(shown.map(({ kind }) => kind), [], name);
  }
  const stale = view.browser.colour("stale");
  assert.equal(arrows(picture, stale).length, 2); // the UAV and the carrier
  assert.ok(wedges(picture)[0].fillStyle.stops.every(([, colour]) => colour.startsWith(stale)));
  picture = view.show(scene);
  assert.equal(arrows(picture, view.browser.colour("live")).length, 1);
  assert.ok(wedges(picture)[0].fillStyle.stops[0][1].startsWith(view.browser.colour("beam")));
});

test("a lost carrier and old beams are grey; UAVs keep their colour", async () => {
  const view = await openPlan();
  const carrier = { heading_deg: 0, unfit: "the attitude is too old" };
  const scene = { uavs: [uav("1:1")], beams: [beam("1:1", { oldS: 9 })], array: array(), carrier };
  const picture = view.show(scene);
  const stale = view.browser.colour("stale");
  assert.equal(arrows(picture, stale).length, 1); // the carrier
  assert.ok(wedges(picture)[0].fillStyle.stops.every(([, colour]) => colour.startsWith(stale)));
  assert.equal(circles(picture, 6)[0].strokeStyle, view.browser.colour("live"));
});

test("labels are struck out while the responses are not live", async () => {
  const view = await openPlan();
  const strokes = (picture) => picture.of("rect", ({ height }) => height < 2);
  assert.deepEqual(strokes(view.show({ uavs: [uav("1:1")] })), []);
  const picture = view.show({ uavs: [uav("1:1")], uavsLive: false });
  const { x, y } = picture.text("1:1");
  near([strokes(picture)[0].x, strokes(picture)[0].y], [x, y]);
  near(strokes(picture)[0].width, "1:1".length * 6.5);
});

test("warnings are written across the view, the past in its own colour", async () => {
  const view = await openPlan();
  const plate = (picture) => {
    const { x } = picture.text("NOT LIVE");
    near(x, CENTRE.x);
    return picture.of("rect").at(-1);
  };
  let found = plate(view.show({ message: "NOT LIVE", uavsLive: false }));
  assert.equal(found.fillStyle, view.browser.colour("bad"));
  near(found.x + found.width / 2, CENTRE.x);
  found = plate(view.show({ message: "NOT LIVE", isPast: true }));
  assert.equal(found.fillStyle, view.browser.colour("past"));
  assert.ok(!view.show({ uavs: [uav("1:1")] }).texts.includes("NOT LIVE"));
  const said = view.show({ message: "NOT LIVE" }); // for example, of the carrier alone
  assert.equal(plate(said).fillStyle, view.browser.colour("plan"));
});

test("a message wider than the view wraps after its colon", async () => {
  const view = await openPlan();
  const cause = "the attitude of the carrier 5:1 is too old:";
  const picture = view.show({ message: `${cause} carrier and beams from 19 s ago`, uavs: [] });
  const [above, below] = [picture.text(cause), picture.text("carrier and beams from 19 s ago")];
  const found = picture.of("rect").at(-1);
  assert.ok(found.y < above.y && above.y < below.y && below.y < found.y + found.height);
  assert.ok(found.x >= 0 && found.y + found.height <= view.plan.height);
});

test("a bound as large as the view is drawn as an outline only", async () => {
  const view = await openPlan();
  const drawn = (boundM) => {
    const picture = view.show({
      uavs: [uav("1:1", { horizontal_bound_m: boundM })],
    });
    return ["fill", "stroke"].map((kind) =>
      picture.of(kind, ({ path }) => path.length === 1 && path[0].op === "ellipse").length);
  };
  assert.deepEqual([drawn(20), drawn(400)], [[1, 1], [0, 1]]);
});

test("the colours are those of the theme", async () => {
  const view = await openPlan();
  view.browser.document.documentElement.dataset.theme = "light";
  const dark = circles(view.show({ uavs: [uav("1:1")] }), 6)[0].strokeStyle;
  view.plan.recolour();
  const light = circles(view.drawAnew(), 6)[0].strokeStyle;
  assert.deepEqual([dark, light], ["#27c498", "#00634a"]);
});

/** Distance from the centre to the first UAV, which is 100 m north. */
const pxOf100 = (picture) => CENTRE.y - circles(picture, 6)[0].y;

test("neither lost UAVs nor passing traffic shrink the view of UAVs with beams", async () => {
  const view = await openPlan();
  const mine = uav("1:1");
  near(pxOf100(view.show({ uavs: [mine] })), (100 * OUTER_PX) / 150);
  const far = { north_m: 9000, east_m: 0 };
  for (const other of [uav("2:1", { ...far, state: "lost" }),
    uav("icao:4CA7B3", { ...far, target: false })]) {
    near(pxOf100(view.show({ uavs: [mine, other] })), (100 * OUTER_PX) / 150);
  }
  near(pxOf100(view.show({ uavs: [mine, uav("3:1", far)] })), (100 * OUTER_PX) / 10_000);
});

test("zooming in enlarges, zooming out shrinks; Fit shows all again", async () => {
  const view = await openPlan();
  const before = pxOf100(view.show({ uavs: [uav("1:1")] }));
  view.plan.zoom(1);
  assert.ok(pxOf100(view.drawAnew()) > before);
  view.plan.zoom(-3);
  assert.ok(pxOf100(view.drawAnew()) < before);
  view.plan.fitAll();
  near(pxOf100(view.drawAnew()), before);
});

test("a click selects the nearest UAV within reach, or none", async () => {
  const view = await openPlan();
  const picture = view.show({ uavs: [uav("1:1"), uav("2:1", { north_m: 80 })] });
  const [one, other] = circles(picture, 6);
  const nearer = (a, b) => ({ offsetX: (2 * a.x + b.x) / 3, offsetY: (2 * a.y + b.y) / 3 });
  view.canvas.click(nearer(one, other));
  view.canvas.click(nearer(other, one));
  view.canvas.click({ offsetX: one.x - 25, offsetY: one.y });
  view.canvas.click({ offsetX: one.x - 27, offsetY: one.y });
  assert.deepEqual(view.chosen, ["1:1", "2:1", "1:1", null]);
});

test("the selected UAV has a ring, and its beam is not dimmed", async () => {
  const view = await openPlan();
  const uavs = [uav("1:1"), uav("2:1", { north_m: 0, east_m: 100 })];
  const beams = [beam("1:1"), beam("2:1", { bearing_deg: 90 })];
  const scene = { uavs, beams, array: array() };
  const picture = view.show({ ...scene, selected: "2:1" });
  const rings = circles(picture, 15);
  assert.equal(rings.length, 1);
  near(rings[0], circles(picture, 6)[1]);
  const [other, chosen] = wedges(picture);
  assert.equal(chosen.globalAlpha, 1);
  assert.ok(other.globalAlpha < 0.7);
  assert.deepEqual(wedges(view.show(scene)).map(({ globalAlpha }) => globalAlpha), [1, 1]);
});

test("a carrier without a known heading shows none", async () => {
  const view = await openPlan();
  for (const headingDeg of [null, undefined]) {
    assert.deepEqual(arrows(view.show({ carrier: { heading_deg: headingDeg } }), view.browser.colour("text")), []);
  }
  assert.equal(circles(view.show({}), 9).length, 1);
});

test("nothing is drawn before layout", async () => {
  const view = await openPlan({ width: 0, height: 0 });
  assert.deepEqual(view.show({ uavs: [uav("1:1")] }).drawn, []);
  view.browser.resize("plan", 400, 400);
  view.browser.time.paint();
  assert.equal(circles(view.picture, 6).length, 1);
  assert.equal(linesFrom(view.picture, CENTRE).length, 0);
});

test("an unchanged scene is not redrawn; a new response is", async () => {
  const view = await openPlan();
  const scene = { uavs: [uav("1:1")], beams: [], array: null, carrier: null, uavsLive: true,
    beamsLive: true, message: "", isPast: false, selected: null, at: 1000, answers: "1" };
  const drawn = (changed) => {
    view.picture.forget();
    view.plan.show({ ...scene, ...changed }, 1000);
    while (view.browser.time.paint(1));
    return view.picture.drawn.length > 0;
  };
  assert.equal(drawn({}), true);
  assert.equal(drawn({}), false);
  for (const changed of [{ answers: "2" }, { selected: "1:1" }, { message: "late" }]) {
    assert.equal(drawn(changed), true, JSON.stringify(changed));
  }
});
