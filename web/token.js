// The bearer token of a service that needs one. The user is asked for it if it is missing or wrong.
// It is stored for this tab, and never part of a URL, which logs and histories would keep.

import { $, setText } from "./dom.js";

const KEY = "companion-token";
let token = stored();
let awake = () => {};
let asked = null; // promise of the answer to whether a token is needed
let lock = null; // function that lets requests be sent; null: they may be

/** Set up the dialog; `wake` is called when a token was entered. */
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
    lock?.();
    awake();
  });
}

/** Whether the service needs a token and none was entered yet. */
export const isLocked = () => lock !== null;

/** Wait until requests may be sent: an open path says whether they need a token. */
export function unlocked() {
  asked ??= ask();
  return asked;
}

async function ask() {
  let needed = false;
  try {
    const answer = await fetch("/healthz", { cache: "no-store" });
    needed = answer.ok && (await answer.json()).needs_token === true;
  } catch {
    // the service cannot be reached: the requests that follow find that out
  }
  if (!needed || token !== null) return;
  await new Promise((resolve) => {
    lock = resolve;
    demand(false);
  });
  lock = null;
}

/** `fetch` with the token, if there is one. A 401 opens the dialog with the problem. */
export async function authorised(path, options = {}) {
  await unlocked();
  const tried = token;
  const headers = { ...options.headers };
  if (tried) headers.Authorization = `Bearer ${tried}`;
  const response = await fetch(path, { ...options, headers });
  if (response.status === 401 && tried === token) demand(tried !== null);
  return response;
}

/** The stored token of this tab; null without one. */
export const tokenOfTab = () => token;

/** Whether downloads need a token, which a browser does not send with plain links. */
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
    return null; // storage is blocked: it is kept until the page is closed
  }
}

function keep(given) {
  try {
    sessionStorage.setItem(KEY, given);
  } catch {
    // storage is blocked: it is kept until the page is closed
  }
}

function forget() {
  token = null;
  try {
    sessionStorage.removeItem(KEY);
  } catch {
    // storage is blocked: nothing is stored
  }
}
