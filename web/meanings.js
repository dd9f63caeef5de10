// What the service calls its values and what they mean (/v1/labels): this page keeps no copy.

import { askOnce } from "./api.js";

let known = { values: {}, enumerations: {} };

/** Ask the service once; until it has answered, and if it does not, a value's name is its label. */
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

/** What it means, for the pointer. */
export const meaningOf = (of, name) => known.values[of]?.[name]?.meaning ?? "";

/** What one value of an enumeration means, such as ("Reason", "frozen"). */
export const meaningOfWord = (enumeration, word) => known.enumerations[enumeration]?.[word] ?? "";
