// Pause and look back. A past moment is marked prominently.

import { $, setText } from "./dom.js";
import * as format from "./format.js";

const JUMP_MS = 10_000;

export class TimeBar {
  constructor(history, onChange) {
    Object.assign(this, { history, onChange });
    this.shown = null; // the displayed moment; null while the page is live
    $("pause").addEventListener("click", () => this.toggle());
    $("scrub").addEventListener("input", () => {
      const agoMs = -Number($("scrub").value) * 1000;
      this.show(this.history.at(performance.now() - agoMs));
    });
  }

  get isLive() {
    return this.shown === null;
  }

  toggle() {
    if (this.isLive) this.show(this.history.newest);
    else this.goLive();
  }

  goLive() {
    this.shown = null;
    this.onChange();
  }

  /** Show this moment until another one is selected. */
  show(moment) {
    if (moment === null) return; // nothing has been received yet
    this.shown = moment;
    this.onChange();
  }

  showAt(at) {
    this.show(this.history.at(at));
  }

  /** One answer back or forward. */
  step(steps) {
    const from = this.shown ?? this.history.newest;
    if (from) this.show(this.history.stepFrom(from, steps));
  }

  /** Ten seconds back or forward. */
  jump(direction) {
    const from = this.shown ?? this.history.newest;
    if (from) this.showAt(from.at + direction * JUMP_MS);
  }

  toOldest() {
    this.show(this.history.moments[0] ?? null);
  }

  draw(now) {
    const { isLive, history } = this;
    const reachS = history.moments.length ? (now - history.moments[0].at) / 1000 : 0;
    const agoS = isLive ? 0 : (now - this.shown.at) / 1000;
    document.documentElement.toggleAttribute("data-past", !isLive);
    const scrub = $("scrub");
    scrub.min = String(-Math.ceil(reachS));
    // While it is dragged the operator sets it; otherwise it follows the displayed moment.
    if (!scrub.matches(":active")) scrub.value = String(-agoS);
    scrub.setAttribute("aria-valuetext", isLive ? "live" : `${format.duration(agoS)} ago`);
    setText($("pause"), isLive ? "❚❚ Pause" : "▶ Live");
    $("pause").setAttribute("aria-pressed", String(!isLive));
    setText($("reach"), `−${format.duration(reachS)}`);
    setText($("time-mode"), isLive ? "now" : `−${format.duration(agoS)}`);
    $("past").hidden = isLive;
    if (isLive) return;
    const what = this.shown.isSampled ? "From the service's samples of positions and links, one per"
      + " second:" : "Everything except the connection is from";
    setText($("past-detail"), `${what} ${format.clock(this.shown.stamp)}, ${
      format.duration(agoS)} ago. Space: back to live.`);
  }
}
