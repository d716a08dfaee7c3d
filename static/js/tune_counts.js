// How many clusters of the standing scan ended with each verdict, before the last change and now.

import { el } from "./dom.js";
import { count } from "./format.js";
import { nothingYet } from "./nothing_yet.js";
import { state } from "./state.js";
import { counted, verdictOf } from "./verdicts.js";

const signed = (number) => (number > 0 ? `+${number}` : number < 0 ? `−${-number}` : "=");

export function countsBeforeAfter() {
  if (!state.map) return [el("p", { class: "empty", text: `${nothingYet("No scan")} Then every change shows here what it does.` })];
  const { verdicts: now = {}, before, index, right, wrong } = state.map;
  const then = before?.verdicts;
  const names = [...new Set(["tree", ...Object.keys(now), ...Object.keys(then ?? {})])].filter((name) => now[name] || then?.[name] || name === "tree");
  names.sort((a, b) => (b === "tree") - (a === "tree") || (now[b] ?? 0) - (now[a] ?? 0));
  const total = (of) => Object.values(of).reduce((sum, number) => sum + number, 0);
  const pending = state.status?.revision < state.parameters?.revision;
  const lead = pending ? `Scan ${index} is looked at with the new values …`
    : then ? `Scan ${index}: ${total(then)} → ${count(total(now), "cluster")} by the last change`
    : `Scan ${index}: ${count(total(now), "cluster")}. ${state.status?.state === "playing" ? "Pause to see before and after." : "Change something, and before and after stand here."}`;
  const same = names.filter((name) => then && name !== "tree" && (now[name] ?? 0) === (then[name] ?? 0));
  return [el("p", { class: "note dim", text: lead }),
    el("ul", { class: "chips" }, ...names.filter((name) => !same.includes(name)).map((name) => chip(name, then ? then[name] ?? 0 : null, now[name] ?? 0)), ...truthChips(right, wrong, before),
      same.length ? el("li", { class: "same", text: `as before: ${same.map((name) => counted(now[name], name)).join(", ")}` }) : "")];
}

function chip(name, then, now) {
  const [letter, meaning] = verdictOf(name);
  return change(name, then, now, el("span", { class: "letter", text: letter, style: { background: `var(--${meaning})` }, "aria-hidden": "true" }));
}

function truthChips(right, wrong, before) {
  if (right === null || right === undefined) return [];
  const ring = () => el("span", { class: "letter ring", "aria-hidden": "true" });
  return [change("at a true tree", before?.right ?? null, right, ring()), change("elsewhere", before?.wrong ?? null, wrong, ring())];
}

function change(name, then, now, sign) {
  const differs = then !== null && then !== now;
  return el("li", { "data-chip": name, class: differs ? "differs" : "" }, sign, el("span", { text: name }), el("b", { text: then === null ? String(now) : `${then} → ${now}` }),
    then === null ? "" : el("small", { text: signed(now - then) }));
}
