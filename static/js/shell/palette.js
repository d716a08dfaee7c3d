// Ctrl+K: a searchable list of all actions.

import { byId, el } from "../core/dom.js";
import { mayDo } from "../core/permissions.js";
import { ACTIONS } from "./actions.js";
import { presentActions } from "./dynamic_actions.js";

const MOST = 60; // listed entries
const FILLERS = new Set(["a", "an", "and", "fewer", "for", "in", "into", "less", "more", "of", "on", "the", "to"]);
let found = [], chosen = 0, before = null;

const dialog = () => byId("palette");

export function openPalette() {
  before = document.activeElement;
  byId("palette-find").value = "";
  dialog().showModal();
  sift();
}

// All words except FILLERS must occur in the title or the keywords of an entry. Order: tabs whose name begins with the text, titles
// that begin with it, titles with a word that begins with the first word, other titles, keywords.
function search(text) {
  const words = text.toLowerCase().split(/\s+/).filter((word) => word && !FILLERS.has(word));
  const all = [...ACTIONS.map(([title, keys, , run, , more]) => [title, keys, run, more ?? ""]), ...presentActions()].filter(([, , run]) => mayDo(run));
  const fitting = all.filter(([title, , , more = ""]) => words.every((word) => `${title} ${more}`.toLowerCase().includes(word)));
  return fitting.map((entry, place) => ({ entry, place, rank: rankOf(entry[0], words, text) })).sort((a, b) => a.rank - b.rank || a.place - b.place).map(({ entry }) => entry);
}

function rankOf(title, words, text) {
  const low = title.toLowerCase();
  if (!words.every((word) => low.includes(word))) return 4;
  if (/^Tree \d/.test(title) && !/\d/.test(text)) return 3;
  if (words.length && low.startsWith(`tab ${words.join(" ")}`)) return -1;
  if (low.startsWith(words.join(" "))) return 0;
  return low.split(/\W+/).some((word) => words.length && word.startsWith(words[0])) ? 1 : 2;
}

function sift() {
  const all = search(byId("palette-find").value.trim());
  found = all.slice(0, MOST);
  chosen = 0;
  byId("palette-list").replaceChildren(...found.map(([title, keys], place) =>
    el("li", { id: `palette-${place}`, role: "option", onclick: () => run(place), onpointermove: () => choose(place) }, el("span", { text: title }), ...keys.split(" ").filter(Boolean).map((key) => el("kbd", { text: key })))));
  byId("palette-none").hidden = found.length > 0;
  byId("palette-more").textContent = all.length > MOST ? `and ${all.length - MOST} more; type to narrow them down` : "";
  choose(0);
}

function choose(place) {
  if (!found.length) return byId("palette-find").removeAttribute("aria-activedescendant");
  chosen = (place + found.length) % found.length;
  for (const [k, row] of [...byId("palette-list").children].entries()) row.setAttribute("aria-selected", String(k === chosen));
  byId("palette-find").setAttribute("aria-activedescendant", `palette-${chosen}`);
}

function run(place) {
  const entry = found[place];
  if (!entry) return;
  dialog().close();
  entry[2]();
}

function key(event) {
  const step = { ArrowDown: 1, ArrowUp: -1, PageDown: 8, PageUp: -8 }[event.key];
  if (step) {
    event.preventDefault();
    choose(Math.abs(step) === 1 ? chosen + step : Math.min(found.length - 1, Math.max(0, chosen + step)));
    byId(`palette-${chosen}`)?.scrollIntoView({ block: "nearest" });
  } else if (event.key === "Enter") {
    event.preventDefault();
    run(chosen);
  }
}

export function startPalette() {
  byId("palette-find").addEventListener("input", sift);
  byId("palette-find").addEventListener("keydown", key);
  byId("palette-button").addEventListener("click", openPalette);
  dialog().addEventListener("click", (event) => event.target === dialog() && dialog().close()); // a click outside
  dialog().addEventListener("close", () => document.activeElement === document.body && before?.focus());
}
