// The report of a run.

import { el } from "../../core/dom.js";
import { fileName } from "../../core/download.js";
import { saveWritten } from "../../core/written_file.js";

const REPORTS = { "en.html": "Report (HTML)", "en.pdf": "Report (PDF)", "de.html": "Report in German (HTML)", "de.pdf": "Report in German (PDF)" };

// The reports as [[choice, text], ...].
export const reports = () => Object.entries(REPORTS);

// `key` names a run as in /api/runs, or is "open"; `title` is that of the run; `settings` are the parameters of the figures as
// URLSearchParams.
export async function saveReport(key, title, choice, settings = new URLSearchParams()) {
  const [language, suffix] = choice.split(".");
  settings.set("language", language);
  await saveWritten("Writing the report …", fileName(title, `report_${language}.${suffix}`), `/api/runs/${encodeURIComponent(key)}/report/${suffix}?${settings}`);
}

// A menu with the reports of a run; `title()` returns the title of the run, `settings()` the parameters of the figures.
export function reportMenu(id, key, title, settings) {
  const menu = el("select", { id, class: "small", "aria-label": "Report of the run", title: "Stand figures, map, plots and list of trees on a page for the file", onchange: async () => {
    const choice = menu.value;
    menu.value = "";
    menu.disabled = true;
    await saveReport(key, title(), choice, await settings?.());
    menu.disabled = false;
  } }, el("option", { value: "", text: "Report", selected: true }), ...reports().map(([value, text]) => el("option", { value, text })));
  return menu;
}
