// Saves pictures and tables of the page as files.

import { el } from "./dom.js";

function save(name, blob) {
  const address = URL.createObjectURL(blob);
  const link = el("a", { href: address, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

// The name of a file of a run: "pine_plot_trees.csv" for the title "pine_plot.laz" of the run.
export function fileName(title, rest) {
  const stem = title.replace(/\.[a-z][a-z0-9]{1,5}$/i, "").replace(/[^\p{L}\p{N}.-]+/gu, "_").replace(/^[_.]+|[_.]+$/g, "").slice(0, 80);
  return stem ? `${stem}_${rest}` : rest;
}

const cell = (value) => {
  const text = value === null || value === undefined ? "" : String(value);
  return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};

const csvText = (rows) => rows.map((row) => `${row.map(cell).join(",")}\n`).join("");

export const saveBytes = (name, bytes) => save(name, new Blob([bytes]));

export const saveCsv = (name, rows) => save(name, new Blob([csvText(rows)], { type: "text/csv" }));

export const saveCanvas = (name, canvas) => canvas.toBlob((blob) => blob && save(name, blob), "image/png");
