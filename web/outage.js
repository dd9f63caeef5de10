// What was lost while this page had no data: from when to when, and whether the service restarted.
// It is shown after the recovery, until the operator acknowledges it.

import { LOST_MS } from "./api.js";
import { $, setText } from "./dom.js";
import * as format from "./format.js";

const RESTART_MS = 2000; // a start that is later than the known one by more is another start

export class Outage {
  /** `onGap` is called when answers arrive again. */
  constructor(onGap = () => {}) {
    this.onGap = onGap;
    Object.assign(this, { last: null, startedAt: null, statusStamp: null, gap: null, since: null,
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
    const startedAt = now - uptimeS * 1000;
    if (this.startedAt !== null && startedAt > this.startedAt + RESTART_MS) {
      const stamp = new Date(Date.parse(time) - uptimeS * 1000).toISOString();
      this.since = replay ? null : stamp; // the time of a replay is that of its log
      // A restart may be shorter than what counts as a lost connection.
      this.gap ??= { from: this.statusStamp, to: time };
    }
    // Until the status is known, nothing is said of a restart.
    const hasRun = this.since ? "Tracks and counts began again." : "The service did not restart.";
    Object.assign(this, { startedAt, statusStamp: time, hasRun });
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
