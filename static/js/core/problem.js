// A line at the lower edge of the page for some seconds: a failed request or action and what to do, or news.

import { el, setText } from "./dom.js";

const SHOWN_FOR = 15_000, NEWS_FOR = 5000; // [ms]
let box = null, timer = 0;

const hide = () => { box.hidden = true; };

function build() {
  box = el("div", { id: "problem", class: "toast problem", role: "alert", hidden: true }, el("span"),
    el("button", { type: "button", class: "small", text: "Close", onclick: hide }));
  document.body.append(box);
}

export const showProblem = (error) => show(typeof error === "string" ? error : error.message, true);
// What a person did has worked: a problem of before does not hide it.
export const showDone = (text) => show(text, false);
export const showNews = (text) => { if (!box || box.hidden || !box.classList.contains("problem")) show(text, false); };

function show(text, isProblem) {
  if (!box) build();
  box.classList.toggle("problem", isProblem);
  box.setAttribute("role", isProblem ? "alert" : "status");
  setText(box.firstChild, text.charAt(0).toUpperCase() + text.slice(1));
  // An open dialog covers everything outside of it.
  (document.querySelector("dialog[open]") ?? document.body).append(box);
  box.hidden = false;
  clearTimeout(timer);
  timer = setTimeout(hide, isProblem ? SHOWN_FOR : NEWS_FOR);
}

// Runs an asynchronous action of a person; a failure is shown. Returns its result, or undefined after a failure.
export async function attempted(action) {
  try {
    return await action();
  } catch (error) {
    showProblem(error);
  }
}
