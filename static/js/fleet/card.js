// A robot's card: state, figures, what is wrong, and the way to its own dashboard.

import { el, setText } from "../dom.js";
import { NONE, figure } from "../format.js";
import { colourOf } from "./map.js";

const WORDS = { starting: "Starting", playing: "Playing", paused: "Paused", finished: "Finished", waiting: "Waiting", failed: "Failed" };
const FIGURES = {
  trees: ["trees", (m) => [String(m.trees)]],
  health: ["SLAM", (m) => [m.health ?? NONE, { good: "good", weak: "warn", lost: "bad" }[m.health] ?? "soon"]],
  rate: ["Hz", (m) => [m.state === "playing" ? figure(m.rate_hz) : NONE]],
  behind: ["behind", (m) => [m.behind === null ? NONE : String(m.behind), m.behind > 20 ? "warn" : ""]],
  driven: ["m driven", (m) => [figure(m.distance_m)]],
};
const QUIET = ["starting", "failed"];

export function card(name, place, remote) {
  const cells = {};
  const list = el("dl", {}, ...Object.entries(FIGURES).map(([key, [title]]) => {
    cells[key] = { value: el("dd", { text: NONE }) };
    cells[key].cell = el("div", { "data-figure": key }, el("dt", { text: title }), cells[key].value);
    return cells[key].cell;
  }));
  const state = el("div", { class: "state", role: "status" }, el("i", { "aria-hidden": "true" }), el("b", {}));
  const canvas = el("canvas", { role: "img", "aria-label": `Map of ${name}` });
  const words = el("p", { class: "words" });
  const foot = el("span", {});
  const link = remote ? el("span", { class: "dim", text: "Mapped on the robot" })
    : el("a", { class: "small", href: `/robots/${encodeURIComponent(name)}`, text: "Open its dashboard", hidden: true });
  const node = el("article", { class: "card", "data-robot": name, "aria-label": name },
    el("h2", {}, el("i", { "aria-hidden": "true", text: letterOf(place) }), name), canvas, state, el("small", { class: "source" }), list, words,
    el("div", { class: "foot" }, foot, link));
  node.style.setProperty("--robot-colour", colourOf(place));
  return { node, canvas, state, cells, words, foot, link, source: node.querySelector(".source") };
}

// Never colour alone: the letter stands on the map too.
export const letterOf = (place) => String.fromCharCode(65 + (place % 26));

export function fillCard(made, member) {
  made.state.dataset.state = member.state;
  setText(made.state.querySelector("b"), member.live && member.state === "playing" ? "Live" : (WORDS[member.state] ?? member.state));
  setText(made.source, member.source);
  for (const [key, [, read]] of Object.entries(FIGURES)) {
    const [text, meaning] = QUIET.includes(member.state) ? [NONE] : read(member);
    setText(made.cells[key].value, text);
    made.cells[key].cell.className = meaning ?? "";
  }
  made.link.hidden = !member.remote && !member.answers; // a link to what does not answer yet would only hang
  setText(made.words, wordsOf(member));
  made.words.classList.toggle("bad", member.state === "failed");
  const lost = member.recording.startsWith("not");
  setText(made.foot, member.recording ? `${lost ? "⚠" : "●"} ${member.recording}` : "");
  made.foot.classList.toggle("bad", lost);
}

function wordsOf({ detail, clearance, state }) {
  if (detail) return detail;
  if (state !== "playing" || !clearance) return "";
  return { slow: `▲ Slow: obstacle ${figure(clearance.ahead_m)} m ahead`, stop: `■ Stop: obstacle ${figure(clearance.ahead_m)} m ahead` }[clearance.zone] ?? "";
}
