// Pause, look back, and recordings. A past moment, and a recording, are marked prominently.

import { $, setText } from "./dom.js";
import * as format from "./format.js";

const JUMP_MS = 10_000;

export class TimeBar {
  constructor(history, onChange) {
    Object.assign(this, { ofPage: history, onChange });
    this.shown = null; // the displayed moment; null while the page is live
    this.recording = null; // {name, history, endAt, at, isPlaying} of an opened recording
    $("pause").addEventListener("click", () => this.toggle());
    $("scrub").addEventListener("input", () => {
      const agoMs = -Number($("scrub").value) * 1000;
      this.showAt(this.end(performance.now()) - agoMs);
    });
  }

  /** What the time bar spans: the history of this page, or a recording. */
  get history() {
    return this.recording?.history ?? this.ofPage;
  }

  /** The time at the end of the bar, on the clock of this page. */
  end(now) {
    return this.recording?.endAt ?? now;
  }

  /** Show a recording from its beginning, `{name, history, endAt}`, and play it. */
  openRecording(recording) {
    const [first] = recording.history.moments;
    this.recording = { ...recording, at: first.at, isPlaying: true };
    this.show(first);
  }

  /** Play the recording on; it stops at its end. */
  advance(byMs) {
    const { recording } = this;
    recording.at = Math.min(recording.endAt, recording.at + byMs);
    if (recording.at >= recording.history.newest.at) recording.isPlaying = false;
    this.shown = recording.history.at(recording.at);
    this.onChange();
  }

  get isLive() {
    return this.shown === null;
  }

  toggle() {
    const { recording } = this;
    if (recording) {
      if (recording.at >= recording.history.newest.at) recording.at = recording.history.moments[0].at;
      recording.isPlaying = !recording.isPlaying;
      this.onChange();
    } else if (this.isLive) this.show(this.history.newest);
    else this.goLive();
  }

  goLive() {
    Object.assign(this, { shown: null, recording: null });
    this.onChange();
  }

  /** Show this moment until another one is selected. */
  show(moment) {
    if (moment === null) return; // nothing has been received yet
    this.shown = moment;
    if (this.recording) this.recording.at = moment.at;
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
    const { isLive, history, recording } = this;
    const end = this.end(now);
    const reachS = history.moments.length ? (end - history.moments[0].at) / 1000 : 0;
    const agoS = isLive ? 0 : (end - this.shown.at) / 1000;
    document.documentElement.toggleAttribute("data-past", !isLive);
    const scrub = $("scrub");
    scrub.min = String(-Math.ceil(reachS));
    // While it is dragged the operator sets it; otherwise it follows the displayed moment.
    if (!scrub.matches(":active")) scrub.value = String(-agoS);
    scrub.setAttribute("aria-valuetext", isLive ? "live" : `${format.duration(agoS)} ago`);
    setText($("pause"), isLive || recording?.isPlaying ? "❚❚ Pause" : recording ? "▶ Play" : "▶ Live");
    $("pause").setAttribute("aria-pressed", String(!isLive && !recording?.isPlaying));
    $("speed").hidden = !recording;
    setText($("reach"), `−${format.duration(reachS)}`);
    setText($("time-mode"), isLive ? "now" : `−${format.duration(agoS)}`);
    $("past").hidden = isLive;
    document.documentElement.toggleAttribute("data-recording", recording !== null);
    if (isLive) return;
    if (recording) {
      setText($("past-title"), "RECORDING – NOT LIVE");
      setText($("past-detail"), `${recording.name}: ${this.shown.stamp?.slice(0, 10)} ${
        format.clock(this.shown.stamp)}. Positions, links and beams, sampled.`);
      return;
    }
    setText($("past-title"), "NOT LIVE – PAUSED");
    const what = this.shown.isSampled ? "From the service's samples of positions and links, one per"
      + " second:" : "Everything except the connection is from";
    setText($("past-detail"), `${what} ${format.clock(this.shown.stamp)}, ${
      format.duration(agoS)} ago. Space: back to live.`);
  }
}
