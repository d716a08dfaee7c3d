// The tabs below the map (ARIA pattern), and the drawer that holds map and tabs in a narrow window.

import { byId, recall, remember } from "../core/dom.js";
import { changed } from "../core/store.js";

export const NAMES = ["trees", "clusters", "story", "tune", "annotate", "scores", "plots", "charts"];
let current = NAMES[0];

export const visible = (name) => name === current;

export function openTab(name) {
  current = name;
  for (const each of NAMES) {
    const tab = byId(`tab-${each}`);
    tab.setAttribute("aria-selected", String(each === name));
    tab.tabIndex = each === name ? 0 : -1;
    byId(`panel-${each}`).hidden = each !== name;
  }
  changed("tab");
}

export function startTabs() {
  for (const [place, name] of NAMES.entries()) {
    const tab = byId(`tab-${name}`);
    tab.addEventListener("click", () => openTab(name));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step || event.shiftKey) return;
      event.stopPropagation();
      const next = NAMES[(place + step + NAMES.length) % NAMES.length];
      openTab(next);
      byId(`tab-${next}`).focus();
    });
  }
}

export function startDrawer() {
  const button = byId("drawer-button"), side = byId("side");
  const show = (open) => {
    side.classList.toggle("open", open);
    button.setAttribute("aria-expanded", String(open));
    remember("drawer", open ? "open" : "closed");
  };
  show(recall("drawer") === "open");
  button.addEventListener("click", () => show(!side.classList.contains("open")));
}
