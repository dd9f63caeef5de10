// Polling. Each feed has at most one request in flight, keeps only the newest answer, backs off
// after failures, and knows whether its answer may be trusted. Local time is performance.now():
// the clocks of the browser's machine and of the service need not agree.
//
// All feeds poll on multiples of BEAT_MS. Values that are drawn together (UAVs, beams, pattern) are
// requested at the same moment; otherwise a fast UAV would appear beside its own beam. In total
// this is less than five requests a second, six in a fleet.

import { authorised, isLocked, setUpToken, unlocked } from "./token.js";

const BEAT_MS = 850;
const TIMEOUT_MS = 2000;
const BACKOFF_MAX_MS = 2000;
/** Age beyond its own period from which on a value is shown as late. */
const LATE_MS = 1150;
/** Time without an answer, beyond its period, after which a value is outdated. */
const MISSED_MS = 2150;
/** Time without any answer after which the connection counts as lost. */
export const LOST_MS = 3000;
const NO_TOKEN = "the service needs a token";
const BAD_ANSWERS = ["lost", "frozen", "waiting"];

const isListOf = (list, key) =>
  Array.isArray(list) && list.every((entry) => typeof entry?.[key] === "string");

/**
 * The feeds, each with its period in beats. `stamp` is a field that changes while the service is
 * running; `offset`, in beats, spreads the slow feeds out.
 */
const FEEDS = {
  uavs: {
    path: "/v1/uavs?rounded=true", beats: 1, what: "UAVs",
    stamp: (data) => data.valid_at, accepts: (data) => isListOf(data?.uavs, "id"),
  },
  beams: {
    path: "/v1/beams?rounded=true", beats: 1, what: "beams",
    stamp: (data) => data.valid_at, accepts: (data) => isListOf(data?.beams, "uav"),
  },
  pattern: {
    path: ({ beamed }) => beamed && `/v1/pattern?points=361&uav=${encodeURIComponent(beamed)}`,
    beats: 1, what: "pattern", accepts: (data) => Array.isArray(data?.patterns),
  },
  weights: {
    path: ({ beamed }) => beamed && `/v1/beams/weights?uav=${encodeURIComponent(beamed)}`,
    beats: 4, offset: 1, what: "weights",
    accepts: (data) => Array.isArray(data?.re) && Array.isArray(data?.im),
  },
  status: {
    path: "/v1/status", beats: 4, what: "status",
    stamp: (data) => data.time, accepts: (data) => typeof data?.version === "string",
  },
  links: {
    path: "/v1/links", beats: 6, offset: 2, what: "links",
    accepts: (data) => isListOf(data?.links, "url"),
  },
  events: {
    path: "/v1/events", beats: 6, offset: 4, what: "events",
    accepts: (data) => isListOf(data?.events, "text"),
  },
  fleet: {
    path: ({ inFleet }) => inFleet && "/v1/fleet",
    beats: 2, offset: 1, what: "the fleet",
    stamp: (data) => data.valid_at, accepts: (data) => isListOf(data?.nodes, "node"),
  },
  recordings: {
    path: "/v1/recordings", beats: 20, offset: 3, what: "recordings",
    accepts: (data) => isListOf(data?.recordings, "name"),
  },
};

export class Feed {
  /** `context()` returns what a path may depend on; a path of null is not requested now. */
  constructor(name, settings, context, onAnswer) {
    Object.assign(this, { name, offset: 0, ...settings, context, onAnswer });
    this.periodMs = this.beats * BEAT_MS;
    this.data = null; // the newest answer
    this.startedAt = performance.now();
    this.answeredAt = null; // local time of the newest answer
    this.movedAt = null; // local time at which its stamp last changed
    this.lastStamp = undefined;
    this.failures = 0;
    this.problem = "";
    this.wake = () => {};
  }

  async run() {
    await unlocked();
    this.startedAt = performance.now();
    for (;;) {
      await this.poll();
      await this.pause(this.failures === 0 ? this.untilBeatMs()
        : Math.min(BACKOFF_MAX_MS, BEAT_MS * 2 ** Math.min(this.failures, 8)));
    }
  }

  /** Milliseconds until this feed's next beat; a feed without an answer tries at each beat. */
  untilBeatMs() {
    const everyMs = this.answeredAt === null ? BEAT_MS : this.periodMs;
    const phaseMs = performance.now() - this.offset * BEAT_MS;
    return everyMs - (((phaseMs % everyMs) + everyMs) % everyMs);
  }

  /** Wait, or until woken: when the page is shown again or the network is back. */
  pause(waitMs) {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, waitMs);
      this.wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  async poll() {
    const path = typeof this.path === "function" ? this.path(this.context()) : this.path;
    if (!path) {
      // There is nothing to request: neither an answer nor a failure.
      Object.assign(this, { data: null, answeredAt: null, failures: 0, problem: "" });
      this.startedAt = performance.now();
      return;
    }
    const abort = new AbortController();
    const timer = setTimeout(() => abort.abort(), TIMEOUT_MS);
    let answer = null;
    try {
      const response = await authorised(path, {
        signal: abort.signal, cache: "no-store", headers: { Accept: "application/json" },
      });
      if (!response.ok) {
        throw new Error(response.status === 401 ? NO_TOKEN
          : `the service answered ${response.status}`);
      }
      const data = await response.json();
      if (!this.accepts(data)) throw new Error("unexpected answer");
      answer = data;
    } catch (error) {
      this.failures += 1;
      this.problem = describe(error);
    } finally {
      clearTimeout(timer);
    }
    if (answer !== null) this.take(answer);
  }

  take(data) {
    const now = performance.now();
    const stamp = this.stamp?.(data);
    if (!this.stamp || stamp !== this.lastStamp || this.movedAt === null) {
      this.movedAt = now;
    }
    Object.assign(this, { data, answeredAt: now, lastStamp: stamp, failures: 0, problem: "" });
    this.onAnswer();
  }

  /** Seconds since the newest answer, or since the start without one. */
  silenceS(now = performance.now()) {
    return (now - (this.answeredAt ?? this.startedAt)) / 1000;
  }

  /** "idle", "waiting", "live", "late", "frozen" or "lost". The last two must never look live. */
  health(now = performance.now()) {
    const silentMs = this.silenceS(now) * 1000;
    const missedMs = this.periodMs + MISSED_MS;
    const isIdle = typeof this.path === "function" && this.answeredAt === null
      && this.failures === 0;
    if (isIdle) return "idle";
    if (silentMs > missedMs) return "lost";
    if (this.answeredAt === null) return "waiting";
    // A stamp of null means that the service has no data yet, not that it has stopped.
    if (this.stamp && this.lastStamp && now - this.movedAt > missedMs) return "frozen";
    return silentMs > this.periodMs + LATE_MS ? "late" : "live";
  }

  isTrusted(now) {
    return this.data !== null && !BAD_ANSWERS.includes(this.health(now));
  }
}

function describe(error) {
  if (error.name === "AbortError") return `no answer within ${TIMEOUT_MS / 1000} s`;
  if (error instanceof TypeError) return "the service cannot be reached";
  if (error instanceof SyntaxError) return "the answer is not JSON";
  return error.message;
}

/**
 * Start polling. `context()` returns `{beamed}`, the UAV whose beam is shown, and `{inFleet}`,
 * whether this node is part of a fleet; `onAnswer(name)` is called after each answer. Returns the feeds by name.
 */
export function startPolling(context, onAnswer) {
  const feeds = {};
  for (const [name, settings] of Object.entries(FEEDS)) {
    feeds[name] = new Feed(name, settings, context, () => onAnswer(name));
  }
  const wakeAll = () => Object.values(feeds).forEach((feed) => feed.wake());
  setUpToken(wakeAll);
  window.addEventListener("online", wakeAll);
  document.addEventListener("visibilitychange", () => document.hidden || wakeAll());
  // Only after the caller has the feeds, as its context depends on them.
  queueMicrotask(() => Object.values(feeds).forEach((feed) => feed.run()));
  return feeds;
}

/** Return an optional answer; null without one. */
export async function askOnce(path) {
  try {
    const response = await authorised(path);
    return response.ok ? await response.json() : null;
  } catch {
    return null; // the caller does without
  }
}

/** The state of the connection as one word and, if it is bad, details for the operator. */
export function connection(feeds, now = performance.now()) {
  if (isLocked()) return { state: "token" };
  const all = Object.values(feeds).filter((feed) => feed.health(now) !== "idle");
  const having = (...states) => all.filter((feed) => states.includes(feed.health(now)));
  if (feeds.uavs.problem === NO_TOKEN && all.every(({ problem }) => ["", NO_TOKEN].includes(problem))) {
    return { state: "token" };
  }
  const silentS = Math.min(...all.map((feed) => feed.silenceS(now)));
  if (silentS * 1000 > LOST_MS) {
    const never = all.every((feed) => feed.answeredAt === null);
    return { state: "lost", never, silentS, problem: feeds.uavs.problem };
  }
  const lost = having("lost");
  const frozen = having("frozen");
  const names = (list) => list.map((feed) => feed.what).join(", ");
  if (lost.length) return { state: "partial", what: names(lost), problem: lost[0].problem };
  if (frozen.length) return { state: "frozen", what: names(frozen) };
  if ([feeds.uavs, feeds.beams].some((feed) => feed.health(now) === "waiting")) {
    return { state: "waiting" };
  }
  return { state: having("late").length ? "late" : "live" };
}
