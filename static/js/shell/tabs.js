// The tabs below the map (ARIA pattern), and the drawer that holds map and tabs in a narrow window.

import { byId, el, recall, remember } from "../core/dom.js";
import { changed, on, state } from "../core/store.js";
import { ofExtensions } from "./extensions.js";

export const NAMES = ["trees", "clusters", "story", "tune", "annotate", "repair", "scores", "charts"];
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
  remember("tab", name, "sessionStorage");
  changed("tab");
}

// In front of a tab of an extension that is switched off, a tab comes last.
function addTab({ name, title, before: wanted }) {
  const before = NAMES.includes(wanted) ? wanted : NAMES.at(-1);
  byId(`tab-${before}`).before(el("button", { role: "tab", id: `tab-${name}`, "aria-controls": `panel-${name}`, "aria-selected": "false", tabindex: "-1", text: title }));
  byId(`panel-${before}`).before(el("section", { id: `panel-${name}`, class: "panel", role: "tabpanel", "aria-labelledby": `tab-${name}`, hidden: true }));
  NAMES.splice(NAMES.indexOf(before), 0, name);
}

export function startTabs() {
  ofExtensions("tabs").forEach(addTab);
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

// Opens the tab that was open before this window was loaded again, once there is a map for it to show.
export function restoreTab() {
  let name = recall("tab", "sessionStorage");
  on("map", () => {
    if (!state.map || !name) return;
    if (NAMES.includes(name) && current === NAMES[0]) openTab(name);
    name = null;
  });
}

export function startDrawer() {
  const button = byId("drawer-button"), side = byId("side");
  const show = (open) => {
    side.classList.toggle("open", open);
    button.setAttribute("aria-expanded", String(open));
  };
  show(recall("drawer") !== "closed");
  button.addEventListener("click", () => {
    show(!side.classList.contains("open"));
    remember("drawer", side.classList.contains("open") ? "open" : "closed");
  });
}
