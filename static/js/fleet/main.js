// The page of all robots: what the server tells of each, a card each and one map.

import { byId, el, setText } from "../core/dom.js";
import { figure, NONE } from "../core/format.js";
import { on } from "../core/store.js";
import { startTheme } from "../core/theme.js";
import { colourOf, drawCommon, drawOwn } from "./map.js";

const FIRST_WAIT = 500, LONGEST_WAIT = 5000;
const cards = new Map(); // by the robot's name
const places = new Map(); // colour and letter of a name, which stay its own when others leave
let maps = {};
let members = [];
let wait = FIRST_WAIT;
let lostAt = 0;

function showMembers(message) {
  members = message.members;
  const notice = byId("fleet-notice");
  if (!lostAt) {
    notice.hidden = !message.notice;
    setText(notice, message.notice);
  }
  const live = members.filter(({ state }) => state === "playing").length;
  setText(byId("fleet-count"), members.length ? `${members.length} of them, ${live} mapping now` : "");
  const there = new Set(members.map(({ name }) => name));
  for (const [name, { node }] of cards) {
    if (there.has(name)) continue;
    node.remove();
    cards.delete(name);
  }
  for (const member of members) {
    if (!cards.has(member.name)) {
      cards.set(member.name, card(member.name, placeOf(member.name), member.remote));
      byId("cards").append(cards.get(member.name).node);
    }
    fillCard(cards.get(member.name), member);
  }
  byId("cards").querySelector(".empty")?.remove();
  if (!members.length) byId("cards").append(el("p", { class: "empty", text: "No robot yet. Each one that sends scans gets a card here as soon as it is heard." }));
}

function placeOf(name) {
  if (!places.has(name)) places.set(name, places.size);
  return places.get(name);
}

function showMaps(message) {
  maps = message.maps;
  repaint();
}

function repaint() {
  for (const { name } of members) drawOwn(cards.get(name)?.canvas, maps[name], placeOf(name));
  const shared = members.map(({ name }) => ({ name, k: placeOf(name), map: maps[name] })).filter(({ map }) => map?.common);
  drawCommon(byId("common-map"), shared);
  const apart = members.filter(({ name }) => maps[name] && !maps[name].common);
  const words = [];
  if (shared.length > 1) words.push(shared.slice(1).map(({ name, map }) => `${name}: ${map.how}`).join("; "));
  if (apart.length) words.push(`Not on this map: ${apart.map(({ name }) => `${name} (${maps[name].how})`).join("; ")}`);
  setText(byId("common-words"), words.join(". "));
}

const takers = { fleet: showMembers, maps: showMaps };

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/api/fleet`);
  socket.onopen = () => {
    wait = FIRST_WAIT;
    lostAt = 0;
    document.body.classList.remove("lost");
    byId("fleet-notice").classList.remove("bad");
  };
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    takers[message.type]?.(message);
  };
  socket.onclose = () => {
    lostAt ||= performance.now();
    document.body.classList.add("lost");
    setTimeout(connect, wait);
    wait = Math.min(2 * wait, LONGEST_WAIT);
  };
}

setInterval(() => {
  if (!lostAt) return;
  const notice = byId("fleet-notice");
  notice.hidden = false;
  notice.classList.add("bad");
  setText(notice, `No connection for ${Math.floor((performance.now() - lostAt) / 1000)} s. This is the last picture; it goes on by itself when stemmap answers again.`);
}, 1000);
addEventListener("resize", repaint);
on("theme", repaint);
startTheme();
connect();

// --- A robot's card: state, figures, what is wrong, and the way to its own dashboard.

const WORDS = { starting: "Starting", playing: "Playing", paused: "Paused", finished: "Finished", waiting: "Waiting", failed: "Failed" };
const FIGURES = {
  trees: ["trees", (m) => [String(m.trees)]],
  health: ["SLAM", (m) => [m.health ?? NONE, { good: "good", weak: "warn", lost: "bad" }[m.health] ?? "soon"]],
  rate: ["Hz", (m) => [m.state === "playing" ? figure(m.rate_hz) : NONE]],
  behind: ["behind", (m) => [m.behind === null ? NONE : String(m.behind), m.behind > 20 ? "warn" : ""]],
  driven: ["m driven", (m) => [figure(m.distance_m)]],
};
const QUIET = ["starting", "failed"];

function card(name, place, remote) {
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

function fillCard(made, member) {
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
