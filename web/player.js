// A recording of the service, played on this page in place of the live flight.

import { $, setText } from "./dom.js";
import * as format from "./format.js";
import { History, momentsOf } from "./history.js";
import { authorised } from "./token.js";

const ASK_MS = 500;
const BEAT_MS = 200;
/** Multiples of the recording's own speed. */
const SPEEDS = [1, 5, 20];

export class Player {
  /** `onShow(recording)` is called with an opened recording, `{name, history, endAt}`. */
  constructor(timebar, onShow) {
    Object.assign(this, { timebar, onShow, wanted: null, timer: null, speed: SPEEDS[0] });
    $("to-live").addEventListener("click", () => timebar.goLive());
    $("speed").addEventListener("click", () => {
      this.speed = SPEEDS[(SPEEDS.indexOf(this.speed) + 1) % SPEEDS.length];
      this.draw();
    });
    this.draw();
  }

  draw() {
    setText($("speed"), `${this.speed}×`);
  }

  /** Request a recording until it has been read, and play it. A second request replaces the first. */
  async open(name) {
    this.wanted = name;
    for (;;) {
      const answer = await this.ask(name);
      if (this.wanted !== name) return;
      if (answer.samples?.at?.length) {
        setText($("recordings-said"), "");
        this.play(name, answer.samples);
        return;
      }
      setText($("recordings-said"), answer.said ?? `${name} holds no positions of UAVs`);
      if (!answer.isReading) return;
      await new Promise((resolve) => { setTimeout(resolve, ASK_MS); });
    }
  }

  async ask(name) {
    try {
      const response = await authorised(`/v1/recordings/${encodeURIComponent(name)}/history`);
      const body = await response.json();
      if (response.status === 202) {
        const of = format.known(body.of_s) ? ` of ${format.duration(body.of_s)}` : "";
        return { isReading: true, said: `Reading ${name}: ${format.duration(body.at_s)}${of}` };
      }
      return response.ok ? { samples: body } : { said: body.title };
    } catch {
      return { said: "the service cannot be reached" };
    }
  }

  play(name, samples) {
    const history = new History();
    const endAt = performance.now();
    history.moments = momentsOf(samples, endAt);
    this.timebar.openRecording({ name, history, endAt });
    this.run();
    this.onShow();
  }

  /** Advance while the recording is played, whatever the operator does meanwhile. */
  run() {
    clearInterval(this.timer);
    let before = performance.now();
    this.timer = setInterval(() => {
      const now = performance.now();
      const { recording } = this.timebar;
      if (!recording) clearInterval(this.timer);
      else if (recording.isPlaying) this.timebar.advance((now - before) * this.speed);
      before = now;
    }, BEAT_MS);
  }
}
