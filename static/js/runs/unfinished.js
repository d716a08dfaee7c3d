// What killed runs left in the data folder: told, and taken away on request.

import { request } from "../api.js";
import { el } from "../dom.js";
import { when } from "./words.js";

const size = (bytes) => (bytes < 1e6 ? `${Math.ceil(bytes / 1000)} kB` : `${Math.round(bytes / 1e6)} MB`);
const folderOf = (name) => name.split("/").slice(0, -1).join("/") || "the data folder";

// Rows for the list; `done` is called with an error's words, or with nothing when one was deleted.
export function unfinishedRows(left, columns, done) {
  const remove = async (name) => {
    try {
      await request(`/api/runs/unfinished?name=${encodeURIComponent(name)}`, { method: "DELETE" });
      done("");
    } catch (error) {
      done(error.message);
    }
  };
  return left.map(({ name, size: bytes, changed_s: changed, quiet }) => el("tr", { class: "unfinished", "data-unfinished": name },
    el("td"), el("td", { colspan: columns - 2 }, el("b", { text: `Half a map in ${folderOf(name)}` }),
      el("small", { text: `${size(bytes)}, last written ${when(changed)}. The run was ended before its map was whole: map its recording again.` })),
    el("td", {}, el("button", { class: "small", "data-edit": true, text: "Delete", "aria-label": `Delete ${name}`, disabled: !quiet,
      title: quiet ? "Take the half map away; nothing else is touched" : "It was written to within the last ten minutes, so its run may go on", onclick: () => remove(name) }))));
}
