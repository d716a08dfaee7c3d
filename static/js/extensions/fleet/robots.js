// The page of all robots: one card per robot, and one map of all robots whose frames are known.

import { byId, el, setText } from "../../core/dom.js";
import { count, figure, NONE } from "../../core/format.js";
import { refreshAccess, refusedText } from "../../core/permissions.js";
import { connectTo } from "../../core/socket.js";
import { on } from "../../core/store.js";
import { startTheme } from "../../core/theme.js";
import { colourOf, commonMap, letterOf, ownMap } from "./map.js";

const cards = new Map(); // by the name of the robot
const places = new Map(); // colour and letter by name; a robot keeps them when others leave
let maps = {};
let members = [];
let lostAt = 0; // when the connection was lost [ms], 0 while it is open
let refused = false; // whether the server refuses this page

function showMembers(message) {
  members = message.members;
  const notice = byId("fleet-notice");
  if (!lostAt) {
    notice.hidden = !message.notice;
    setText(notice, message.notice);
  }
  const live = members.filter(({ state }) => state === "playing").length;
  setText(byId("fleet-count"), members.length ? `${count(members.length, "robot")}, ${live} mapping now` : "");
  const there = new Set(members.map(({ name }) => name));
  for (const [name, { node }] of cards) {
    if (there.has(name)) continue;
    node.remove();
    cards.delete(name);
  }
  for (const member of members) {
    if (!cards.has(member.name)) {
      cards.set(member.name, card(member.name, placeOf(member.name)));
      byId("cards").append(cards.get(member.name).node);
    }
    fillCard(cards.get(member.name), member);
  }
  byId("cards").querySelector(".empty")?.remove();
  if (!members.length) byId("cards").append(el("p", { class: "empty", text: "No robot yet. A robot appears here as soon as its first scan arrives." }));
}

function placeOf(name) {
  if (!places.has(name)) places.set(name, places.size);
  return places.get(name);
}

function showMaps(message) {
  maps = message.maps;
  repaint();
}

const shared = () => members.map(({ name }) => ({ name, k: placeOf(name), map: maps[name] })).filter(({ map }) => map?.common);
const common = commonMap(byId("common-map"), shared);

function repaint() {
  for (const { map } of cards.values()) map.redraw();
  common.redraw();
  const [, ...others] = shared();
  const apart = members.filter(({ name }) => maps[name] && !maps[name].common);
  const texts = [];
  if (others.length) texts.push(others.map(({ name, map }) => `${name}: ${map.how}`).join("; "));
  if (apart.length) texts.push(`Not on this map: ${apart.map(({ name }) => `${name} (${maps[name].how})`).join("; ")}`);
  setText(byId("common-words"), texts.join(". "));
}

// --- the card of a robot -----------------------------------------------------------------------------

const WORDS = { starting: "Starting", playing: "Playing", paused: "Paused", finished: "Finished", waiting: "Waiting", failed: "Failed" };
const FIGURES = {
  trees: ["trees", (m) => [String(m.trees)]],
  health: ["SLAM", (m) => (m.health?.startsWith("no data") ? ["no data", "warn"] : [m.health ?? NONE, { good: "good", weak: "warn", lost: "bad" }[m.health] ?? "soon"])],
  rate: ["Hz", (m) => [m.state === "playing" ? figure(m.rate_hz) : NONE]],
  behind: ["behind", (m) => [m.behind === null ? NONE : String(m.behind), m.behind > 20 ? "warn" : ""]],
  driven: ["m driven", (m) => [figure(m.distance_m)]],
};
const NO_FIGURES = ["starting", "failed"];

function card(name, place) {
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
  const link = el("a", { class: "small", href: `/robots/${encodeURIComponent(name)}`, text: "Open its dashboard", hidden: true });
  const node = el("article", { class: "card", "data-robot": name, "aria-label": name },
    el("h2", {}, el("i", { "aria-hidden": "true", text: letterOf(place) }), name), canvas, state, el("small", { class: "source" }), list, words,
    el("div", { class: "foot" }, foot, link));
  node.style.setProperty("--robot-colour", colourOf(place));
  return { node, map: ownMap(canvas, () => maps[name], place), state, cells, words, foot, link, source: node.querySelector(".source") };
}

function fillCard(made, member) {
  made.state.dataset.state = member.state;
  setText(made.state.querySelector("b"), member.live && member.state === "playing" ? "Live" : (WORDS[member.state] ?? member.state));
  setText(made.source, member.source);
  for (const [key, [, read]] of Object.entries(FIGURES)) {
    const [text, meaning] = NO_FIGURES.includes(member.state) ? [NONE] : read(member);
    setText(made.cells[key].value, text);
    made.cells[key].cell.className = meaning ?? "";
  }
  made.link.hidden = !member.answers; // the dashboard of a robot that does not answer yet cannot be opened
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

const receivers = { fleet: showMembers, maps: showMaps };

connectTo("/api/fleet", {
  onMessage: (message) => receivers[message.type]?.(message),
  onOpen() {
    lostAt = 0;
    refused = false;
    document.body.classList.remove("lost");
    byId("fleet-notice").classList.remove("bad");
  },
  onClose() {
    lostAt ||= performance.now();
    document.body.classList.add("lost");
  },
  onRefused() {
    refused = true;
  },
});
setInterval(() => {
  if (!lostAt) return;
  const notice = byId("fleet-notice");
  notice.hidden = false;
  notice.classList.add("bad");
  setText(notice, refused ? refusedText() : `No connection for ${Math.floor((performance.now() - lostAt) / 1000)} s. The last state is shown; the page reconnects by itself.`);
}, 1000);
on("theme", repaint);
startTheme();
refreshAccess().catch(() => {}); // the text of a refusal depends on the role
