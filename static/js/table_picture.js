// A table of the page as a picture.

import { colour } from "./theme.js";

const ROW = 24, PAD = 12, SCALE = 2;
const MOST_ROWS = 600, TALLEST = 16_000; // [px]; of a taller canvas some browsers make no picture at all

// A canvas with the heads and the rows of a table as they stand, in the colours of the page.
export function pictureOf(table) {
  const lines = [...table.rows].slice(0, MOST_ROWS).map((row) => [...row.cells].map((cell) => cell.textContent));
  const more = table.rows.length - lines.length;
  if (more) lines.push(lines[0].map((_, k) => (k ? "" : `+ ${more} in the CSV`)));
  const scale = Math.min(SCALE, TALLEST / (ROW * lines.length));
  const canvas = document.createElement("canvas");
  const pen = canvas.getContext("2d");
  const font = `13px ${colour("font")}`;
  pen.font = font;
  const widths = lines[0].map((_, k) => Math.ceil(Math.max(...lines.map((cells) => pen.measureText(cells[k]).width))) + 2 * PAD);
  const width = widths.reduce((sum, each) => sum + each, 0);
  Object.assign(canvas, { width: Math.floor(scale * width), height: Math.floor(scale * ROW * lines.length) });
  pen.scale(scale, scale);
  pen.fillStyle = colour("surface");
  pen.fillRect(0, 0, width, ROW * lines.length);
  Object.assign(pen, { font, textAlign: "right", textBaseline: "middle" });
  lines.forEach((cells, row) => {
    pen.fillStyle = colour(row ? "text" : "dim");
    let right = 0;
    cells.forEach((text, k) => pen.fillText(text, (right += widths[k]) - PAD, ROW * (row + 0.5)));
    pen.fillStyle = colour("line");
    pen.fillRect(0, ROW * (row + 1) - 1, width, row ? 0.5 : 1);
  });
  return canvas;
}
