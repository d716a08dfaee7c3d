// What a person sees at the first visit, once.

import { byId, recall, remember } from "./dom.js";
import { openSources } from "./sources.js";

export function startWelcome() {
  const card = byId("welcome");
  card.addEventListener("close", () => remember("welcomed", "yes"));
  byId("welcome-open").addEventListener("click", () => card.addEventListener("close", openSources, { once: true }));
  if (recall("welcomed") === null) card.showModal();
}
