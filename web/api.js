// Polling. Each feed has one request in flight at most, keeps the newest answer only, backs off
// while it fails, and knows how far its answer may be trusted. Local time is performance.now():
// the clock of the browser's machine and that of the service need not agree.

const TIMEOUT_MS = 2000;
const BACKOFF_MAX_MS = 2000;
/** Without an answer for so long, what is on the screen is no longer true. */
export const LOST_MS = 3000;
/** Answers come, but the time that they are valid at stands still: as good as lost. */
const FROZEN_MS = 3000;

const isListOf = (list, key) =>
  Array.isArray(list) && list.every((entry) => typeof entry?.[key] === "string");

/** What is polled. `stamp` is the field by which the service shows that it moves on. */
const FEEDS = {
  uavs: {
    path: "/v1/uavs", periodMs: 200, lateMs: 1200, what: "UAVs",
    stamp: (data) => data.valid_at, accepts: (data) => isListOf(data?.uavs, "id"),
  },
  beams: {
    path: "/v1/beams", periodMs: 200, lateMs: 1200, what: "beams",
    stamp: (data) => data.valid_at, accepts: (data) => isListOf(data?.beams, "uav"),
  },
  status: {
    path: "/v1/status", periodMs: 1000, lateMs: 2200, what: "status",
    stamp: (data) => data.time, accepts: (data) => typeof data?.version === "string",
  },
  readyz: {
    path: "/readyz", periodMs: 1000, lateMs: 2200, what: "readiness",
    // "Not ready" is an answer, not a failure.
    statuses: [503], accepts: (data) => typeof data?.ready === "boolean",
  },
};

export class Feed {
  constructor(name, settings, onAnswer) {
    Object.assign(this, { name, ...settings, onAnswer });
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
    for (;;) {
      const begunAt = performance.now();
      await this.poll();
      const tookMs = performance.now() - begunAt;
      const waitMs = this.failures === 0
        ? Math.max(0, this.periodMs - tookMs)
        : Math.min(BACKOFF_MAX_MS, this.periodMs * 2 ** Math.min(this.failures, 8));
      await this.pause(waitMs);
    }
  }

  /** Wait, or be woken: when the page is shown again or the network comes back. */
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
    const abort = new AbortController();
    const timer = setTimeout(() => abort.abort(), TIMEOUT_MS);
    let answer = null;
    try {
      const response = await fetch(this.path, {
        signal: abort.signal, cache: "no-store", headers: { Accept: "application/json" },
      });
      if (!response.ok && !this.statuses?.includes(response.status)) {
        throw new Error(`the service answered ${response.status}`);
      }
      const data = await response.json();
      if (!this.accepts(data)) throw new Error("the answer is not what was asked for");
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
    if (this.stamp === undefined || stamp !== this.lastStamp || this.movedAt === null) {
      this.movedAt = now;
    }
    Object.assign(this, { data, answeredAt: now, lastStamp: stamp, failures: 0, problem: "" });
    this.onAnswer();
  }

  /** Seconds since the newest answer; since the start where there has been none. */
  silenceS(now = performance.now()) {
    return (now - (this.answeredAt ?? this.startedAt)) / 1000;
  }

  /** "waiting", "live", "late", "frozen" or "lost". The last two must never look live. */
  health(now = performance.now()) {
    const silentMs = this.silenceS(now) * 1000;
    if (silentMs > LOST_MS) return "lost";
    if (this.answeredAt === null) return "waiting";
    // A stamp of null is a service that has nothing to tell yet, not one that has stopped.
    if (this.stamp && this.lastStamp && now - this.movedAt > FROZEN_MS) return "frozen";
    return silentMs > this.lateMs ? "late" : "live";
  }
}

function describe(error) {
  if (error.name === "AbortError") return `no answer within ${TIMEOUT_MS / 1000} s`;
  if (error instanceof TypeError) return "the service cannot be reached";
  if (error instanceof SyntaxError) return "the answer is not JSON";
  return error.message;
}

/** Start polling; `onAnswer()` is called after each answer. Returns the feeds by name. */
export function startPolling(onAnswer) {
  const feeds = {};
  for (const [name, settings] of Object.entries(FEEDS)) {
    feeds[name] = new Feed(name, settings, onAnswer);
  }
  const wakeAll = () => Object.values(feeds).forEach((feed) => feed.wake());
  window.addEventListener("online", wakeAll);
  document.addEventListener("visibilitychange", () => document.hidden || wakeAll());
  Object.values(feeds).forEach((feed) => feed.run());
  return feeds;
}

/** The connection as one word and, where it is bad, what to tell the operator. */
export function connection(feeds, now = performance.now()) {
  const all = Object.values(feeds);
  const having = (...states) => all.filter((feed) => states.includes(feed.health(now)));
  const lost = having("lost");
  const frozen = having("frozen");
  const names = (list) => list.map((feed) => feed.what).join(", ");
  if (lost.length === all.length) {
    const silentS = Math.min(...all.map((feed) => feed.silenceS(now)));
    const never = all.every((feed) => feed.answeredAt === null);
    return { state: "lost", never, silentS, problem: lost[0].problem };
  }
  if (lost.length) return { state: "partial", what: names(lost), problem: lost[0].problem };
  if (frozen.length) return { state: "frozen", what: names(frozen) };
  if (having("waiting").length) return { state: "waiting" };
  return { state: having("late").length ? "late" : "live" };
}
