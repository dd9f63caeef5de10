// The fleet on the page: who is there, who serves whom, and that nobody whom another node serves is
// missed here.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { near } from "./near.mjs";
import { openPlan } from "./plan_picture.mjs";
import { LAT, LON, beam, fleetAnswer, fleetUav, health, otherNode, uav } from "./service.mjs";
import { BEAT_MS, openPage } from "./whole_page.mjs";

const { servingOf, nodesAround, slimFleet } = await load("fleet.js");
const { headlineOf } = await load("health.js");
const plain = (text) => text.replaceAll("\u00a0", " ");

const ELSEWHERE = { verdict: null, health: null, served_by: ["south"] };

/** The page of a node of a fleet: 1:1 is its own, south serves 2:1. */
async function openFleet(answer = fleetAnswer()) {
  const page = await openPage();
  page.service.status.node = "north";
  page.service.uavs = [uav("1:1", { served_by: ["north"] }), uav("2:1", ELSEWHERE)];
  page.service.beams = [beam("1:1")];
  page.service.answers["/v1/fleet"] = answer;
  await page.time.advance(8 * BEAT_MS);
  const rows = () => page.element("fleet-uavs").tBodies[0].rows.map((line) =>
    line.children.map(({ textContent }) => textContent));
  return { ...page, rows };
}

test("without a fleet nothing of it is requested or shown", async () => {
  const page = await openPage();
  await page.time.advance(8 * BEAT_MS);
  assert.equal(page.service.count("/v1/fleet"), 0);
  assert.ok(page.element("fleet").hidden && page.element("fleet-panel").hidden);
  assert.ok(page.element("legend").querySelectorAll("[data-fleet]").every((one) => one.hidden));
});

test("nodes are listed with state, clock and latency; unknown values are dashes", async () => {
  const page = await openFleet(fleetAnswer({ nodes: [
    otherNode("north", { is_self: true, state: "here", serves: 1 }),
    otherNode("south"),
    otherNode("west", { state: "silent", heard_s: 4.2, clock_offset_s: null, way_p99_ms: null }),
    otherNode("liar", { state: "aside", reason: "has an inconsistent clock",
      clock_offset_s: 3 }),
    otherNode("east", { state: "gone", heard_s: 61, clock_offset_s: null, way_p99_ms: null }),
  ] }));
  const items = page.element("fleet-nodes").children.map((item) => ({
    level: item.children[0].dataset.level,
    head: item.children[0].children.map(({ textContent }) => plain(textContent)).join(" "),
    facts: item.querySelectorAll("dd").map(({ textContent }) => plain(textContent)).join(" | "),
    item,
  }));
  assert.deepEqual(items.map(({ level, head }) => `${level}: ${head}`), [
    "good: north this node", "good: south there", "warn: west silent 4 s", "bad: liar aside",
    "bad: east gone 1 min 01 s",
  ]);
  assert.deepEqual(items.map(({ facts }) => facts), ["1 of 8",
    "1 of 8 | +1.5 ± 0.4 ms | 12 ms | 7", "1 of 8 | – | – | 7",
    "1 of 8 | +3.000 ± 0.000 s | 12 ms | 7", "1 of 8 | – | – | 7"]);
  assert.match(items[3].item.textContent, /not trusted: it has an inconsistent clock$/);
  assert.match(plain(page.text("fleet-traffic")), /^sent 14\.0 kbit\/s · received 900 bit\/s$/);
});

test("serving nodes of a UAV: one, two, none, handover, unconfirmed", () => {
  const said = (fields) => {
    const { text, level } = servingOf(fleetUav("1:1", fields));
    return [text, level];
  };
  assert.deepEqual(said({}), ["north", ""]);
  assert.deepEqual(said({ handing_to: "south" }), ["north → south", ""]);
  assert.deepEqual(said({ served_by: ["north", "south"], handing_to: "south" }),
    ["twice: north and south", "warn"]);
  assert.deepEqual(said({ served_by: [] }), ["no node", "bad"]);
  assert.deepEqual(said({ unconfirmed: true }), ["north · unconfirmed", "warn"]);
});

test("sorted by worst or by number; each node's offer is in its column", async () => {
  const page = await openFleet();
  assert.deepEqual(page.rows().map(([id, by]) => `${id} ${by}`),
    ["10:1 no node", "1:1 north", "2:1 south"]);
  assert.deepEqual(page.rows()[1].slice(2), ["11.0 / 12.0 · 30", "– / 9.5 · 20"]);
  assert.deepEqual(page.rows()[0].slice(2), ["–", "–"]);
  const serves = page.element("fleet-uavs").tBodies[0].querySelectorAll("[data-serves]");
  assert.deepEqual(serves.map((cell) => cell.getAttribute("data-label")), ["north", "south"]);
  const [byUav] = page.element("fleet-uavs").tHead.querySelectorAll("button");
  byUav.click();
  assert.deepEqual(page.rows().map(([id]) => id), ["1:1", "2:1", "10:1"]);
  assert.equal(byUav.parent.getAttribute("aria-sort"), "ascending");
});

test("a row stays the same element while its offers change, and is selectable", async () => {
  const answer = fleetAnswer();
  const page = await openFleet(answer);
  const first = () => page.element("fleet-uavs").tBodies[0].rows[1];
  const before = first();
  answer.uavs[0].offers[0].sinr_db = 33;
  await page.time.advance(4 * BEAT_MS);
  assert.equal(first(), before);
  assert.match(first().textContent, /· 33/);
  before.querySelector(".pick").click();
  assert.deepEqual(new Set(page.chosen()), new Set(["1:1"]));
});

test("each additional node adds a column", async () => {
  const answer = fleetAnswer();
  const page = await openFleet(answer);
  answer.nodes.push(otherNode("west"));
  await page.time.advance(4 * BEAT_MS);
  const heads = page.element("fleet-uavs").tHead.rows[0].children.map((one) => one.textContent);
  assert.deepEqual(heads, ["UAV", "Served by", "north", "south", "west"]);
  assert.ok(page.rows().every((row) => row.length === 5));
});

test("handovers are listed newest first", async () => {
  const page = await openFleet();
  const items = page.element("fleet-handovers").children.map(({ children }) =>
    children.map(({ textContent }) => textContent).join(" "));
  assert.deepEqual(items, ["13:00:02 2:1: north → south", "13:00:01 1:1: none → north"]);
});

test("a UAV of another node is neither bad nor missing here, and its node is named", async () => {
  const page = await openFleet();
  assert.equal(page.text("headline"), "1 of 1 links good · 1 with other nodes");
  assert.equal(page.element("headline").dataset.level, "good");
  assert.equal(page.document.title, "1 of 1 links good · 1 with other nodes · north · companion");
  assert.equal(page.text("node-name"), "north");
  assert.deepEqual(page.cells("verdict"), ["good", "by south"]);
  assert.deepEqual(page.cells("azimuth")[1], "–"); // our last beam for it is not kept as missing
  assert.ok(page.element("troubles-panel").hidden);
  assert.deepEqual(headlineOf([uav("1:1", ELSEWHERE)]),
    { text: "1 with other nodes", level: "wait" });
});

test("a UAV that no node serves is bad, with a remedy", async () => {
  const page = await openFleet();
  page.service.uavs = [uav("1:1"), uav("2:1", { verdict: "none", served_by: [],
    health: health({ cause: "unserved", reason: "every node that reaches it is full",
      remedy: "add a node", since: null }) })];
  await page.time.advance(2 * BEAT_MS);
  assert.equal(page.text("headline"), "1 of 2 links good");
  assert.equal(page.element("headline").dataset.level, "bad");
  assert.match(page.text("troubles"), /2:1 noneevery node that reaches it is full→ add a node/);
});

test("a UAV taken over from another node raises no alarm while good", async () => {
  const page = await openFleet();
  page.element("alarm").click();
  page.service.uavs = [uav("1:1", ELSEWHERE), uav("2:1", { served_by: ["north"] })];
  await page.time.advance(2 * BEAT_MS);
  assert.ok(page.element("alarm-bar").hidden);
  page.service.uavs = [uav("1:1", { verdict: "none", served_by: [] }), uav("2:1")];
  await page.time.advance(2 * BEAT_MS);
  assert.equal(page.text("alarm-text"), "ALARM – link to 1:1: none");
});

test("a paused page shows the fleet of its time, then the present one", async () => {
  const answer = fleetAnswer();
  const page = await openFleet(answer);
  page.press(" ");
  answer.uavs[0].served_by = ["south"];
  page.service.uavs = [uav("1:1", ELSEWHERE), uav("2:1", ELSEWHERE)];
  await page.time.advance(4 * BEAT_MS);
  const of = () => page.rows().find(([id]) => id === "1:1")[1];
  assert.deepEqual([of(), page.cells("verdict").join()], ["north", "good,by south"]);
  assert.equal(page.element("fleet").hidden, false);
  page.press(" ");
  await page.time.advance(2 * BEAT_MS);
  assert.deepEqual([of(), page.cells("verdict").join()], ["south", "by south,by south"]);
});

test("in the plan each node has a mark, a name and thin lines to its UAVs", async () => {
  const view = await openPlan();
  const nodes = [{ node: "south", state: "there", north_m: -100, east_m: 0 }];
  const shown = { nodes, uavs: [uav("1:1", { north_m: 0, east_m: 100, ...ELSEWHERE }),
    uav("2:1", { north_m: 50, east_m: 100, served_by: ["north"] })] };
  const picture = view.show(shown);
  const px = 170 / 150;
  const lines = picture.of("stroke", (one) => one.path.map(({ op }) => op).join() === "move,line"
    && Math.abs(one.path[0].y - (200 + 100 * px)) < 0.01 && Math.abs(one.path[0].x - 200) < 0.01);
  assert.equal(lines.length, 1);
  near(lines[0].path[1], { op: "line", x: 200 + 100 * px, y: 200 });
  assert.deepEqual([lines[0].lineWidth, lines[0].dash], [1, [2, 4]]);
  picture.text("south");
  const beyond = view.show({ ...shown, nodes: [{ ...nodes[0], north_m: -9000 }] });
  assert.ok(beyond.texts.some((text) => plain(text) === "south 9000 m"));
  const silent = view.show({ ...shown, nodes: [{ ...nodes[0], state: "silent" }] });
  silent.text("south silent");
});

test("nodes are drawn relative to the carrier; nodes without a position are not", () => {
  const carrier = { lat_deg: LAT, lon_deg: LON, alt_m: 450 };
  const answer = fleetAnswer({ nodes: [otherNode("north", { is_self: true }), otherNode("south"),
    otherNode("west", { place: null })] });
  const found = nodesAround(answer, carrier);
  assert.deepEqual(found.map(({ node }) => node), ["south"]);
  near(found[0].north_m, 111.2, 1);
  assert.deepEqual([nodesAround(answer, null), nodesAround(null, carrier)], [[], []]);
});

test("the newest handovers are kept for looking back", () => {
  const handovers = Array.from({ length: 100 }, (_, i) => ({ uav: `${i}:1` }));
  const kept = slimFleet(fleetAnswer({ handovers })).handovers;
  assert.deepEqual([kept.length, kept.at(-1).uav], [30, "99:1"]);
  assert.equal(slimFleet(null), null);
});
