// Dark, light and sunlight theme, and the colours of the theme for canvases. Sunlight is a light theme with more contrast.

import { byId, remember } from "./dom.js";
import { changed } from "./store.js";

let cached = {};

export const isDark = () => document.documentElement.dataset.theme !== "light";
export const themeName = () => (document.documentElement.dataset.contrast ? "sunlight" : document.documentElement.dataset.theme);

// The value of a CSS variable of the theme.
export function colour(name) {
  return (cached[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
}

// The same by property: colours.tree, colours["set-a"].
export const colours = new Proxy({}, { get: (_, name) => colour(name) });

export function setTheme(name) {
  const root = document.documentElement.dataset;
  root.theme = name === "dark" ? "dark" : "light";
  if (name === "sunlight") root.contrast = "high";
  else delete root.contrast;
  cached = {};
  remember("theme", name);
  changed("theme");
}

export function startTheme() {
  byId("theme-button").addEventListener("click", () => setTheme(isDark() ? "light" : "dark"));
}
