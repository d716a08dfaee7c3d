// The way that shows trees without a diameter from the sides that were never seen, on the 2D map.

import { get } from "../../core/api.js";
import { button, byId } from "../../core/dom.js";
import { count } from "../../core/format.js";
import { attempted, showNews } from "../../core/problem.js";
import { changed, isDrive, on, state } from "../../core/store.js";
import { colours } from "../../core/theme.js";
import { drawText } from "../../map/draw.js";

let way = null; // {points, trees, length_m}

function show(found) {
  way = found;
  byId("map-coverage").setAttribute("aria-pressed", String(way !== null));
  changed("ghost"); // paints the 2D map again
}

export async function toggleDetour() {
  if (way) return show(null);
  if (byId("map-coverage").disabled) return;
  const lacking = (state.map?.trees ?? []).filter(({ dbh_cm: dbh }) => dbh === null).length;
  if (!lacking) return showNews("Every tree of the map has a diameter");
  const pressed = byId("map-coverage");
  pressed.disabled = true;
  const { source, remapped } = state;
  const found = await attempted(() => get("/api/detour"));
  pressed.disabled = false;
  if (!found || source !== state.source || remapped !== state.remapped) return; // it is of another map
  if (!found.points) return showNews("No way through the observed area shows a tree without DBH from a missing side");
  show(found);
  showNews(`${textOf(found)} of ${lacking} without DBH`);
}

const textOf = ({ length_m: length, trees }) => `${Math.round(length)} m: ${count(trees.length, "tree")}`;

export function drawDetour(pen, view) {
  if (!way) return;
  Object.assign(pen, { strokeStyle: colours.selection, lineWidth: 3 });
  pen.setLineDash([2, 7]);
  pen.lineCap = "round";
  pen.beginPath();
  for (const [x, y] of way.points) pen.lineTo(...view.toScreen(x, y));
  pen.stroke();
  pen.setLineDash([]);
  const [px, py] = view.toScreen(...way.points.at(-1));
  drawText(pen, textOf(way), px + 8, py - 8, { font: "600 12px", align: "left" });
}

export function startDetour() {
  byId("map-png").before(button("map-coverage", "Coverage", "Show the way that shows trees without DBH from the sides that were never seen", toggleDetour));
  byId("map-coverage").setAttribute("aria-pressed", "false");
  on("source remapped", () => show(null)); // of another map
  on("phase map", () => { byId("map-coverage").hidden = !isDrive(); });
}
