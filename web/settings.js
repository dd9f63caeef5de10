// The settings that are in effect, to be read: what was set first, then what is as it comes.

import { askOnce } from "./api.js";
import { $, make, setText } from "./dom.js";

const written = (value) => (value === null ? "–" : typeof value === "string" ? value
  : JSON.stringify(value));

function sectionOf([name, keys], wanted) {
  const rows = Object.entries(keys).filter(([, { source }]) => source === wanted);
  if (!rows.length) return [];
  return [make("h3", {}, `[${name}]`), make("dl", { class: "settings" }, ...rows.map(
    ([key, { value, default: plain }]) => make("div", {}, make("dt", {}, key), make("dd", {},
      written(value) + (wanted === "set" ? ` (default ${written(plain)})` : ""))),
  ))];
}

/** Ask for the settings and show them. */
export async function showSettings() {
  const answer = await askOnce("/v1/settings");
  const sections = Object.entries(answer?.sections ?? {});
  setText($("settings-problem"), answer ? "" : "The service does not tell.");
  const all = (wanted) => sections.flatMap((section) => sectionOf(section, wanted));
  $("settings-set").replaceChildren(...all("set"));
  $("settings-default").replaceChildren(...all("default"));
  $("settings").showModal();
}
