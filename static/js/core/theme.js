// Dark and light theme, and the colours of the theme for canvases.

import { byId, remember } from "./dom.js";
import { changed } from "./store.js";

let cached = {};

export const isDark = () => document.documentElement.dataset.theme !== "light";

// The value of a CSS variable of the theme.
export function colour(name) {
  return (cached[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
}

// The same by property: colours.tree, colours["set-a"].
export const colours = new Proxy({}, { get: (_, name) => colour(name) });

export function startTheme() {
  byId("theme-button").addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    cached = {};
    remember("theme", theme);
    changed("theme");
  });
}
