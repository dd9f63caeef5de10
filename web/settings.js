// The effective settings, read only: those that were set, with their origin, then the defaults.

import { askOnce } from "./api.js";
import { $, make, setText } from "./dom.js";

const written = (value) => (value === null ? "–" : typeof value === "string" ? value
  : JSON.stringify(value));

const fromWhom = ({ source, file, default: plain }) =>
  ` – from ${file ? `${source} ${file}` : `the ${source}`}, default ${written(plain)}`;

function sectionOf([name, keys], isSet) {
  const rows = Object.entries(keys).filter(([, { source }]) => (source !== "default") === isSet);
  if (!rows.length) return [];
  return [make("h3", {}, `[${name}]`), make("dl", { class: "settings" }, ...rows.map(
    ([key, said]) => make("div", {}, make("dt", {}, key), make("dd", {}, written(said.value),
      make("span", { class: "muted" }, isSet ? fromWhom(said) : ""))),
  ))];
}

/** Request the settings and show them. */
export async function showSettings() {
  const answer = await askOnce("/v1/settings");
  const sections = Object.entries(answer?.sections ?? {});
  setText($("settings-problem"), answer ? "" : "The service did not send its settings.");
  const all = (isSet) => sections.flatMap((section) => sectionOf(section, isSet));
  $("settings-set").replaceChildren(...all(true));
  $("settings-default").replaceChildren(...all(false));
  $("settings").showModal();
}
