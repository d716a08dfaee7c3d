// The tab Plots, its part of the 2D map, and files with plots: sample plots, stand figures, coordinates and the report.

import { byId, el } from "../../core/dom.js";
import { fileName } from "../../core/download.js";
import { edits } from "../../core/permissions.js";
import { on } from "../../core/store.js";
import { saveWritten } from "../../core/written_file.js";
import { toTab } from "../../shell/actions.js";
import { extend } from "../../shell/extensions.js";
import { drawDetour, startDetour, toggleDetour } from "./detour.js";
import { addedTrees, drawPlots } from "./draw.js";
import { plotKey, settings, startPlotsPanel } from "./panel.js";
import { clickOn, dragTo, draw, drawing, hoverTo, plots, pressAt, release, SHAPES } from "./plots.js";
import { reports, saveReport } from "./report.js";

// Value, text, file and the value of the option in front of which it is put.
const FILES = [["gpkg", "GeoPackage (QGIS)", "trees.gpkg"], ["shp", "Shapefile (zip)", "trees_shp.zip", "geojson"], ["dxf", "DXF", "trees.dxf", "laz"],
  ["xlsx", "XLSX", "trees.xlsx", "laz"], ["tif", "Terrain as GeoTIFF", "terrain.tif", "laz"]];

const exportFiles = () => [
  ...FILES.map(([value, text, file, before]) => ({ value, text, before, save: (title) => saveWritten("Writing the file …", fileName(title, file), `/api/export/${value}?${settings()}`) })),
  ...reports().map(([value, text]) => ({ value, text, save: (title) => saveReport("open", title, value, settings()) })),
];

const inPlots = (run) => edits(() => { toTab("plots")(); run(); });

const presentActions = () => [
  ["Report of the run as HTML or PDF: figures, map, plots, trees", "", () => { toTab("plots")(); byId("plots-report").focus(); }, "print page bericht stand inventory"],
  ["Export the map with plots: Shapefile, DXF, XLSX …", "", () => { toTab("trees")(); byId("trees-export").focus(); }, "save download gis cad excel terrain geotiff"],
  ...Object.keys(SHAPES).map((kind) => [`Plots: draw a ${kind} on the map`, "", inPlots(() => draw(kind)), "stand inventory sample area hectare basal"]),
  ["Coverage: the way that shows trees without DBH from the missing side", "", toggleDetour, "detour dbh diameter route unseen"],
  ["Plots: import a file", "", inPlots(() => byId("plot-import").click()), "geopackage shapefile geojson gis"],
];

function start() {
  const legend = el("li", { id: "legend-plot", class: "plot", hidden: true, text: "plot" });
  const added = el("li", { id: "legend-added", class: "added", hidden: true, text: "added tree", title: "A tree that a person added because the map lacks it; hollow: DBH not measured" });
  document.querySelector(".legend .robot").before(legend, added);
  on("annotations map tab", () => {
    legend.hidden = !plots().length;
    added.hidden = !addedTrees().length;
  });
  byId("trees-export").title = "The map as a file for GIS, CAD and spreadsheets, in the coordinates that the tab Plots shows";
  startPlotsPanel();
  startDetour();
}

extend(import.meta.url, {
  start,
  presentActions,
  exportFiles,
  tabs: () => [{ name: "plots", title: "Plots", before: "charts" }],
  pressed: plotKey,
  drawOnMap: (pen, view) => {
    drawPlots(pen, view);
    drawDetour(pen, view);
  },
  mapTools: () => [{ busy: drawing, press: pressAt, drag: dragTo, release, hover: hoverTo, click: clickOn }],
});
