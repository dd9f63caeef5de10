// Wires the page: what is polled goes to the plan view, the table and the panels.

import { connection, startPolling } from "./api.js";
import {
  showBeams, showConnection, showFault, showReadiness, showStatus, Rejections,
} from "./panels.js";
import { PlanView } from "./plan.js";
import { UavTable } from "./table.js";
import { setUpTheme } from "./theme.js";
import { Trails } from "./trails.js";

const $ = (id) => document.getElementById(id);
const LOOK_MS = 100; // how often ages and the connection are looked at, answers or not
const STATE_ORDER = ["live", "coasting", "stale", "lost"];
const COLLATOR = new Intl.Collator("en", { numeric: true });

let selected = null;

function select(id) {
  selected = id === selected ? null : id;
  refresh();
}

const trails = new Trails();
const plan = new PlanView($("plan"), trails, select);
const table = new UavTable($("uavs"), select);
const rejections = new Rejections();
const feeds = startPolling(refresh);
let faulted = false;

const trusted = (feed, now) => !["lost", "frozen", "waiting"].includes(feed.health(now));

function uavsInOrder() {
  return [...(feeds.uavs.data?.uavs ?? [])].sort((a, b) => COLLATOR.compare(a.id, b.id));
}

/** Mark everything that stands on a feed whose answer is no longer true, or else on any. */
function markLost(now, all = false) {
  for (const feed of Object.values(feeds)) {
    const lost = all || (feed.data !== null && !trusted(feed, now));
    document.documentElement.toggleAttribute(`data-${feed.name}-lost`, lost);
  }
}

function showCount(uavs) {
  const parts = STATE_ORDER
    .map((state) => [state, uavs.filter((uav) => uav.state === state).length])
    .filter(([, number]) => number > 0)
    .map(([state, number]) => `${number} ${state}`);
  $("uavs-count").textContent = parts.join(" · ");
  $("uavs-empty").hidden = uavs.length > 0;
  $("uavs-empty").textContent = feeds.uavs.data ? "No UAV has reported a position."
    : "Nothing received yet.";
}

/** What the plan view says of itself when it must not be believed; nothing while it is live. */
function planMessage(link, now) {
  if (link.never) return "NOT LIVE – no connection";
  if (link.state === "lost") return "NOT LIVE – connection lost";
  if (feeds.uavs.health(now) === "frozen") return "NOT LIVE – estimates stopped";
  return feeds.uavs.health(now) === "lost" ? "NOT LIVE – no answer about UAVs" : "";
}

function showPlan(uavs, link, now) {
  const beams = feeds.beams.data;
  plan.show({
    uavs,
    beams: beams?.beams ?? [],
    array: beams?.array ?? null,
    headingDeg: feeds.status.data?.center?.heading_deg,
    uavsLive: trusted(feeds.uavs, now),
    beamsLive: trusted(feeds.beams, now),
    message: planMessage(link, now),
    selected,
    now,
  }, now);
}

/** Show everything anew. Should that fail, say so: a page that stood still would look live. */
function refresh() {
  const now = performance.now();
  const link = connection(feeds, now);
  markLost(now);
  try {
    showAll(link, now);
    faulted = false;
  } catch (error) {
    showFault(error);
    markLost(now, true);
    if (!faulted) console.error(error); // once, not ten times a second
    faulted = true;
  }
}

function showAll(link, now) {
  const uavs = uavsInOrder();
  if (selected !== null && !uavs.some((uav) => uav.id === selected)) selected = null;
  const beams = feeds.beams.data;
  if (feeds.uavs.data) trails.add(uavs, feeds.uavs.answeredAt);
  showConnection(link, feeds.uavs.data?.valid_at);
  showReadiness(feeds.readyz.data);
  if (feeds.status.data) {
    showStatus(feeds.status.data);
    rejections.show(feeds.status.data.rejected, now);
  }
  if (beams) showBeams(beams);
  showCount(uavs);
  table.update(uavs, {
    beams: new Map((beams?.beams ?? []).map((beam) => [beam.uav, beam])),
    array: beams?.array,
    sinceS: feeds.uavs.silenceS(now),
    selected,
  });
  showPlan(uavs, link, now);
  nameThePage(uavs, link);
}

/** The tab's title and the picture's name tell the state to whoever does not see the page. */
function nameThePage(uavs, link) {
  const trouble = { lost: "CONNECTION LOST", partial: "CONNECTION FAILING", frozen: "STOPPED" };
  const title = `${trouble[link.state] ?? `${uavs.length} UAVs`} · companion`;
  if (document.title !== title) document.title = title;
  const name = `Plan view: ${uavs.length} UAVs, ${feeds.beams.data?.beams.length ?? 0} beams`
    + (trouble[link.state] ? `, not live: ${trouble[link.state].toLowerCase()}` : "");
  if ($("plan").getAttribute("aria-label") !== name) $("plan").setAttribute("aria-label", name);
}

// --- controls -----------------------------------------------------------------------------------

function control(action) {
  action();
  $("zoom-fit").setAttribute("aria-pressed", String(plan.scale.fit));
}

const zoomIn = () => control(() => plan.zoom(1));
const zoomOut = () => control(() => plan.zoom(-1));
const fitAll = () => control(() => plan.fitAll());

$("zoom-in").addEventListener("click", zoomIn);
$("zoom-out").addEventListener("click", zoomOut);
$("zoom-fit").addEventListener("click", fitAll);
$("plan").addEventListener("keydown", (event) => {
  const action = { "+": zoomIn, "=": zoomIn, "-": zoomOut, "0": fitAll }[event.key];
  if (action) {
    event.preventDefault();
    action();
  }
});

let wheeled = 0;
$("plan").addEventListener("wheel", (event) => {
  event.preventDefault();
  // Touch pads send many small steps: one change of scale for about one notch of a wheel.
  wheeled += event.deltaY;
  if (Math.abs(wheeled) < 60) return;
  (wheeled > 0 ? zoomOut : zoomIn)();
  wheeled = 0;
}, { passive: false });

setUpTheme($("theme"), () => plan.recolour());
setInterval(refresh, LOOK_MS);
