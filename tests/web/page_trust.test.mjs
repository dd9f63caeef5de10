// The whole page while answers come, come late, stand still or stay away: what is no longer true
// must never look live, and once it is true again must not look dead.

import assert from "node:assert/strict";
import { test } from "node:test";

import { readPage } from "./browser.mjs";
import { uav } from "./service.mjs";
import { BEAT_MS, openPage } from "./whole_page.mjs";

const FEEDS = ["beams", "events", "fleet", "links", "pattern", "status", "uavs", "weights"];

test("while the service responds, nothing is marked and no banner is shown", async () => {
  const page = await openPage();
  for (let i = 0; i < 40; i += 1) {
    assert.deepEqual([page.marked("late"), page.marked("lost")], [[], []]);
    assert.ok(page.element("banner").hidden);
    await page.time.advance(230);
  }
  assert.equal(page.text("connection"), "connected");
  assert.equal(page.document.title, "2 of 2 links good · companion");
  assert.equal(page.element("plan").getAttribute("aria-label"), "Plan view: 2 UAVs, 2 beams");
  assert.ok(!(await page.drawn()).texts.some((text) => text.startsWith("NOT LIVE")));
});

test("late responses mark the values that depend on them", async () => {
  const page = await openPage();
  page.service.mode = "silent";
  await page.time.advance(1700);
  assert.deepEqual(page.marked("late"), []);
  await page.time.advance(900);
  assert.deepEqual(page.marked("late"), ["beams", "pattern", "uavs"]);
  assert.deepEqual(page.marked("lost"), []);
  assert.equal(page.text("connection"), "answers are late");
});

for (const mode of ["silent", "gone"]) {
  test(`a service that is ${mode} strikes out all within four seconds, and recovers`, async () => {
    const page = await openPage();
    page.service.mode = mode;
    await page.time.advance(4000);
    assert.deepEqual(page.marked("lost").filter((name) => name !== "recordings"), FEEDS);
    assert.equal(page.text("banner-title"), "CONNECTION LOST");
    assert.equal(page.element("banner").hidden, false);
    assert.equal(page.document.title, "CONNECTION LOST · companion");
    assert.equal(page.element("plan").getAttribute("aria-label"),
      "Plan view: 2 UAVs, 2 beams, not live: connection lost");
    let plan = await page.drawn();
    plan.text("NOT LIVE – connection lost");
    assert.ok(!plan.drawn.some(({ strokeStyle }) => strokeStyle === page.colour("live")));
    page.service.mode = "answers";
    await page.time.advance(6000);
    assert.deepEqual([page.marked("lost"), page.marked("late")], [[], []]);
    assert.ok(page.element("banner").hidden);
    assert.equal(page.document.title, "2 of 2 links good · companion");
    plan = await page.drawn();
    assert.ok(plan.drawn.some(({ strokeStyle }) => strokeStyle === page.colour("live")));
    assert.ok(!plan.texts.some((text) => text.startsWith("NOT LIVE")));
  });
}

test("every feed has style rules for late and lost", async () => {
  const page = await openPage();
  page.service.mode = "gone";
  await page.time.advance(4000);
  const feeds = page.marked("lost");
  assert.deepEqual(feeds, [...FEEDS, "recordings"].sort());
  const rules = readPage("states.css").replace(/\/\*[^]*?\*\//g, "").split("}")
    .map((rule) => rule.split("{"));
  const selectorsOf = (declaration) => rules.filter(([, block]) => block?.includes(declaration))
    .flatMap(([selectors]) => selectors.split(/,(?![^(]*\))/).map((one) => one.trim()));
  const [slanted, grey, struck] = ["font-style: italic", "var(--stale)", "line-through"]
    .map(selectorsOf);
  for (const feed of feeds) {
    assert.ok(slanted.includes(`:root[data-${feed}-late] [data-feed="${feed}"]`), feed);
    assert.ok(grey.includes(`:root[data-${feed}-lost] [data-feed="${feed}"]`), feed);
    assert.ok(struck.some((one) => one.startsWith(`:root[data-${feed}-lost] `)), feed);
  }
  const standing = page.document.querySelectorAll("[data-feed]").map(({ dataset }) => dataset.feed);
  assert.deepEqual([...new Set(standing)].sort(), feeds); // every feed marks something
});

test("ages grow while no response arrives", async () => {
  const page = await openPage();
  page.service.mode = "silent";
  await page.time.advance(2500);
  assert.match(page.cells("age")[0], /^▲ 2\.\d\d s$/);
  assert.ok(page.document.querySelector("tbody tr").hasAttribute("data-old"));
});

test("without any response there is no connection", async () => {
  const page = await openPage({ mode: "gone" });
  assert.equal(page.text("connection"), "connecting…");
  assert.equal(page.text("uavs-empty"), "Nothing received yet.");
  await page.time.advance(4000);
  assert.deepEqual([page.text("connection"), page.text("banner-title")],
    ["not connected", "No connection"]);
  (await page.drawn()).text("NOT LIVE – no connection");
});

test("a service whose time does not advance has stopped", async () => {
  const page = await openPage();
  page.service.mode = "frozen";
  await page.time.advance(BEAT_MS + 3200);
  assert.equal(page.text("banner-title"), "ESTIMATES STOPPED");
  assert.equal(page.document.title, "STOPPED · companion");
  assert.ok(["uavs", "beams"].every((name) => page.marked("lost").includes(name)));
  assert.ok(!page.marked("lost").includes("links")); // they show no time
  (await page.drawn()).text("NOT LIVE – estimates stopped");
});

test("if only beams fail, UAVs stay live", async () => {
  const page = await openPage();
  page.service.answers["/v1/beams"] = { status: 500, body: "{}" };
  await page.time.advance(3200);
  assert.equal(page.text("banner-title"), "CONNECTION FAILING");
  assert.deepEqual(page.marked("lost"), ["beams"]);
  const plan = await page.drawn();
  assert.ok(!plan.texts.some((text) => text.startsWith("NOT LIVE")));
  assert.ok(plan.drawn.some(({ strokeStyle }) => strokeStyle === page.colour("live")));
  assert.equal(page.document.title, "CONNECTION FAILING · companion");
});

test("a token request is not a failed connection, and nothing looks live meanwhile", async () => {
  const page = await openPage();
  const { answer } = page.service;
  page.service.answer = (path) => (path.startsWith("/v1/") ? { status: 401, body: "{}" }
    : answer.call(page.service, path));
  await page.time.advance(20 * BEAT_MS);
  assert.equal(page.text("connection"), "token needed");
  assert.ok(page.element("banner").hidden);
  assert.ok(page.marked("lost").includes("uavs"));
  assert.match(page.document.title, /^TOKEN/);
  (await page.drawn()).text("NOT LIVE – token needed");
});

test("the service's own reason for not responding is shown if known", async () => {
  const page = await openPage();
  const cause = "this machine is overloaded: frames wait up to 2.0 s";
  page.service.status.health.behind = cause;
  page.service.answers["/v1/beams"] = { status: 503, body: "{}" };
  await page.time.advance(8 * BEAT_MS);
  assert.ok(page.text("banner-detail").startsWith(`No answer for beams (${cause})`));
});

test("if only UAVs fail, the plan is not live", async () => {
  const page = await openPage();
  page.service.answers["/v1/uavs"] = { status: 500, body: "{}" };
  await page.time.advance(3200);
  assert.deepEqual(page.marked("lost"), ["uavs"]);
  (await page.drawn()).text("NOT LIVE – no answer for UAVs");
});

const IMPOSSIBLE = {
  "/v1/links": { links: [{ url: "udpin:a", state: "up", components: 7 }] },
  "/v1/uavs": { valid_at: null, uavs: [uav("1:1", { horizontal_bound_m: -4 })] },
  "/v1/pattern": { angles_deg: [], patterns: [{ uav: "1:1", peak_db: 18 }] },
  "/v1/beams/weights": { uavs: ["1:1"], re: [[1]], im: [] },
};

for (const [place, answer] of Object.entries(IMPOSSIBLE)) {
  test(`a drawing error of ${place} is reported, and the page recovers`, async (t) => {
    const complaints = t.mock.method(console, "error", () => {});
    const page = await openPage();
    page.service.answers[place] = answer;
    await page.time.advance(8 * BEAT_MS);
    for (let i = 0; i < 5; i += 1) { // it stays without flicker
      assert.equal(page.text("banner-title"), "DISPLAY FAULT");
      assert.equal(page.element("banner").hidden, false);
      assert.deepEqual(page.marked("lost").filter((name) => name !== "recordings"), FEEDS);
      await page.time.advance(110);
    }
    assert.equal(complaints.mock.callCount(), 1); // not ten times a second
    delete page.service.answers[place];
    await page.time.advance(8 * BEAT_MS);
    assert.ok(page.element("banner").hidden);
    assert.deepEqual(page.marked("lost"), []);
  });
}
