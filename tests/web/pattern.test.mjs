// The polar pattern of one beam: azimuth clockwise from boresight at the top, dB from the middle
// outwards, and three directions that are told apart by their shape. 400 by 300 px: the middle is
// at 200, 150, the edge 128 px from it.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load, openBrowser } from "./browser.mjs";
import { near } from "./near.mjs";
import { circles, linesFrom, wedges } from "./plan_picture.mjs";
import { beam, patternAnswer } from "./service.mjs";

const MIDDLE = { x: 200, y: 150 };
const EDGE_PX = 128;
const { directionFacts, makePattern } = await load("pattern.js");

function openPattern(settings = {}) {
  const browser = openBrowser(settings);
  const canvas = browser.element("pattern");
  const surface = makePattern(canvas);
  browser.resize("pattern", 400, 300);
  const picture = canvas.getContext("2d");
  return {
    browser, picture, surface,
    show({ answer = patternAnswer("1:1"), trusted = true, none = "waiting…", ...rest } = {}) {
      picture.forget();
      surface.show({
        answer, entry: answer?.patterns[0] ?? null, beam: beam("1:1"), trusted, none, ...rest,
      });
      return picture;
    },
  };
}

const outlineOf = (picture) => picture.of("stroke", (one) => one.path.at(-1).op === "close")[0];

test("the response is drawn clockwise from boresight at the top", () => {
  const { show } = openPattern();
  const answer = patternAnswer("1:1", { response_db: [10, -40, 10, -10], peak_db: 10 });
  const [back, left, front, right] = outlineOf(show({ answer })).path;
  near(front, { x: MIDDLE.x, y: MIDDLE.y - EDGE_PX });
  near(right, { x: MIDDLE.x + EDGE_PX / 2, y: MIDDLE.y }); // 20 dB below, of 40
  near(back, { x: MIDDLE.x, y: MIDDLE.y + EDGE_PX });
  near(left, MIDDLE); // below the floor
});

test("the edge is the peak rounded up to 5 dB, with a ring every 10 dB", () => {
  const { show } = openPattern();
  const picture = show({ answer: patternAnswer("1:1", { peak_db: 17.2 }) });
  for (const [i, label] of ["20 dB", "10", "0", "−10"].entries()) {
    const px = (EDGE_PX * (4 - i)) / 4;
    assert.equal(circles(picture, px).length, 1, label);
    const { x, y } = picture.text(label);
    near(Math.hypot(x - MIDDLE.x, y - MIDDLE.y), px - 8);
  }
});

test("angles are labelled around it, positive to the right", () => {
  const picture = openPattern().show();
  const px = EDGE_PX + 15;
  for (const [text, deg] of [["0°", 0], ["90°", 90], ["180°", 180], ["−90°", 270], ["−30°", 330]]) {
    const angle = (deg * Math.PI) / 180;
    near(picture.text(text), {
      x: MIDDLE.x + px * Math.sin(angle), y: MIDDLE.y - px * Math.cos(angle),
    });
  }
});

test("the commanded direction is dashed, the peak a bar on the edge, the target a ring", () => {
  const answer = patternAnswer("1:1", { target_deg: 90, peak_azimuth_deg: -90 });
  const { show, browser } = openPattern();
  const picture = show({ answer, beam: beam("1:1", { azimuth_deg: 180 }) });
  const [commanded] = linesFrom(picture, MIDDLE).filter(({ dash }) => dash.length);
  near(commanded.to, { x: MIDDLE.x + EDGE_PX, y: MIDDLE.y });
  const [bar] = picture.of("stroke", ({ lineWidth }) => lineWidth === 4);
  near(bar.path, [{ x: MIDDLE.x - EDGE_PX + 7, y: MIDDLE.y },
    { x: MIDDLE.x - EDGE_PX - 7, y: MIDDLE.y }]);
  const [ring] = circles(picture, 6);
  near(ring, { x: MIDDLE.x, y: MIDDLE.y + EDGE_PX - 14 });
  assert.equal(ring.strokeStyle, browser.colour("live"));
});

test("the half-power width is a wedge around the true beam direction", () => {
  const { show } = openPattern();
  const answer = patternAnswer("1:1", { peak_azimuth_deg: 30, half_power_beamwidth_deg: 12 });
  const [wedge] = wedges(show({ answer }));
  near([wedge.bearingDeg, wedge.widthDeg], [30, 12]);
  const unknown = patternAnswer("1:1", { half_power_beamwidth_deg: null });
  assert.deepEqual(wedges(show({ answer: unknown })), []);
});

test("a missing pattern shows its reason", () => {
  const { show } = openPattern();
  const picture = show({ answer: null, none: "no beam" });
  near(picture.text("no beam"), MIDDLE);
  assert.equal(outlineOf(picture), undefined);
});

test("an unknown response is drawn at the centre", () => {
  const answer = patternAnswer("1:1", { response_db: [null, -10, 18, -10] });
  near(outlineOf(openPattern().show({ answer })).path[0], MIDDLE);
});

test("outdated values have the stale colour", () => {
  const { show, browser } = openPattern();
  assert.equal(outlineOf(show()).strokeStyle, browser.colour("beam"));
  assert.equal(outlineOf(show({ trusted: false })).strokeStyle, browser.colour("stale"));
});

test("an unchanged pattern is not redrawn; a new theme or size redraws it", () => {
  const { show, browser, picture, surface } = openPattern();
  const answer = patternAnswer("1:1");
  const same = { answer, beam: beam("1:1") };
  show(same);
  assert.deepEqual(show(same).drawn, []);
  browser.document.documentElement.dataset.theme = "light";
  surface.recolour();
  assert.equal(outlineOf(picture).strokeStyle, browser.colour("beam"));
  picture.forget();
  browser.resize("pattern", 300, 300);
  near(circles(picture, 300 / 2 - 34)[0], { x: 150, y: 150 });
});

test("a high-density screen is drawn at twice the pixels", () => {
  const { show, browser } = openPattern({ ratio: 2 });
  near(circles(show(), 2 * EDGE_PX)[0], { x: 2 * MIDDLE.x, y: 2 * MIDDLE.y });
  const { width, height } = browser.element("pattern");
  assert.deepEqual([width, height], [800, 600]);
});

test("directions are also given as text, each with its name", () => {
  const [entry] = patternAnswer("1:1", { target_deg: 1, peak_azimuth_deg: -2.04, peak_db: 17.5,
    half_power_beamwidth_deg: 12, side_lobe_db: -13.2 }).patterns;
  assert.deepEqual(Object.fromEntries(directionFacts(entry, beam("1:1", { azimuth_deg: 1.5 }))), {
    "target": "+1.5°", "commanded": "+1.0°", "actual": "−2.0°", "peak": "17.5\u00a0dB",
    "width": "12.0°", "side lobe": "−13.2\u00a0dB",
  });
  assert.deepEqual([...new Set(directionFacts(null, null).map(([, text]) => text))], ["–"]);
});
