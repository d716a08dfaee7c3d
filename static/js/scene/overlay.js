// What lies over the scene when it is asked for: one at a time, closed by Esc or its button.

import { byId } from "../core/dom.js";
import { changed } from "../core/store.js";

const NAMES = ["stages", "compare", "camera"];
let current = null;

export const shownOver = (name) => current === name;

export function openOver(name) {
  current = current === name ? null : name;
  for (const each of NAMES) {
    byId(`over-${each}`).hidden = each !== current;
    byId(`${each}-button`).setAttribute("aria-pressed", String(each === current));
  }
  byId("scene").closest(".scene").classList.toggle("covered", current !== null);
  if (current && matchMedia("(max-width: 700px)").matches) byId(`over-${current}`).scrollIntoView();
  changed("over");
}

// Returns whether there was anything to close.
export function closeOver() {
  if (!current) return false;
  const button = byId(`${current}-button`);
  openOver(current);
  button.focus();
  return true;
}

// Calls `work` now and after each change, one call at a time, and not more often than `pause` [ms].
export function keepFresh(work, pause) {
  let busy = false, wanted = false;
  return async function fresh() {
    wanted = true;
    if (busy) return;
    busy = true;
    while (wanted) {
      wanted = false;
      await work();
      await new Promise((resolve) => setTimeout(resolve, pause));
    }
    busy = false;
  };
}

export function startOverlay() {
  for (const name of NAMES) {
    byId(`${name}-button`).addEventListener("click", () => openOver(name));
    byId(`over-${name}`).querySelector("[data-close]").addEventListener("click", closeOver);
  }
}
