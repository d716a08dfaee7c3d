// Overlays of the scene (stages, comparison, camera): one at a time, closed by Esc or their button.

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

// Returns whether an overlay was open.
export function closeOver() {
  if (!current) return false;
  const button = byId(`${current}-button`);
  openOver(current);
  button.focus();
  return true;
}

export function startOverlay() {
  for (const name of NAMES) {
    byId(`${name}-button`).addEventListener("click", () => openOver(name));
    byId(`over-${name}`).querySelector("[data-close]").addEventListener("click", closeOver);
  }
}
