// Main module of the page: stores answers in the history, and shows the present or a past moment in
// the plan view, the table, the charts and the lists.

import { askOnce, connection, startPolling } from "./api.js";
import { Charts } from "./charts.js";
import { Alarm } from "./alarm.js";
import { $, setText, toggleAttribute } from "./dom.js";
import { Drawer } from "./drawer.js";
import { csvOf, save } from "./export.js";
import { Focus } from "./focus.js";
import { Folds, isOpen } from "./folds.js";
import { FleetView, nodesAround, slimFleet } from "./fleet.js";
import * as format from "./format.js";
import { headlineOf, showHeadline, showTroubles, worstFirst } from "./health.js";
import { History, momentsOf } from "./history.js";
import { setUpKeys } from "./keys.js";
import { LastKnown, carrierOf, placedBy } from "./last_known.js";
import { showEvents, showLinks, showRecordings } from "./lists.js";
import {
  showBeams, showConnection, showFault, showReadiness, showStatus, Rejections,
} from "./panels.js";
import { Ground } from "./ground.js";
import { loadMeanings } from "./meanings.js";
import { Outage } from "./outage.js";
import { PlanView } from "./plan.js";
import { Player } from "./player.js";
import { showSettings } from "./settings.js";
import { Space } from "./space.js";
import { UavTable } from "./table.js";
import { setUpTheme } from "./theme.js";
import { TimeBar } from "./timebar.js";
import { setUpUnits } from "./units.js";

const LOOK_MS = 250; // interval of checks of the connection
const AGES_MS = 900; // time without an answer after which displayed ages are updated anyway
const GATHER_MS = 120; // answers of one beat are collected and shown together
const SAME_BEAT_MS = 400;
const STATE_ORDER = ["live", "coasting", "stale", "lost"];
const COLLATOR = new Intl.Collator("en", { numeric: true });
const KEPT = ["beams", "pattern", "weights", "links", "events", "status", "fleet"];

let selected = null;
let faulted = false;
let isFilled = false; // whether the samples from before were requested
let gathering = null; // timer of the next refresh
let shown = { at: -Infinity, healths: "" }; // time of the last refresh, and the feeds' state then

const history = new History();
const last = new LastKnown();
const plan = new PlanView($("plan"), history, pick, markPlan);
const ground = new Ground($("ground"), () => plan.colour);
const drawer = new Drawer();
const table = new UavTable($("uavs"), pick, refresh);
const fleet = new FleetView(pick);
const focus = new Focus();
const rejections = new Rejections();
const timebar = new TimeBar(history, refresh);
const player = new Player(timebar, () => refresh());
const alarm = new Alarm();
const outage = new Outage(fillHistory);
const charts = new Charts((at) => timebar.showAt(at));
const feeds = startPolling(() => ({
  beamed: isOpen("fold-focus") ? beamedUav(feeds.beams.data) : null,
  inFleet: Boolean(feeds.status.data?.node),
}), take);

// --- display -----------------------------------------------------------------------------------

/** The UAV whose beam is shown in detail: the selected one, or else the first with a beam. */
function beamedUav(answer) {
  const ids = (answer?.beams ?? []).map((beam) => beam.uav).sort(COLLATOR.compare);
  return ids.includes(selected) ? selected : ids[0] ?? null;
}

/** The present moment for the history, without outdated answers. */
function presentMoment(now) {
  const answers = Object.fromEntries(
    KEPT.map((name) => [name, feeds[name].isTrusted(now) ? feeds[name].data : null]),
  );
  return {
    ...answers,
    at: feeds.uavs.answeredAt ?? now,
    stamp: feeds.uavs.data?.valid_at ?? null,
    uavs: [...feeds.uavs.data?.uavs ?? []].sort(worstFirst),
    answer: answers.beams,
    fleet: slimFleet(answers.fleet),
    beams: answers.beams?.beams ?? [],
    patternBeams: beamsAt(answers.pattern?.valid_at),
  };
}

/** The answer with beams that is nearest to the time of the pattern. */
function beamsAt(stamp) {
  const time = Date.parse(stamp);
  const answers = [feeds.beams.data, ...history.moments.slice(-3).map((moment) => moment.answer)];
  const distance = (answer) => Math.abs(Date.parse(answer.valid_at) - time);
  return answers.filter((answer) => answer)
    .reduce((best, one) => (best && distance(best) <= distance(one) ? best : one), null);
}

/** Fill the history with the service's samples from before this page was opened, or of a gap. */
async function fillHistory() {
  const answer = await askOnce("/v1/history?rounded=true");
  if (!Array.isArray(answer?.at) || !answer.carrier) return;
  history.fill(momentsOf(answer, performance.now()));
  charts.changeUnits(); // drawn again
  refresh();
}

function begin() {
  isFilled = true;
  loadMeanings().then(() => {
    table.showLabels();
    refresh();
  });
  fillHistory();
}

/** Process an answer. UAVs and beams of one beat are a moment of the history. */
function take(name) {
  if (name === "uavs" && !isFilled) begin();
  const now = performance.now();
  const { uavs, beams } = feeds;
  if (name === "uavs" && uavs.data.valid_at) outage.noteUavs(uavs.data.valid_at, now);
  if (name === "status") outage.noteStatus(feeds.status.data, now);
  const together = Math.abs(uavs.answeredAt - (beams.answeredAt ?? -Infinity)) < SAME_BEAT_MS;
  const isFresh = uavs.answeredAt !== null && uavs.answeredAt > (history.newest?.at ?? -1);
  if (isFresh && (together || !beams.isTrusted(now))) {
    history.add(presentMoment(now));
  }
  const present = presentMoment(now);
  last.note(present, beamedUav(present.answer), now);
  gathering ??= setTimeout(refresh, GATHER_MS);
}

/** Mark values of late or outdated answers. A past moment is never outdated. */
function markAges(now, all = false) {
  const root = document.documentElement;
  for (const feed of Object.values(feeds)) {
    const past = !timebar.isLive && feed.name !== "recordings";
    const lost = all || (feed.data !== null && !feed.isTrusted(now));
    toggleAttribute(root, `data-${feed.name}-lost`, lost && !past);
    toggleAttribute(root, `data-${feed.name}-late`, feed.health(now) === "late" && !past);
  }
}

/** States of all feeds: a change is shown at once, even without an answer. */
const healthsAt = (now) => Object.values(feeds).map((feed) => feed.health(now)).join()
  + connection(feeds, now).state;

function look() {
  const now = performance.now();
  if (now - shown.at > AGES_MS || healthsAt(now) !== shown.healths) refresh();
}

/** Refresh everything. A failure is displayed, as a frozen page would look live. */
function refresh() {
  clearTimeout(gathering);
  gathering = null;
  const now = performance.now();
  const link = connection(feeds, now);
  shown = { at: now, healths: healthsAt(now) };
  try {
    markAges(now, link.state === "lost");
    showAll(link, now);
    faulted = false;
  } catch (error) {
    showFault(error);
    markAges(now, true);
    if (!faulted) console.error(error); // once, not at every refresh
    faulted = true;
  }
}

function showAll(link, now) {
  const found = timebar.shown ?? liveView(now);
  const carrier = found.carrier ?? carrierOf(found.status);
  const middle = last.middle(carrier, found.uavs);
  const uavs = found.uavs.map((uav) => placedBy(uav, middle));
  folds.makeRoom(uavs.length);
  const view = { ...found, carrier, middle, uavs };
  if (selected !== null && !view.uavs.some((uav) => uav.id === selected)) selected = null;
  const { status } = feeds;
  showConnection(link, feeds.uavs.data?.valid_at,
    status.isTrusted(now) ? status.data.health?.behind : null);
  showRecordings(feeds.recordings.data, (name) => player.open(name));
  alarm.watch(feeds.uavs.data?.uavs ?? [], link.state === "lost" && !link.never, now);
  timebar.draw(now);
  showMoment(view, link, now);
  plan.history = timebar.history;
  showPlan(view, link, now);
  const pastAt = timebar.shown?.at ?? null;
  if (isOpen("fold-charts")) {
    const until = timebar.recording ? view.at : now;
    charts.show(timebar.history, view.uavs, { selected, pastAt, now: until });
  }
  nameThePage(view, link);
}

/** The newest answers; outdated ones are marked, not hidden. */
function liveView(now) {
  const answers = Object.fromEntries(KEPT.map((name) => [name, feeds[name].data]));
  const view = { ...presentMoment(now), ...answers, answer: answers.beams };
  return { ...view, beams: last.beamsOf(view.uavs, answers.beams?.beams ?? [], now) };
}

/** Whether the values of a feed are shown as valid; those of a past moment always are. */
function believed(feed, link, now) {
  return !timebar.isLive || (link.state !== "lost" && feed.isTrusted(now));
}

function showMoment(view, link, now) {
  if (feeds.status.data) rejections.note(feeds.status.data.rejected ?? {}, now);
  showStatus(view.status);
  showReadiness(view.status);
  rejections.show(view.status?.rejected, timebar.isLive ? now : view.at);
  showBeams(view.answer);
  showLinks(view.links);
  showEvents(view.events);
  fleet.show(view.fleet, selected);
  showCount(view.uavs);
  showHeadline(view.uavs);
  showTroubles(view.uavs, pick);
  table.update(view.uavs, {
    beams: new Map(view.beams.map((beam) => [beam.uav, beam])),
    array: view.answer?.array,
    sinceS: timebar.isLive ? feeds.uavs.silenceS(now) : 0,
    selected,
  });
  if (isOpen("fold-focus")) showFocus(view, link, now);
  drawer.show(view, timebar.isLive, now);
}

/** Details of one beam; without one, the last beam in grey. */
function showFocus(view, link, now) {
  const uav = beamedUav(view.answer);
  const isOld = uav === null && timebar.isLive && last.picture !== null;
  focus.show(isOld ? last.picture : view, isOld ? last.picture.uav : uav, {
    isLive: timebar.isLive,
    oldS: isOld ? (now - last.picture.at) / 1000 : null,
    patternTrusted: !isOld && believed(feeds.pattern, link, now),
    weightsTrusted: !isOld && believed(feeds.weights, link, now),
  });
}

function showCount(uavs) {
  const parts = STATE_ORDER
    .map((state) => [state, uavs.filter((uav) => uav.state === state).length])
    .filter(([, number]) => number > 0)
    .map(([state, number]) => `${number} ${state}`);
  setText($("uavs-count"), parts.join(" · "));
  $("uavs-empty").hidden = uavs.length > 0;
  setText($("uavs-empty"), feeds.uavs.data ? "No UAV has reported a position."
    : "Nothing received yet.");
}

/** Message in the plan view while it is not live; empty while it is. */
function planMessage(view, link, now) {
  if (timebar.recording) return `RECORDING – ${format.clock(timebar.shown.stamp)}`;
  if (!timebar.isLive) {
    return `NOT LIVE – ${format.duration((now - timebar.shown.at) / 1000)} ago`;
  }
  if (link.never) return "NOT LIVE – no connection";
  if (link.state === "lost") return "NOT LIVE – connection lost";
  if (link.state === "token") return "NOT LIVE – token needed";
  if (feeds.uavs.health(now) === "frozen") return "NOT LIVE – estimates stopped";
  if (feeds.uavs.health(now) === "lost") return "NOT LIVE – no answer for UAVs";
  const { unfit, ageS } = view.carrier ?? {};
  if (!unfit) return "";
  return format.known(ageS) ? `${unfit}: carrier and beams from ${format.duration(ageS)} ago` : unfit;
}

function showPlan(view, link, now) {
  if (format.known(view.carrier?.lat_deg)) ground.place = view.carrier;
  const message = planMessage(view, link, now);
  $("legend").toggleAttribute("data-raised", Boolean(message)); // above it
  plan.show({
    uavs: view.uavs,
    beams: view.beams,
    array: view.answer?.array ?? last.array ?? null,
    carrier: view.carrier,
    nodes: nodesAround(view.fleet, view.middle),
    uavsLive: believed(feeds.uavs, link, now),
    beamsLive: believed(feeds.beams, link, now),
    message,
    isPast: !timebar.isLive,
    selected,
    at: view.at,
    answers: `${feeds.uavs.answeredAt} ${feeds.beams.answeredAt}`,
  }, now);
}

/** Set the tab's title and the picture's name to the state, also for screen readers. */
function nameThePage({ uavs, beams, status }, link) {
  const trouble = { lost: "CONNECTION LOST", partial: "CONNECTION FAILING", token: "TOKEN", frozen: "STOPPED" };
  const state = trouble[link.state] ?? (timebar.isLive ? "" : timebar.recording ? "RECORDING" : "PAUSED");
  setText($("node-name"), status?.node ?? "");
  const title = [state || headlineOf(uavs).text, status?.node, "companion"].filter(Boolean)
    .join(" · ");
  if (document.title !== title) document.title = title;
  const name = `${plan.space ? "3D view" : "Plan view"}: ${uavs.length} UAVs, ${beams.length} beams`
    + (state ? `, not live: ${state.toLowerCase()}` : "");
  if ($("plan").getAttribute("aria-label") !== name) $("plan").setAttribute("aria-label", name);
}

// --- controls -----------------------------------------------------------------------------------

/** Select a UAV; selecting it again deselects it. */
function choose(id) {
  selected = id === selected ? null : id;
  feeds.pattern.wake();
  markPlan();
  refresh();
}

/** Select with the pointer: opens the UAV's drawer; if it is open, closes it and deselects. */
function pick(id) {
  const isShown = id === null || drawer.id === id;
  if (isShown ? selected !== null : selected !== id) choose(isShown ? selected : id);
  if (isShown) drawer.close();
  else drawer.open(id);
  refresh();
}

function chooseNth(n) {
  const id = table.ids[n - 1];
  if (id !== undefined && id !== selected) choose(id);
}

function chooseNext(step) {
  const { ids } = table;
  if (!ids.length) return;
  const from = selected === null ? (step > 0 ? -1 : ids.length) : ids.indexOf(selected);
  const id = ids[Math.max(0, Math.min(ids.length - 1, from + step))];
  if (id !== selected) choose(id);
  table.reveal(id);
}

function markPlan() {
  $("zoom-fit").setAttribute("aria-pressed", String(plan.isFitted));
  $("follow").setAttribute("aria-pressed", String(plan.followed !== null));
  $("space").setAttribute("aria-pressed", String(plan.space !== null));
  $("follow").disabled = selected === null && plan.followed === null;
}

function control(action) {
  action();
  markPlan();
}

const zoomIn = () => control(() => plan.zoom(1));
const zoomOut = () => control(() => plan.zoom(-1));
const fitAll = () => control(() => plan.fitAll());
const TURN_PX = 40; // rotation of the 3D view by a key, as pixels of a drag
const turn = (dx, dy) => control(() => plan.turn(dx * TURN_PX, dy * TURN_PX));

/** Switch between plan and 3D view. */
function toggleSpace() {
  if (plan.space) {
    plan.lookFrom(null);
  } else {
    plan.lookFrom(new Space());
  }
  refresh();
}

const follow = () => control(() => plan.follow(plan.followed === null ? selected : null));
const showHelp = () => $("help").showModal();

$("zoom-in").addEventListener("click", zoomIn);
$("zoom-out").addEventListener("click", zoomOut);
$("zoom-fit").addEventListener("click", fitAll);
$("follow").addEventListener("click", follow);
$("space").addEventListener("click", toggleSpace);
$("help-open").addEventListener("click", showHelp);
$("settings-open").addEventListener("click", showSettings);

const fileName = (view, end) => `companion-${(view.stamp ?? "").replace(/[:.]/g, "")}.${end}`;
$("save-csv").addEventListener("click", () => {
  const view = timebar.shown ?? liveView(performance.now());
  save(new Blob([csvOf(view)], { type: "text/csv" }), fileName(view, "csv"));
});
$("save-png").addEventListener("click", () => {
  const view = timebar.shown ?? liveView(performance.now());
  $("plan").toBlob((blob) => blob && save(blob, fileName(view, "png")));
});

// On small screens the legend is folded.
if (window.matchMedia("(max-width: 1180px)").matches) $("legend").removeAttribute("open");

const folds = new Folds((id) => {
  if (id === "fold-focus") for (const name of ["pattern", "weights"]) feeds[name].wake();
  charts.changeUnits(); // drawn again when next shown
  refresh();
});

const toggleTheme = setUpTheme($("theme"), () => {
  for (const picture of [plan, focus, charts, ground]) picture.recolour();
});

const measure = () => [plan, charts].forEach((picture) => picture.changeUnits());
setUpUnits(() => {
  measure();
  refresh();
});
measure();

setUpKeys({
  " ": () => timebar.toggle(),
  "ArrowLeft": () => timebar.step(-1),
  "ArrowRight": () => timebar.step(1),
  "Shift+ArrowLeft": () => timebar.jump(-1),
  "Shift+ArrowRight": () => timebar.jump(1),
  "Home": () => timebar.toOldest(),
  "End": () => timebar.goLive(),
  "ArrowUp": () => chooseNext(-1),
  "ArrowDown": () => chooseNext(1),
  "Escape": () => (drawer.isOpen ? drawer.close() : selected !== null && choose(selected)),
  "Enter": () => selected !== null && drawer.open(selected),
  "f": follow,
  "v": toggleSpace,
  "[": () => turn(1, 0), "]": () => turn(-1, 0), ",": () => turn(0, -1), ".": () => turn(0, 1),
  "t": toggleTheme,
  "?": showHelp,
  "+": zoomIn, "=": zoomIn, "-": zoomOut, "0": fitAll,
}, chooseNth);
setInterval(look, LOOK_MS);

ground.begin().then((found) => {
  if (found) plan.ground = ground;
  if (found) plan.redraw();
}, (error) => console.error("the map cannot be shown:", error));
