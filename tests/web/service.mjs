// What answers the page in the service's place, with answers of the shapes that the API has; and
// it fails in the ways in which a service, or the way to it, fails.

import { LABELS } from "./browser.mjs";

export const START = Date.parse("2026-11-20T13:00:00.000Z");
export const stampAt = (seconds) => new Date(START + seconds * 1000).toISOString();

/** The carrier's position in these responses. */
export const LAT = 47.0;
export const LON = 8.0;

/** Health of a verdict; good by default. */
export const health = (fields = {}) => ({
  cause: null, reason: null, remedy: null, since: stampAt(0), needed_gain_db: 6,
  guaranteed_gain_db: 15.2, likely_gain_db: 17, ...fields,
});

/** A verdict with its reason, as a UAV has it. */
export const weak = (verdict = "weak", fields = {}) => ({
  verdict, health: health({
    cause: "rate", reason: "reports 1.1 s apart", remedy: "ask for 10 Hz", ...fields,
  }),
});

/** One UAV as /v1/uavs has it, flying by default still at 100 m north of the carrier. */
export const uav = (id, fields = {}) => ({
  id, state: "live", target: true, same_as: null, callsign: null, relays: [], fix: null,
  valid_at: stampAt(0), age_s: 0.2, lat_deg: LAT + 0.0009, lon_deg: LON, alt_m: 500,
  north_m: 100, east_m: 0, down_m: -50, velocity_ned_mps: [0, 0, 0], speed_mps: 0,
  bound_m: 4.2, horizontal_bound_m: 4, vertical_bound_m: 2, clock: null, dt_s: 0.25, latency_s: 0.03,
  climb_rate_mps: 0,
  verdict: "good", health: health(), served_by: null, innovation_m: 0.4, gamma: 1, reports: 10, rejected: {}, recent_rejections: [], ...fields,
});

/** One beam as /v1/beams has it, due north. */
export const beam = (id, fields = {}) => ({
  uav: id, azimuth_deg: 0, elevation_deg: 5, range_m: 112, bearing_deg: 0, gain_db: 17.5,
  guaranteed_gain_db: 15.2, loss_db: 0.1, group: 0, widened: false, pointing_bound_deg: 1.5,
  ...fields,
});

/** A line of elements facing north, 10° wide along boresight. */
export const array = (fields = {}) => ({
  kind: "ula", elements: 8, frequency_hz: 5.8e9, half_power_beamwidth_deg: 10,
  half_power_beamwidth_elevation_deg: null, boresight_bearing_deg: 0, ...fields,
});

export const beamsAnswer = (beams, fields = {}) => ({
  valid_at: stampAt(0), age_s: 0.02, lead_ms: 20, beams, array: array(), method: "zf",
  policy: "regularise", condition_number: 1.5, regularised: false, groups: 1, unfit: null,
  left_out: [], ...fields,
});

export const patternAnswer = (id, fields = {}) => ({
  valid_at: stampAt(0), lead_ms: 20, cut: "azimuth", method: "zf", angles_deg: [-180, -90, 0, 90],
  patterns: [{
    uav: id, at_deg: 5, target_deg: 0, response_db: [-30, -10, 18, -10], peak_azimuth_deg: 0,
    peak_elevation_deg: 5, peak_db: 18, half_power_beamwidth_deg: 10, side_lobe_db: -13,
    null_depths_db: {}, ...fields,
  }],
});

export const statusAnswer = (fields = {}) => ({
  version: "1.2.3", node: null, time: stampAt(0), uptime_s: 65,
  center: { source: "5:1", fixed: false, lat_deg: LAT, lon_deg: LON, alt_m: 450, heading_deg: 90,
    attitude_deg: null, age_s: 0.1, bound_m: 1, unfit: null, last_known: null },
  health: { good: 1, weak: 0, none: 0, headline: "1 of 1 links good", behind: null },
  not_ready: [],
  links: [], recording: { state: "off", file: null, bytes: 0, messages: 0, dropped: 0 },
  arrival_lag: { newest_s: 0.0002, p95_s: 0.001, max_s: 0.004, behind: false },
  rates: { frames_hz: 120, updates_hz: 20 }, frames: 1000, updates: 100, rejected: {},
  digest: "", replay: null, ...fields,
});

export const linkAnswer = (fields = {}) => ({
  url: "udpin:0.0.0.0:14550", state: "up", age_s: 0.1, frames: 12345, bad_crc: 0, gaps: 3,
  reports: { total: 10, first: 5, first_share: 0.5, latency_p50_s: 0.002, latency_p95_s: 0.005 },
  components: [{ id: "1:1" }], ...fields,
});

/** A node of the fleet as /v1/fleet has it, another one by default. */
export const otherNode = (node, fields = {}) => ({
  node, is_self: false, state: "there", reason: null,
  place: { lat_deg: LAT + 0.001, lon_deg: LON, alt_m: 450 }, reach_m: 900, serves: 1, most: 8,
  heard_s: 0.1, clock_offset_s: 0.0015, clock_doubt_s: 0.0008, frames: 100, used: 7,
  way_p50_ms: 5, way_p99_ms: 12, ...fields,
});

/** A UAV of the fleet, served by north. */
export const fleetUav = (id, fields = {}) => ({
  uav: id, served_by: ["north"], handing_to: null, unconfirmed: false,
  offers: [
    { node: "north", sure_db: 11, likely_db: 12, sinr_db: 30, heard_s: 0.1 },
    { node: "south", sure_db: null, likely_db: 9.5, sinr_db: 20, heard_s: null },
  ], ...fields,
});

/** North and south; no node serves 10:1. */
export const fleetAnswer = (fields = {}) => ({
  valid_at: null, node: "north", site: "harbour",
  nodes: [otherNode("north", { is_self: true, state: "here" }), otherNode("south")],
  uavs: [fleetUav("1:1"), fleetUav("2:1", { served_by: ["south"] }),
    fleetUav("10:1", { served_by: [], offers: [] })],
  handovers: [
    { time: stampAt(1), uav: "1:1", before: null, after: "north" },
    { time: stampAt(2), uav: "2:1", before: "north", after: "south" },
  ],
  sent_bps: 14_000, heard_bps: 900, damaged: 0, ...fields,
});

export class Service {
  constructor(time) {
    this.time = time;
    this.startedAt = time.now;
    this.mode = "answers"; // or "silent", "gone", "frozen"
    this.asked = []; // {path, at, …} and other properties of the request
    this.open = []; // paths that are being answered
    this.mostOpen = 0; // requests at the same time for the same thing
    this.uavs = [uav("1:1")];
    this.beams = [beam("1:1")];
    this.status = statusAnswer();
    this.answers = {}; // response to a path instead: data, or {status, body}
    globalThis.fetch = (path, options) => this.fetch(path, options);
  }

  stamp() {
    if (this.mode !== "frozen") this.seconds = (this.time.now - this.startedAt) / 1000;
    return stampAt(this.seconds);
  }

  answer(path) {
    const [place, query = ""] = path.split("?");
    if (place in this.answers) return this.answers[place];
    const stamp = this.stamp();
    const asked = new URLSearchParams(query);
    const ids = this.beams.map((one) => one.uav);
    switch (place) {
      case "/v1/labels": return LABELS;
      case "/v1/uavs": return { valid_at: stamp, uavs: this.uavs };
      case "/v1/beams": return beamsAnswer(this.beams, { valid_at: stamp });
      case "/v1/pattern":
        return ids.includes(asked.get("uav"))
          ? { ...patternAnswer(asked.get("uav")), valid_at: stamp } : { status: 404, body: "{}" };
      case "/v1/beams/weights":
        return { uavs: ids, re: [ids.map(() => 1), ids.map(() => 0)],
          im: [ids.map(() => 0), ids.map(() => 1)] };
      case "/v1/status": return { ...this.status, time: stamp };
      case "/v1/links": return { valid_at: stamp, links: [linkAnswer({ components: this.uavs })] };
      case "/v1/events":
        return { events: [{ at: stampAt(0), severity: "info", text: "1:1 is live" }] };
      case "/v1/recordings": return { recordings: [] };
      case "/healthz": return { status: "ok", needs_token: false };
      default: return { status: 404, body: "{}" };
    }
  }

  async fetch(path, options = {}) {
    const place = path.split("?")[0];
    this.asked.push({ path, at: this.time.now, ...options });
    this.open.push(place);
    this.mostOpen = Math.max(this.mostOpen, this.open.filter((one) => one === place).length);
    try {
      return await this.respond(path, options.signal);
    } finally {
      this.open.splice(this.open.indexOf(place), 1);
    }
  }

  async respond(path, signal) {
    if (this.mode === "gone") throw new TypeError("fetch failed");
    if (this.mode === "silent") {
      await new Promise((_, refuse) => {
        signal?.addEventListener("abort", () => refuse(signal.reason));
      });
    }
    const { status = 200, body, ...data } = this.answer(path);
    const text = body ?? JSON.stringify(data);
    return { status, ok: status >= 200 && status < 300, json: async () => JSON.parse(text) };
  }

  /** Number of requests for a path since a time. */
  count(path, since = 0) {
    return this.asked.filter((one) => one.path.split("?")[0] === path && one.at >= since).length;
  }
}
