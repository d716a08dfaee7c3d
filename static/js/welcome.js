// What a person sees at the first visit, once.

import { byId, recall, remember } from "./dom.js";
import { openSources } from "./sources.js";
import { on } from "./state.js";

export function startWelcome() {
  const card = byId("welcome");
  card.addEventListener("close", () => remember("welcomed", "yes"));
  byId("welcome-open").addEventListener("click", () => card.addEventListener("close", openSources, { once: true }));
  let asked = false;
  on("status", ({ status }) => {
    if (asked || recall("welcomed") !== null) return;
    asked = true;
    if (status.source.startsWith("sim:")) card.showModal(); // who opens a recording knows what this is
  });
}
