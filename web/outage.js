// What was lost while this page had no data: from when to when, and whether the service restarted.
// It is shown after the recovery, until the operator acknowledges it.

import { LOST_MS } from "./api.js";
import { $, setText } from "./dom.js";
import * as format from "./format.js";

// A restart moves the start by more than this on both clocks. A late answer moves it on the page's
// clock alone, and setting the service's clock on that one alone.
const RESTART_MS = 2000;

export class Outage {
  /** `onGap` is called when answers arrive again. */
  constructor(onGap = () => {}) {
    this.onGap = onGap;
    Object.assign(this, { last: null, started: null, statusStamp: null, gap: null, since: null,
      hasRun: "" });
    $("outage-seen").addEventListener("click", () => {
      Object.assign(this, { gap: null, since: null });
      this.draw();
    });
  }

  /** Process an answer with the UAVs; `stamp` is the service's time, `now` that of this page. */
  noteUavs(stamp, now) {
    if (this.last !== null && now - this.last.at > LOST_MS) {
      Object.assign(this, { gap: { from: this.last.stamp, to: stamp }, hasRun: "" });
      this.onGap();
    }
    this.last = { at: now, stamp };
    this.draw();
  }

  /** Process an answer with the status. */
  noteStatus({ time, uptime_s: uptimeS, replay }, now) {
    // The time of a replay is that of its log.
    const clocks = replay ? [now] : [now, Date.parse(time)];
    const started = clocks.map(clock => clock - uptimeS * 1000);
    const isLater = (at, n) => at > (this.started?.[n] ?? Infinity) + RESTART_MS;
    if (started.every(isLater)) {
      this.since = replay ? null : new Date(started[1]).toISOString();
      // A restart may be shorter than what counts as a lost connection.
      this.gap ??= { from: this.statusStamp, to: time };
    }
    // Until the status is known, nothing is said of a restart.
    const hasRun = this.since ? "Tracks and counts began again." : "The service did not restart.";
    Object.assign(this, { started, statusStamp: time, hasRun });
    this.draw();
  }

  draw() {
    $("outage").hidden = !this.gap;
    if (!this.gap) return;
    const { from, to } = this.gap;
    const lostS = (Date.parse(to) - Date.parse(from)) / 1000;
    setText($("outage-title"), this.since ? `SERVICE RESTARTED at ${format.clock(this.since)}`
      : "CONNECTION RESTORED");
    setText($("outage-detail"), `No data from ${format.timeOfDay(from)} to ${format.clock(to)} `
      + `(${format.duration(lostS)}). ${this.hasRun}`.trim());
  }
}
