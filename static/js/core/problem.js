// A failed request or action: what happened and what to do, in a corner of the page until it is closed or replaced.

import { el, setText } from "./dom.js";

const SHOWN_FOR = 15_000; // [ms]
let box = null, timer = 0;

const hide = () => { box.hidden = true; };

function build() {
  box = el("div", { id: "problem", class: "toast problem", role: "alert", hidden: true }, el("span"),
    el("button", { type: "button", class: "small", text: "Close", onclick: hide }));
  document.body.append(box);
}

export function showProblem(error) {
  if (!box) build();
  const text = typeof error === "string" ? error : error.message;
  setText(box.firstChild, text.charAt(0).toUpperCase() + text.slice(1));
  // An open dialog covers everything outside of it.
  (document.querySelector("dialog[open]") ?? document.body).append(box);
  box.hidden = false;
  clearTimeout(timer);
  timer = setTimeout(hide, SHOWN_FOR);
}

// Runs an asynchronous action of a person; a failure is shown. Returns its result, or undefined after a failure.
export async function attempted(action) {
  try {
    return await action();
  } catch (error) {
    showProblem(error);
  }
}
