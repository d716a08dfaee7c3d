// Dark for the field, light for the paper.

import { byId, remember } from "./dom.js";
import { changed } from "./store.js";

export const isDark = () => document.documentElement.dataset.theme !== "light";

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export function startTheme() {
  byId("theme-button").addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    remember("theme", theme);
    changed("theme");
  });
}
