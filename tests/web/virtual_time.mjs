// Time that passes when a test says so. Timers, frames of animation and performance.now() follow
// it; nothing waits, so nothing here can be late on a busy machine.

import { setImmediate as turn } from "node:timers/promises";

const FRAME_MS = 16;

export class VirtualTime {
  constructor() {
    this.now = 1000;
    this.timers = new Map();
    this.made = 0;
    this.waits = []; // every delay passed to setTimeout
  }

  add(callback, delayMs, { everyMs = null, isFrame = false } = {}) {
    this.made += 1;
    this.timers.set(this.made, { callback, at: this.now + delayMs, everyMs, isFrame });
    return this.made;
  }

  /** Replace the browser's timers. */
  install() {
    globalThis.performance = { now: () => this.now };
    globalThis.setTimeout = (callback, delayMs = 0) => {
      this.waits.push(delayMs);
      return this.add(callback, delayMs);
    };
    globalThis.setInterval = (callback, everyMs) => this.add(callback, everyMs, { everyMs });
    globalThis.requestAnimationFrame = (callback) =>
      this.add(callback, FRAME_MS, { isFrame: true });
    globalThis.clearTimeout = (id) => this.timers.delete(id);
    globalThis.clearInterval = globalThis.clearTimeout;
  }

  run(id) {
    const timer = this.timers.get(id);
    if (timer.everyMs === null) this.timers.delete(id);
    else timer.at += timer.everyMs;
    timer.callback(this.now);
  }

  /** Advance time; due callbacks run in order, promises included. */
  async advance(ms) {
    const end = this.now + ms;
    await turn();
    for (;;) {
      const due = [...this.timers].filter(([, timer]) => timer.at <= end)
        .sort(([a, one], [b, other]) => one.at - other.at || a - b)[0];
      if (!due) break;
      this.now = Math.max(this.now, due[1].at);
      this.run(due[0]);
      await turn();
    }
    this.now = end;
  }

  /** Run pending animation frames without advancing time; returns their number. */
  paint(atMost = 1000) {
    for (let frames = 0; frames < atMost; frames += 1) {
      const due = [...this.timers].find(([, timer]) => timer.isFrame);
      if (!due) return frames;
      this.run(due[0]);
    }
    return atMost;
  }
}
