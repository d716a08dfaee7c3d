// What a person sees at the first visit, once.

import { byId, recall, remember, setText } from "./dom.js";
import { openSources } from "./sources.js";
import { on } from "./state.js";

const ROBOT = "zenoh:tcp/"; // the router's address follows

export function startWelcome() {
  const card = byId("welcome");
  card.addEventListener("close", () => remember("welcomed", "yes"));
  byId("welcome-open").addEventListener("click", () => card.addEventListener("close", () => openSources(), { once: true }));
  byId("welcome-robot").addEventListener("click", () => card.addEventListener("close", () => openSources(ROBOT), { once: true }));
  let asked = false;
  on("status", ({ status }) => {
    if (asked || recall("welcomed") !== null) return;
    asked = true;
    if (!status.source.startsWith("sim:")) return; // who opens a recording knows what this is
    const over = status.state === "finished";
    setText(byId("welcome-title"), over ? "A robot has mapped a stand of trees" : "A robot is mapping a stand of trees");
    setText(byId("welcome-on"), over ? "Look at its map" : "Keep watching");
    card.showModal();
  });
}
