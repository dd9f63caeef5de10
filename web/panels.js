// Everything that is words: the header, the banner, the side panels.

import { $, setAttribute, setPairs, setText, toggleAttribute } from "./dom.js";
import * as format from "./format.js";
import { meaningOfWord } from "./meanings.js";

function setChip(element, level, text) {
  setAttribute(element, "data-level", level);
  setText(element, text);
}

function setNotice(element, text) {
  toggleAttribute(element, "hidden", text === "");
  setText(element, text);
}

// --- connection ---------------------------------------------------------------------------------

const CHIPS = {
  waiting: ["wait", "reaching the service…"],
  live: ["good", "service answers"],
  late: ["warn", "service answers late"],
  partial: ["bad", "service fails in part"],
  frozen: ["bad", "estimates stopped"],
  token: ["warn", "asks for a token"],
  lost: ["bad", "connection to the service lost"],
  never: ["bad", "service not reached"],
};

function bannerText(link, lastStamp, behind) {
  const since = link.silentS === undefined ? "" : format.duration(link.silentS);
  switch (link.state) {
    case "lost":
      return link.never
        ? ["No connection", `Nothing received from the service yet (${link.problem}). `
          + "Still trying."]
        : ["CONNECTION LOST", `Nothing received for ${since} (${link.problem}). What is shown is `
          + `from ${lastStamp} and is no longer true. Still trying.`];
    case "partial":
      return ["CONNECTION FAILING", `No answer about ${link.what} (${behind ?? link.problem}): struck values `
        + "are no longer true. Still trying."];
    case "frozen":
      return ["ESTIMATES STOPPED", `The service answers, but its time stands still at ${lastStamp} `
        + `(${link.what}): struck values are no longer true.`];
    default:
      return null;
  }
}

function showBanner(title, detail) {
  $("banner").hidden = false;
  setText($("banner-title"), title);
  setText($("banner-detail"), detail);
}

/** This page itself has failed: what it shows cannot be relied on. */
export function showFault(error) {
  showBanner("DISPLAY FAULT", `This page could not show what the service sent (${error.message}). `
    + "Struck values are no longer true; reload the page.");
}

/** `behind`: that this machine does not keep up, in words, where that is so: then it is the cause. */
export function showConnection(link, lastStamp, behind = null) {
  setChip($("connection"), ...CHIPS[link.never ? "never" : link.state]);
  const text = bannerText(link, format.clock(lastStamp), behind);
  if (text) showBanner(...text);
  else $("banner").hidden = true;
}

export function showReadiness(answer) {
  const reasons = (answer?.reasons ?? []).join("; ");
  if (!answer) setChip($("readiness"), "wait", `readiness ${format.UNKNOWN}`);
  else if (answer.ready) setChip($("readiness"), "good", "ready");
  else setChip($("readiness"), "warn", "not ready");
  setNotice($("reasons"), answer && !answer.ready
    ? `Not ready: ${reasons || "no reason given"}` : "");
}

// --- status -------------------------------------------------------------------------------------

const RECORDING_LEVEL = { recording: "good", off: "", degraded: "bad" };

function showCenter(center, behind) {
  const element = $("center");
  if (!center) {
    element.dataset.level = "";
    setText(element, format.UNKNOWN);
    return;
  }
  const where = format.position(center.lat_deg, center.lon_deg);
  const parts = [center.fixed ? "fixed" : center.source ?? format.UNKNOWN];
  if (where === format.UNKNOWN) parts.push(behind ?? center.unfit ?? "no position yet");
  else {
    parts.push(where, format.length(center.alt_m), `heading ${format.bearing(center.heading_deg)}`);
  }
  if (format.known(center.age_s)) parts.push(`${format.seconds(center.age_s)} old`);
  const old = format.known(center.age_s) && center.age_s > 3;
  element.dataset.level = where === format.UNKNOWN || old ? "warn" : "";
  setText(element, parts.join(" · "));
}

function showRecording(recording) {
  const element = $("recording");
  const parts = [recording?.state ?? format.UNKNOWN];
  if (recording && format.known(recording.bytes) && recording.state !== "off") {
    parts.push(format.bytes(recording.bytes));
  }
  element.dataset.level = RECORDING_LEVEL[recording?.state] ?? "";
  element.title = recording?.file ?? "";
  setText(element, parts.join(" · "));
}

const LAG_WARN_S = 0.5; // as the service has it for being behind

/** How far behind the machine is: of no interest until beams are aimed by news that is too old. */
function showLag(lag) {
  const element = $("lag");
  const late = format.known(lag?.max_s) && lag.max_s > LAG_WARN_S;
  element.dataset.level = lag?.behind ? "bad" : late ? "warn" : "";
  setText(element, format.milliseconds(lag?.max_s));
}

/** Whose past this is, where it is one: nobody may take a replay for the air. */
function showReplay(replay) {
  const element = $("replay");
  element.hidden = !replay;
  if (!replay) return;
  const of = format.known(replay.of_s) ? ` of ${Math.round(replay.of_s)}` : "";
  const pace = format.known(replay.speed) ? `${replay.speed}×` : "max";
  const how = replay.state === "finished" ? "finished" : pace;
  setChip(element, "warn", `replay ${replay.log} · ${Math.round(replay.at_s)}${of} s · ${how}`);
}

/** Counts by reason, and when this page last saw each of them rise. */
export class Rejections {
  constructor() {
    this.seen = new Map();
    this.isFirst = true;
  }

  /** The newest counts; what was there when the page was opened has no known time. */
  note(rejected, now) {
    for (const [reason, total] of Object.entries(rejected)) {
      if (this.seen.get(reason)?.total === total) continue;
      this.seen.set(reason, { total, at: this.isFirst ? null : now });
    }
    this.isFirst = false;
  }

  /** The counts of the moment `at`, which may be past: what rose after it is not told of. */
  show(rejected, at) {
    const pairs = Object.entries(rejected ?? {})
      .sort(([, a], [, b]) => b - a)
      .map(([reason, total]) => {
        const roseAt = this.seen.get(reason)?.at ?? null;
        const when = roseAt === null || roseAt > at ? "" : ` · ${ago((at - roseAt) / 1000)}`;
        const unit = reason === "garbage" ? " B" : "";
        return [reason, `${format.count(total)}${unit}${when}`, "", meaningOfWord("Reason", reason)];
      });
    $("rejections-panel").hidden = pairs.length === 0;
    setPairs($("rejections"), pairs, format.UNKNOWN);
  }
}

function ago(seconds) {
  if (seconds < 5) return "now";
  return `${format.duration(seconds < 60 ? Math.floor(seconds / 5) * 5 : seconds)} ago`;
}

/** `status` is null where it is not known: nothing of another moment may stand there then. */
export function showStatus(status) {
  setText($("version"), status ? `v${status.version}` : "");
  setText($("uptime"), format.duration(status?.uptime_s));
  setText($("frames"), format.perSecond(status?.rates?.frames_hz));
  setText($("updates"), format.perSecond(status?.rates?.updates_hz));
  showCenter(status?.center, status?.health?.behind);
  showRecording(status?.recording);
  showLag(status?.arrival_lag);
  showReplay(status?.replay);
}

// --- beams --------------------------------------------------------------------------------------

const capital = (text) => (text ? text[0].toUpperCase() + text.slice(1) : "");

export function showBeams(answer) {
  if (!answer) {
    for (const id of ["beams-line", "beams-array"]) setText($(id), format.UNKNOWN);
    setNotice($("beams-warning"), "");
    return;
  }
  const { beams, array } = answer;
  const regularised = beams.length > 0 && (answer.regularised || answer.method === "rzf");
  setText($("beams-line"), [
    capital(meaningOfWord("Method", answer.method) || answer.method) || format.UNKNOWN,
    `${beams.length || "no"} beam${beams.length === 1 ? "" : "s"}`,
    beams.length ? `condition number ${conditionNumber(answer.condition_number)}` : "",
  ].filter(Boolean).join(" · "));
  setText($("beams-array"), array ? [
    `${format.count(array.elements)} elements (${array.kind?.toUpperCase() ?? format.UNKNOWN})`,
    format.hertz(array.frequency_hz),
    `beamwidth ${format.degrees(array.half_power_beamwidth_deg, 2)}`,
    `boresight ${format.bearing(array.boresight_bearing_deg)}`,
    `lead ${format.milliseconds(format.known(answer.lead_ms) ? answer.lead_ms / 1000 : null)}`,
  ].join(" · ") : format.UNKNOWN);
  setNotice($("beams-warning"), regularised
    ? "Nulls are not exact: each is held back where it would cost another beam more of the gain "
      + "that is sure than [beams] loss_limit_db." : "");
}

function conditionNumber(value) {
  if (!format.known(value)) return format.UNKNOWN;
  return value < 1000 ? format.fixed(value, 2) : value.toExponential(1);
}
