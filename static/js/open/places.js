// What can be opened: recent runs, recordings in the server's folders as a tree, and simulated runs. What is typed filters them, and
// an address that does not exist is compared with them.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { count } from "../core/format.js";
import { shortSource, when } from "../runs/figures.js";
import { isLive } from "./robot_form.js";

const MOST_RECENT = 6, MOST_NEAR = 3;
const ALIKE = 0.5; // least likeness of a near miss, 0 to 1
let entries = []; // {uri, node, words}

// `choose(uri, title)` opens a place.
export async function listPlaces(choose) {
  const [{ scenarios, recordings }, { runs }] = await Promise.all([get("/api/sources"), get("/api/runs").catch(() => ({ runs: [] }))]);
  entries = [];
  const entry = (uri, title, doc, address = () => uri) => {
    const node = el("button", { type: "button", title: uri, onclick: () => choose(address()) }, el("b", { text: title }), el("span", { text: doc }));
    entries.push({ uri, node, words: `${uri} ${title} ${doc}`.toLowerCase() });
    return node;
  };
  const recent = runs.filter(({ uri }, k) => uri && runs.findIndex((other) => other.uri === uri) === k).slice(0, MOST_RECENT);
  const simulated = scenarios.map(({ uri, doc }) => entry(uri, uri, doc, () => withOptions(uri)));
  byId("source-list").replaceChildren(
    el("p", { id: "source-none", class: "empty", hidden: true }),
    ...(recent.length ? [group("Recent runs", true, recent.map((run) => entry(run.uri, named(run), `${when(run.begun_s)}, ${count(run.trees, "tree")}`)))] : []),
    ...(recordings.length ? [group("Recordings in the data folder", true, tree(recordings, entry))] : []),
    group("Simulated, with ground truth", !recent.length && !recordings.length,
      [el("p", { class: "source-options" }, option("seed", "Seed of the stand (another seed is another stand)", "0", "1"), option("duration", "Duration s", "1", "0.1", "3600")), ...simulated]));
  sift();
}

// Folder and name; many recordings have the same name.
function named({ name, uri }) {
  const short = shortSource(uri), folder = uri.split("/").at(-2);
  return name && name !== short ? name : folder ? `${folder}/${short}` : short;
}

function group(title, open, nodes) {
  return el("details", { open, "data-open": open ? "yes" : "" }, el("summary", { text: title }), ...nodes);
}

// Recordings below the folders in which they are.
function tree(recordings, entry) {
  const here = [], folders = new Map();
  for (const { uri, name, doc, rest = name } of recordings) {
    const [first, ...deeper] = rest.split("/");
    if (!deeper.length || doc) here.push(entry(uri, first, doc));
    else folders.set(first, [...(folders.get(first) ?? []), { uri, name, doc, rest: deeper.join("/") }]);
  }
  return [...here, ...[...folders].map(([name, inside]) => group(`${name}/`, folders.size === 1 && !here.length, tree(inside, entry)))];
}

const option = (name, title, min, step, max) => el("label", {}, `${title} `, el("input", { id: `source-${name}`, type: "number", min, step, max, placeholder: "standard" }));

// The address of a scenario with the typed seed and duration.
function withOptions(uri) {
  const typed = ["seed", "duration"].map((name) => [name, byId(`source-${name}`).value]).filter(([, value]) => value);
  return typed.length ? `${uri}?${new URLSearchParams(typed)}` : uri;
}

// Shows what has all typed words, with its folders open; everything where nothing is typed, or the address of a robot. That nothing has
// them says nothing of an address that is being opened.
export function sift(isOpening = false) {
  const typed = byId("source-uri").value.trim();
  const words = isLive(typed) ? [] : typed.toLowerCase().split(/\s+/).filter(Boolean);
  for (const { node, words: own } of entries) node.hidden = !words.every((word) => own.includes(word));
  for (const each of byId("source-list").querySelectorAll("details")) {
    const found = [...each.querySelectorAll(":scope button")].some((node) => !node.hidden);
    each.hidden = words.length > 0 && !found;
    each.open = words.length ? found : each.dataset.open === "yes";
  }
  const none = byId("source-none");
  if (!none) return;
  none.hidden = isOpening || !words.length || entries.some(({ node }) => !node.hidden);
  setText(none, "Not in this list. Open takes any path or address.");
}

// The first address that begins with what is typed, else the only one that is shown; null if there is none or it is typed
// completely.
export function completion() {
  const typed = byId("source-uri").value.trim().toLowerCase();
  if (!typed || isListed(typed)) return null;
  const shown = [...new Set(entries.filter(({ node }) => !node.hidden).map(({ uri }) => uri))];
  return shown.find((uri) => uri.toLowerCase().startsWith(typed)) ?? (shown.length === 1 ? shown[0] : null);
}

export const isListed = (text) => entries.some(({ uri }) => uri.toLowerCase() === text.toLowerCase());

const pairs = (text) => new Set([...text].slice(1).map((letter, k) => text[k] + letter));

// Share of the pairs of letters that two texts have in common (Dice).
function likeness(a, b) {
  const [one, two] = [pairs(a), pairs(b)];
  return (2 * [...one].filter((pair) => two.has(pair)).length) / Math.max(1, one.size + two.size);
}

// Known addresses like one that could not be opened, the most alike first; before them the router at a host and port.
export function nearMisses(uri) {
  const [, router] = /^(?:tcp\/)?([\w.-]+:\d{2,5}(?:\?\S*)?)$/.exec(uri) ?? [];
  const typed = shortSource(uri).toLowerCase();
  return [...(router ? [`zenoh:tcp/${router}`] : []), ...[...new Set(entries.map((each) => each.uri))].filter((other) => other !== uri)
    .map((other) => [other, Math.max(likeness(typed, shortSource(other).toLowerCase()), likeness(uri.toLowerCase(), other.toLowerCase()))])
    .filter(([, alike]) => alike >= ALIKE).sort((a, b) => b[1] - a[1]).map(([other]) => other)].slice(0, MOST_NEAR);
}
