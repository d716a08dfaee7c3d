// Files that the server writes, as downloads: the report of a run, and others.

import { block } from "./api.js";
import { el } from "./dom.js";
import { fileName, saveBytes } from "./download.js";
import { attempted, showNews } from "./problem.js";

const REPORTS = { "en.html": "Report (HTML)", "en.pdf": "Report (PDF)", "de.html": "Report in German (HTML)", "de.pdf": "Report in German (PDF)" };

export const reportOptions = () => Object.entries(REPORTS).map(([value, text]) => el("option", { value, text }));
export const isReport = (choice) => choice in REPORTS;

// `key` names a run as in /api/runs, or is "open"; `title` is that of the run; `settings` are the parameters of the figures as
// URLSearchParams.
export async function saveReport(key, title, choice, settings = new URLSearchParams()) {
  const [language, suffix] = choice.split(".");
  settings.set("language", language);
  await saveWritten("Writing the report …", fileName(title, `report_${language}.${suffix}`), `/api/runs/${encodeURIComponent(key)}/report/${suffix}?${settings}`);
}

// Saves a file that the server writes, which takes some time; a failure is shown.
export async function saveWritten(text, name, path) {
  const box = el("div", { class: "toast", role: "status" }, el("span", { text }), el("progress", { "aria-label": text }));
  document.body.append(box);
  await attempted(async () => {
    saveBytes(name, await block(path));
    showNews(`Saved ${name}.`);
  });
  box.remove();
}

// A menu with the reports of a run; `title()` returns the title of the run, `settings()` the parameters of the figures.
export function reportMenu(id, key, title, settings) {
  const menu = el("select", { id, class: "small", "aria-label": "Report of the run", title: "Stand figures, map, plots and list of trees on a page for the file", onchange: async () => {
    const choice = menu.value;
    menu.value = "";
    menu.disabled = true;
    await saveReport(key, title(), choice, settings?.());
    menu.disabled = false;
  } }, el("option", { value: "", text: "Report", selected: true }), ...reportOptions());
  return menu;
}
