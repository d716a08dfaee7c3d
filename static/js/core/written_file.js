// Files that the server writes, as downloads.

import { block } from "./api.js";
import { el } from "./dom.js";
import { saveBytes } from "./download.js";
import { attempted, showNews } from "./problem.js";

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
