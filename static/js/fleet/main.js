// The page of all robots: what the server tells of each, a card each and one map.

import { el, byId, setText } from "../dom.js";
import { on } from "../state.js";
import { startTheme } from "../theme.js";
import { card, fillCard } from "./card.js";
import { drawCommon, drawOwn } from "./map.js";

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
