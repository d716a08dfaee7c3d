// The names in the heading of the report, which are stored with the recording.

import { edit, send } from "../../annotate/annotations.js";
import { el } from "../../core/dom.js";
import { state } from "../../core/store.js";

const NAMES = { stand: "Name of the stand", client: "Who ordered the report", author: "Who made the report" };
const unsaved = new Map(); // the last edit of each field, while it is on its way or after it was refused
let saving = null; // the last edit

const fields = Object.entries(NAMES).map(([name, title]) => el("input", { type: "text", name, title, maxlength: "100", autocomplete: "off", onchange: ({ target }) => save(target) }));

async function save(field) {
  const names = { [field.name]: field.value.trim() };
  const own = edit(() => send("PUT", "/api/heading", { names }));
  saving = own;
  unsaved.set(field, own);
  const done = await own;
  if (unsaved.get(field) !== own) return; // changed again, or of another run
  field.setAttribute("aria-invalid", String(!done));
  if (!done) return;
  unsaved.delete(field);
  fillHeading();
}

export const headingFields = () => el("div", { id: "report-heading", class: "plot-form", "data-edits": true }, el("span", { text: "Heading of the report:" }), ...fields.map((field) => el("label", {}, field.name, field)));

// A report that is asked for has the names that were typed before.
export const headingSaved = () => saving;

export function fillHeading() {
  const stored = state.annotations?.others.heading?.at(-1) ?? {};
  for (const field of fields) {
    const value = stored[field.name] ?? "", typing = field === document.activeElement && field.value !== field.defaultValue;
    field.defaultValue = value;
    if (!typing && !unsaved.has(field)) field.value = value;
  }
}

// Another run begins without the names that were typed for the one before.
export function resetHeading() {
  unsaved.clear();
  for (const field of fields) {
    field.value = field.defaultValue;
    field.setAttribute("aria-invalid", "false");
  }
}
