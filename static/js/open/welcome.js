// The welcome card of the first visit.

import { byId, recall, remember, setText } from "../core/dom.js";
import { on } from "../core/store.js";
import { connectRobot, openSources } from "./dialog.js";

const WORDS = {
  playing: ["A robot is mapping a stand of trees", "Keep watching"],
  finished: ["A robot has mapped a stand of trees", "Show its map"],
  starting: ["A robot is about to map a stand of trees", "Keep watching"],
};

export function startWelcome() {
  const card = byId("welcome");
  card.addEventListener("close", () => remember("welcomed", "yes"));
  byId("welcome-open").addEventListener("click", () => card.addEventListener("close", () => openSources(), { once: true }));
  byId("welcome-robot").addEventListener("click", () => card.addEventListener("close", () => connectRobot(), { once: true }));
  let asked = false;
  on("status", ({ status }) => {
    if (!status.source) return; // no run is opened yet
    const first = !asked && recall("welcomed") === null;
    asked = true;
    if (!card.open && !first) return;
    if (!status.source.startsWith("sim:")) return; // the card explains the simulated run
    const [title, on] = WORDS[status.scan_index >= 0 && status.state === "starting" ? "playing" : status.state] ?? WORDS.playing;
    setText(byId("welcome-title"), title); // the title follows the state of the run while the card is open
    setText(byId("welcome-on"), on);
    if (!card.open) card.showModal();
  });
}
