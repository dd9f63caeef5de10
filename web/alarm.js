// An alarm for an operator who does not watch the page. It is off by default, and the browser
// stores the choice. It sounds, and shows a bar, until it is acknowledged.

import { $, setText } from "./dom.js";
import { rankOf } from "./health.js";

const KEY = "companion.alarm";
const REPEAT_MS = 2000;
const TONES_HZ = [880, 660];
const TONE_S = 0.18;

function remembered() {
  try {
    return localStorage.getItem(KEY) === "on";
  } catch {
    return false; // storage is blocked: off until it is switched on again
  }
}

function remember(isOn) {
  try {
    localStorage.setItem(KEY, isOn ? "on" : "off");
  } catch {
    // storage is blocked: the choice holds until the page is closed
  }
}

export class Alarm {
  constructor() {
    Object.assign(this, { isOn: remembered(), ranks: new Map(), wasLost: false, soundedAt: 0 });
    this.unseen = ""; // text of the alarm that is not acknowledged yet
    this.sound = null;
    $("alarm").addEventListener("click", () => this.switch(!this.isOn));
    $("alarm-seen").addEventListener("click", () => this.see());
    // Browsers allow sound only after an interaction with the page.
    document.addEventListener("pointerdown", () => this.isOn && this.wakeSound());
    this.draw();
  }

  switch(isOn) {
    this.isOn = isOn;
    remember(isOn);
    if (isOn) this.wakeSound();
    this.see();
  }

  see() {
    this.unseen = "";
    this.draw();
  }

  /** Check the present UAVs; `isLost`: the connection to the service is lost. */
  watch(uavs, isLost, now) {
    // A good link is no alarm, even without a verdict before, as while another node served it.
    const worse = uavs.filter((uav) => uav.verdict !== "good"
      && rankOf(uav) < (this.ranks.get(uav.id) ?? -1));
    if (!isLost) this.ranks = new Map(uavs.map((uav) => [uav.id, rankOf(uav)]));
    if (!this.isOn) return;
    if (isLost && !this.wasLost) this.unseen = "connection to the service lost";
    else if (worse.length) {
      this.unseen = worse.map((uav) => `link to ${uav.id}: ${uav.verdict}`).join(", ");
    }
    this.wasLost = isLost;
    this.draw();
    if (this.unseen && now - this.soundedAt > REPEAT_MS) this.beep(now);
  }

  wakeSound() {
    if (!this.sound && globalThis.AudioContext) this.sound = new AudioContext();
    this.sound?.resume();
  }

  beep(now) {
    this.soundedAt = now;
    if (this.sound?.state !== "running") return;
    TONES_HZ.forEach((tone, i) => {
      const oscillator = this.sound.createOscillator();
      oscillator.frequency.value = tone;
      oscillator.connect(this.sound.destination);
      oscillator.start(this.sound.currentTime + i * TONE_S);
      oscillator.stop(this.sound.currentTime + (i + 1) * TONE_S);
    });
  }

  draw() {
    setText($("alarm"), this.isOn ? "Alarm on" : "Alarm off");
    $("alarm").setAttribute("aria-pressed", String(this.isOn));
    $("alarm-bar").hidden = !this.unseen;
    setText($("alarm-text"), this.unseen ? `ALARM – ${this.unseen}` : "");
  }
}
