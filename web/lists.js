// Links, events and recordings.

import { $, make, setChildren, setText } from "./dom.js";
import { save } from "./export.js";
import * as format from "./format.js";
import { labelOf, meaningOf } from "./meanings.js";
import { authorised, hasToken } from "./token.js";

const EVENTS_SHOWN = 60;
const FEW = 8; // components of a link that are listed
export const SEVERITY_LEVEL = { info: "", warning: "warn", error: "bad" };

const LINK_VALUES = [
  ["HeardLink", "frames", (link) => format.count(link.frames)],
  ["HeardLink", "bad_crc", (link) => format.count(link.bad_crc)],
  ["HeardLink", "gaps", (link) => format.count(link.gaps)],
  ["LinkReports", "first_share", (link) => format.share(link.reports?.first_share)],
  ["LinkReports", "latency_p95_s", (link) => format.millisecondsRange(
    link.reports?.latency_p50_s, link.reports?.latency_p95_s,
  )],
];

function linkLevel(link) {
  if (link.state !== "up") return "bad";
  return format.known(link.age_s) && link.age_s > 3.5 ? "warn" : "good";
}

/** A link and its counts; `level` has a mark as well as a colour. */
function linkItem(link) {
  const quiet = link.state === "up" && linkLevel(link) === "warn"
    ? ` · silent ${format.duration(link.age_s)}` : "";
  const head = make("p", { class: "link-head", "data-level": linkLevel(link) },
    make("span", {}, link.url), make("b", {}, link.state + quiet));
  const facts = LINK_VALUES.map(([of, name, show]) => make(
    "div", { title: meaningOf(of, name) }, make("dt", {}, labelOf(of, name)), make("dd", {}, show(link)),
  ));
  const heard = (link.components ?? []).map((one) => one.id);
  const item = make("li", {}, head, make("dl", { class: "link-facts" }, ...facts));
  if (heard.length) {
    const more = heard.length > FEW ? ` and ${heard.length - FEW} more` : "";
    item.append(make("p", { class: "muted", title: heard.join(" ") },
      `receives ${heard.slice(0, FEW).join(" ")}${more}`));
  }
  return item;
}

export function showLinks(answer) {
  const links = answer?.links ?? [];
  setChildren($("links"), links.length ? links : answer !== null, () => (links.length
    ? links.map(linkItem) : [make("li", { class: "muted" }, answer ? "none" : format.UNKNOWN)]));
}

function eventItem({ at, severity, text }) {
  return make("li", { "data-level": SEVERITY_LEVEL[severity] ?? "warn" },
    make("time", { datetime: at }, format.timeOfDay(at)), make("span", {}, text));
}

/** Newest first. */
export function showEvents(answer) {
  const events = (answer?.events ?? []).slice(-EVENTS_SHOWN).reverse();
  setChildren($("events"), events.length ? events : answer !== null, () => (events.length
    ? events.map(eventItem) : [make("li", { class: "muted" }, answer ? "none" : format.UNKNOWN)]));
}

function recordingItem({ name, bytes, state }, onPlay) {
  const href = `/v1/recordings/${encodeURIComponent(name)}`;
  const link = make("a", { href, download: "" }, name);
  link.addEventListener("click", (event) => {
    if (!hasToken()) return;
    event.preventDefault();
    download(href, name);
  });
  const play = make("button", { type: "button", class: "button small", "aria-label": `Play ${name}` }, "▶");
  play.addEventListener("click", () => onPlay(name));
  if (state === "recording") play.setAttribute("disabled", "");
  return make("li", {}, link, make("span", {}, [format.bytes(bytes), state].join(" · ")), play);
}

/** A plain link sends no token, so a file that needs one is fetched first and then saved. */
async function download(href, name) {
  const response = await authorised(href);
  if (!response.ok) return;
  save(await response.blob(), name);
}

/** Hidden if the service has none. */
export function showRecordings(answer, onPlay) {
  const recordings = answer?.recordings ?? null;
  $("recordings-panel").hidden = !recordings?.length;
  if (recordings === null) return;
  setText($("recordings-count"), String(recordings.length));
  setChildren($("recordings"), recordings, () => recordings.map((one) => recordingItem(one, onPlay)));
}
