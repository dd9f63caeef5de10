// The header, the banner and the side panels.

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
  waiting: ["wait", "connecting…"],
  live: ["good", "connected"],
  late: ["warn", "answers are late"],
  partial: ["bad", "some requests fail"],
  frozen: ["bad", "estimates stopped"],
  token: ["warn", "token needed"],
  lost: ["bad", "connection lost"],
  never: ["bad", "not connected"],
};

function bannerText(link, lastStamp, behind) {
  const since = link.silentS === undefined ? "" : format.duration(link.silentS);
  switch (link.state) {
    case "lost":
      return link.never
        ? ["No connection", `No answer from the service yet (${link.problem}). Retrying.`]
        : ["CONNECTION LOST", `No answer for ${since} (${link.problem}). All values are from `
          + `${lastStamp} and outdated. Retrying.`];
    case "partial":
      return ["CONNECTION FAILING", `No answer for ${link.what} (${behind ?? link.problem}). `
        + "Struck-through values are outdated. Retrying."];
    case "frozen":
      return ["ESTIMATES STOPPED", `The service answers, but its time has stopped at ${lastStamp} `
        + `(${link.what}). Struck-through values are outdated.`];
    default:
      return null;
  }
}

function showBanner(title, detail) {
  $("banner").hidden = false;
  setText($("banner-title"), title);
  setText($("banner-detail"), detail);
}

/** Report a defect of this page, whose values are then unreliable. */
export function showFault(error) {
  showBanner("DISPLAY FAULT", `This page could not display an answer (${error.message}). `
    + "Struck-through values are outdated; reload the page.");
}

/** `behind`: text if this machine is overloaded, which is then the cause; else null. */
export function showConnection(link, lastStamp, behind = null) {
  setChip($("connection"), ...CHIPS[link.never ? "never" : link.state]);
  const text = bannerText(link, format.clock(lastStamp), behind);
  if (text) showBanner(...text);
  else $("banner").hidden = true;
}

export function showReadiness(status) {
  const reasons = status?.not_ready ?? [];
  if (!status) setChip($("readiness"), "wait", `readiness ${format.UNKNOWN}`);
  else if (reasons.length) setChip($("readiness"), "warn", "not ready");
  else setChip($("readiness"), "good", "ready");
  setNotice($("reasons"), reasons.length ? `Not ready: ${reasons.join("; ")}` : "");
}

// --- status -------------------------------------------------------------------------------------

const RECORDING_LEVEL = { recording: "good", off: "", degraded: "bad" };

function mountText(observed) {
  const angle = (name) => `${name} ${observed[`mount_${name}_deg`].toFixed(1)}°`;
  const error = `The array sees an attitude error of ${observed.error_deg.toFixed(1)}°`;
  return `${error}. It is corrected. Mount that explains it: ${["roll", "pitch", "yaw"].map(angle).join(", ")}`;
}

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
  if (format.known(center.attitude_bound_deg) && !center.fixed) {
    const seen = center.observed?.uavs;
    const by = seen ? ` by ${seen} observed UAV${seen === 1 ? "" : "s"}` : "";
    parts.push(`attitude ± ${center.attitude_bound_deg.toFixed(1)}°${by}`);
  }
  element.title = center.observed ? mountText(center.observed) : "";
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

const LAG_WARN_S = 0.5; // the service's limit for being overloaded

/** Delay of frames; marked only if beams would use data that are too old. */
function showLag(lag) {
  const element = $("lag");
  const late = format.known(lag?.max_s) && lag.max_s > LAG_WARN_S;
  element.dataset.level = lag?.behind ? "bad" : late ? "warn" : "";
  setText(element, format.milliseconds(lag?.max_s));
}

/** Show that this is a replay, so that it is not mistaken for a live flight. */
function showReplay(replay) {
  const element = $("replay");
  element.hidden = !replay;
  if (!replay) return;
  const of = format.known(replay.of_s) ? ` of ${Math.round(replay.of_s)}` : "";
  const pace = format.known(replay.speed) ? `${replay.speed}×` : "max";
  const how = replay.state === "finished" ? "finished" : pace;
  setChip(element, "warn", `replay ${replay.log} · ${Math.round(replay.at_s)}${of} s · ${how}`);
}

/** Counts by reason, and the time at which each last rose. */
export class Rejections {
  constructor() {
    this.seen = new Map();
    this.isFirst = true;
  }

  /** Store the newest counts; those from before the page was opened have no time. */
  note(rejected, now) {
    for (const [reason, total] of Object.entries(rejected)) {
      if (this.seen.get(reason)?.total === total) continue;
      this.seen.set(reason, { total, at: this.isFirst ? null : now });
    }
    this.isFirst = false;
  }

  /** Show the counts at the moment `at`, which may be past; later rises are omitted. */
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

/** `status` is null if unknown; then no values of another moment may remain. */
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
    ? "Nulls are not exact: exact ones would reduce a beam's guaranteed gain by more than "
      + "[beams] loss_limit_db." : "");
}

function conditionNumber(value) {
  if (!format.known(value)) return format.UNKNOWN;
  return value < 1000 ? format.fixed(value, 2) : value.toExponential(1);
}
