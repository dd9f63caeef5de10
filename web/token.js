// The bearer token of a service that asks for one. It is asked for when it is missing or wrong, and
// kept for this tab; it is never part of an address, which logs and histories would keep.

import { $, setText } from "./dom.js";

const KEY = "companion-token";
let token = stored();
let awake = () => {};

/** Set up the dialog; `wake` is called once there is a token to try. */
export function setUpToken(wake) {
  awake = wake;
  $("token-form").addEventListener("submit", (event) => {
    event.preventDefault();
    const given = $("token-input").value.trim();
    if (!given) return;
    token = given;
    keep(given);
    $("token-input").value = "";
    $("token").close();
    awake();
  });
}

/** `fetch` with the token, if there is one. A 401 opens the dialog, which says what was wrong. */
export async function authorised(path, options = {}) {
  const tried = token;
  const headers = { ...options.headers };
  if (tried) headers.Authorization = `Bearer ${tried}`;
  const response = await fetch(path, { ...options, headers });
  if (response.status === 401 && tried === token) demand(tried !== null);
  return response;
}

/** The token that this tab keeps; null without one. */
export const tokenOfTab = () => token;

/** Whether a token is needed for what links lead to: a browser sends none with them. */
export const hasToken = () => token !== null;

function demand(wrong) {
  setText($("token-problem"), wrong ? "That token is wrong." : "");
  if (wrong) forget();
  if (!$("token").open) $("token").showModal();
}

function stored() {
  try {
    return sessionStorage.getItem(KEY);
  } catch {
    return null; // without storage it is kept as long as the page is
  }
}

function keep(given) {
  try {
    sessionStorage.setItem(KEY, given);
  } catch {
    // it is kept as long as the page is
  }
}

function forget() {
  token = null;
  try {
    sessionStorage.removeItem(KEY);
  } catch {
    // there was nothing to forget
  }
}
