// Labels and meanings of values, from the service (/v1/labels); this page has no copy.

import { askOnce } from "./api.js";

let known = { values: {}, enumerations: {} };

/** Request them once; without an answer a value's name is its label. */
export async function loadMeanings() {
  const answer = await askOnce("/v1/labels");
  if (!answer?.values || !answer.enumerations) return;
  learn(answer);
  for (const element of document.querySelectorAll("[data-value]")) {
    const [of, name] = element.dataset.value.split(".");
    element.textContent = labelOf(of, name);
    element.title = meaningOf(of, name);
  }
}

/** Use this answer of /v1/labels. */
export function learn(answer) {
  known = answer;
}

/** Short name of a value of a class, such as ("UavState", "age_s"). */
export const labelOf = (of, name) => known.values[of]?.[name]?.label ?? name.replaceAll("_", " ");

/** Its meaning, for the tooltip. */
export const meaningOf = (of, name) => known.values[of]?.[name]?.meaning ?? "";

/** Meaning of one value of an enumeration, such as ("Reason", "frozen"). */
export const meaningOfWord = (enumeration, word) => known.enumerations[enumeration]?.[word] ?? "";
