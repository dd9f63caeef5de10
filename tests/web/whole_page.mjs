// The whole page as it starts in a browser, on a service that answers as a test says.

import { load, openBrowser } from "./browser.mjs";
import { Plot } from "./recording_plot.mjs";
import { Service, beam, uav } from "./service.mjs";

export const BEAT_MS = 850;
let opened = 0;

/** The page after the first responses; UAVs have the given ids and a beam each. */
export async function openPage({ ids = ["1:1", "2:1"], mode = "answers", answers = {} } = {}) {
  const browser = openBrowser();
  const { time, document } = browser;
  Plot.install();
  const service = new Service(time);
  Object.assign(service, {
    mode, answers, uavs: ids.map((id) => uav(id)), beams: ids.map((id) => beam(id)),
  });
  for (const id of ["plan", "pattern", "elements"]) browser.resize(id, 400, 400);
  opened += 1;
  await load("main.js", `?${opened}`);
  await time.advance(2 * BEAT_MS);
  const cells = (key) => document.querySelectorAll(`td[data-key=${key}]`)
    .map(({ textContent }) => textContent.replaceAll("\u00a0", " "));
  return {
    ...browser, service, cells,
    root: document.documentElement,
    rows: () => document.querySelectorAll(".pick").map(({ textContent }) => textContent),
    chosen: () => document.querySelectorAll(".pick[aria-pressed=true]")
      .map(({ textContent }) => textContent),
    press: (key, how = {}) => document.body.dispatch("keydown", { key, ...how }),
    /** The names of the feeds that the page marks as `late` or `lost`. */
    marked: (how) => [...document.documentElement.attributes.keys()]
      .map((name) => new RegExp(`^data-(\\w+)-${how}$`).exec(name)?.[1]).filter(Boolean).sort(),
    /** The plan view as currently drawn. */
    async drawn() {
      await time.advance(200);
      const picture = browser.element("plan").getContext();
      picture.forget();
      browser.resize("plan", 400, 400);
      time.paint(1);
      return picture;
    },
  };
}

/** An azimuth per second, which distinguishes a paused page from a live one. */
export function turnBeams(service) {
  const { answer } = service;
  service.answer = (path) => {
    const found = answer.call(service, path);
    for (const one of path.split("?")[0] === "/v1/beams" ? found.beams ?? [] : []) {
      one.azimuth_deg = Math.round(service.seconds * 100) / 10;
    }
    return found;
  };
}
