// One UAV's drawer: its values, its requests, and opening and closing.

import assert from "node:assert/strict";
import { test } from "node:test";

import { load } from "./browser.mjs";
import { stampAt, uav, weak } from "./service.mjs";
import { BEAT_MS, openPage } from "./whole_page.mjs";

const { modeOf } = await load("modes.js");
const ARDUPILOT = { type: "MAV_AUTOPILOT_ARDUPILOTMEGA" };
const HEARTBEAT = { autopilot: ARDUPILOT, mavtype: { type: "MAV_TYPE_QUADROTOR" },
  custom_mode: 4, base_mode: { bits: 217 } };
const MESSAGES = "/v1/mavlink/vehicles/2/components/1/messages";

async function openDrawer(page, nth = 1) {
  page.document.querySelectorAll(".pick")[nth].click();
  await page.time.advance(3 * BEAT_MS);
  const facts = page.element("drawer-facts").children
    .map((one) => one.children.map(({ textContent }) => textContent.replaceAll("\u00a0", " ")));
  return Object.fromEntries(facts);
}

test("modes have their autopilot's names, or a number", () => {
  assert.equal(modeOf(HEARTBEAT), "Guided, armed");
  const plane = { ...HEARTBEAT, mavtype: { type: "MAV_TYPE_FIXED_WING" }, custom_mode: 10 };
  assert.equal(modeOf({ ...plane, base_mode: { bits: 0 } }), "Auto, disarmed");
  const px4 = { ...HEARTBEAT, autopilot: { type: "MAV_AUTOPILOT_PX4" } };
  assert.equal(modeOf({ ...px4, custom_mode: 3 << 16 }), "Position, armed");
  assert.equal(modeOf({ ...px4, custom_mode: (4 << 16) | (5 << 24) }), "Return, armed");
  assert.equal(modeOf({ ...HEARTBEAT, custom_mode: 99 }), "mode 99, armed");
  assert.equal(modeOf(undefined), null);
});

test("a click opens the drawer with all values of the UAV and requests its messages", async () => {
  const page = await openPage();
  const sysStatus = { voltage_battery: 15100, battery_remaining: 76 };
  page.service.answers[MESSAGES] = {
    HEARTBEAT: { message: HEARTBEAT }, SYS_STATUS: { message: sysStatus },
  };
  page.service.answers["/v1/events"] = { events: [
    { at: stampAt(1), severity: "info", subject: "2:1", text: "2:1 is live" },
    { at: stampAt(2), severity: "info", subject: "12:1", text: "links to 12:1, 2:1: good" },
    { at: stampAt(3), severity: "info", subject: "12:1", text: "12:1 is live" },
  ] };
  const fields = { clock: { kind: "timesync", guarantee: "measured" }, clock_bound_s: 0.003,
    assumptions: { limits_source: "type", speed_max_mps: 30, acceleration_max_mps2: 4 },
    recent_rejections: [{ at: stampAt(1), reason: "frozen", detail: "" }] };
  page.service.uavs = [uav("1:1"), uav("2:1", { ...weak(), ...fields, climb_rate_mps: -1.25 })];
  assert.equal(page.element("drawer").hidden, true);
  await page.time.advance(6 * BEAT_MS);
  const facts = await openDrawer(page, 0); // the weak UAV is first
  assert.equal(page.element("drawer").hidden, false);
  assert.deepEqual([page.text("drawer-title"), page.text("drawer-verdict")], ["2:1", "link weak"]);
  assert.equal(page.text("coordinates"), "47.0009000, 8.0000000, 500.0");
  assert.equal(facts["Climb rate"], "−1.3 m/s");
  assert.deepEqual([facts.Mode, facts.Battery, facts.Clock, facts.Assumed],
    ["Guided, armed", "76 % · 15.1 V", "timesync, measured, to 3 ms", "30.0 m/s, 4.0 m/s² (type)"]);
  assert.equal(page.text("drawer-rejections"), "13:00:01frozen");
  assert.equal(page.text("drawer-events"), "13:00:02links to 12:1, 2:1: good13:00:012:1 is live");
});

test("values not received are dashes: no battery of 0", async () => {
  const page = await openPage();
  page.service.answers[MESSAGES] = {
    SYS_STATUS: { message: { voltage_battery: 65535, battery_remaining: -1 } },
  };
  const { Mode, Battery, Clock, Assumed } = await openDrawer(page);
  assert.deepEqual([Mode, Battery, Clock, Assumed], ["–", "–", "–", "–"]);
});

test("Escape closes the drawer and ends its requests, then clears the selection", async () => {
  const page = await openPage();
  await openDrawer(page);
  page.press("Escape");
  assert.deepEqual([page.element("drawer").hidden, page.chosen()], [true, ["2:1"]]);
  const asked = page.service.count(MESSAGES);
  assert.ok(asked >= 1 && asked <= 2, asked); // every other second
  await page.time.advance(10 * BEAT_MS);
  assert.equal(page.service.count(MESSAGES), asked);
  page.press("Enter");
  assert.equal(page.element("drawer").hidden, false);
  page.press("Escape");
  page.press("Escape");
  assert.deepEqual(page.chosen(), []);
});

test("no messages are requested for relayed aircraft", async () => {
  for (const id of ["icao:4CA7B3", "rid:1581F5", "cot:HAWK"]) {
    const page = await openPage({ ids: [id] });
    await openDrawer(page, 0);
    const [system, component] = id.split(":");
    const path = `/v1/mavlink/vehicles/${system}/components/${component}/messages`;
    assert.equal(page.service.count(path), 0);
  }
});
