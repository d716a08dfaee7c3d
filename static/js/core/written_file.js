// Files that the server writes, as downloads.

import { block } from "./api.js";
import { el } from "./dom.js";
import { saveBytes } from "./download.js";
import { attempted, showNews, showProblem } from "./problem.js";
import { state } from "./store.js";

// Saves a file that the server writes, which takes some time; a failure is shown.
export async function saveWritten(text, name, path) {
  const box = el("div", { class: "toast", role: "status" }, el("span", { text }), el("progress", { "aria-label": text }));
  document.body.append(box);
  const isOld = (state.status?.remapped ?? null) !== null;
  await attempted(async () => {
    saveBytes(name, await block(path));
    if (isOld) showProblem(`Saved ${name}: the map before the change of parameters. The run is being re-mapped; save it again afterwards for the new map.`);
    else showNews(`Saved ${name}.`);
  });
  box.remove();
}
