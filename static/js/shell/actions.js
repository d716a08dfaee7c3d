// All actions of the dashboard in one table; the keys, the list of shortcuts and the palette are made from it.

import { annotating, previous, rejectedKind, review, reviewHistory, skip, toggleAdding } from "../annotate/annotations.js";
import { typeDbh } from "../annotate/card.js";
import { byId } from "../core/dom.js";
import { select } from "../core/live_feed.js";
import { edits } from "../core/permissions.js";
import { stopMeasuring, toggleMeasure } from "../map/measure.js";
import { openSources } from "../open/dialog.js";
import { setLoop } from "../playback/event_marks.js";
import { advance, togglePlay } from "../playback/timeline.js";
import { toggleFocus } from "../scene/focus.js";
import { toggleFollow } from "../scene/layers.js";
import { useTool } from "../repair/repairs.js";
import { closeOver, openOver } from "../scene/overlay.js";
import { pressInScene } from "../scene/scene.js";
import { openSearch } from "../tune/panel.js";
import { redo, reset, undo } from "../tune/parameters.js";
import { exchange, showTabs, toggleMap, toggleScene, toggleTabs, useLayout } from "./layout.js";
import { showShareAtEnd } from "./share.js";
import { openTab } from "./tabs.js";

const click = (id) => () => byId(id).click();
export const openDrawer = () => { byId("side").classList.add("open"); showTabs(); };
export const toTab = (name) => () => { openDrawer(); openTab(name); byId(`tab-${name}`).focus(); };
const inAnnotate = (run) => edits(() => { if (!annotating()) toTab("annotate")(); run(); });

export function showSheet() {
  byId("keys-dialog").showModal();
}

function findTree() {
  openDrawer();
  openTab("trees");
  byId("find").focus();
}

function leave() {
  if (closeOver()) return;
  stopMeasuring();
  select(null);
}

const pressOnMap = (key) => () => byId("map").dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));

// title, keys as shown, key of the event ("" if it has none of its own), action, title in the list of shortcuts ("": not listed
// there), other words by which it is searched
export const ACTIONS = [
  ["Play or pause", "space", " ", edits(togglePlay)],
  ["One scan back", "←", "", edits(() => advance(-1))], ["One scan forward", "→", "", edits(() => advance(1))],
  ["Ten scans back", "shift ←", "", edits(() => advance(-10))], ["Ten scans forward", "shift →", "", edits(() => advance(10))],
  ["Loop: set its start, then its end, then remove it", "l", "l", edits(setLoop)],
  ["Follow the robot in the scene, or stop following", "f", "", edits(toggleFollow)],
  ["Focus: move the camera to the selected tree or cluster, or stop", "", "", toggleFocus],
  ["View the robot from above", "t", "", edits(() => pressInScene("t"))], ["View the robot from behind", "b", "", edits(() => pressInScene("b"))],
  ["Views: save this view of the scene, or return to a saved one", "", "", click("views-button"), null, "camera bookmark viewpoint position"],
  ["View the whole map in the scene", "", "", click("look-fit"), null, "fit zoom all camera"], ["Return to the first view of the scene", "", "", click("look-home"), null, "home reset camera"],
  ["Measure a distance on the map", "m", "m", toggleMeasure],
  ["Show the whole map", "", "", click("map-fit"), null, "fit zoom reset"],
  ["Zoom in on the map", "+", "", pressOnMap("+"), null, "enlarge magnify closer"], ["Zoom out of the map", "-", "", pressOnMap("-"), null, "shrink farther"],
  ["Stages: raw, filtered, clusters and trunks side by side", "s", "s", () => openOver("stages")],
  ["Compare two sets of parameters on this scan (A | B)", "c", "c", () => openOver("compare")],
  ["Camera: trees and clusters in the picture of this scan", "v", "v", () => openOver("camera")],
  ["Find a tree", "/", "/", findTree],
  ["Find a parameter", "p", "p", () => { openDrawer(); openSearch(); }],
  ["Undo a parameter change", "ctrl+z", "", edits(undo), "in the tab Tune and in the scene: undo a parameter change"],
  ["Redo a parameter change", "ctrl+shift+z", "", edits(redo), "in the tab Tune and in the scene: redo a parameter change"],
  ["Reset all parameters to the preset", "", "", edits(() => reset([]))],
  ["Save the parameters as a set", "", "", edits(() => { toTab("tune")(); byId("tune-save").click(); })],
  ["Download the parameters as a file", "", "", click("tune-download")],
  ["Upload parameters from a file", "", "", edits(() => { toTab("tune")(); byId("tune-upload").click(); })],
  ["Layers of the scene", "", "", edits(click("layers-button"))],
  ["Light or dark theme", "", "", click("theme-button"), null, "colours night day sunlight appearance settings"],
  ["Open another run", "", "", edits(openSources), null, "load file recording upload source robot live"],
  ["All runs: show, compare, replay or delete them", "", "", click("runs-link"), null, "history remove rename"],
  ["Share: link to this moment, view-only link", "", "", click("share-button")],
  ["Share: end the view-only link (revoke access)", "", "", edits(showShareAtEnd), null, "remove stop withdraw invalidate viewers"],
  ["Save the map as a picture (PNG)", "", "", click("map-png"), null, "screenshot image export"], ["Save the map as a table (CSV)", "", "", click("map-csv")],
  ["Save the table of trees as a picture (PNG)", "", "", () => { toTab("trees")(); byId("trees-png").click(); }],
  ["Download the trees as CSV", "", "", () => byId("trees-csv").click(), null, "export table spreadsheet"],
  ["Export the map: GeoPackage, GeoJSON …", "", "", () => { toTab("trees")(); byId("trees-export").focus(); }, null, "save download gis qgis geojson"],
  ["Download the path as CSV", "", "", () => location.assign("/api/path.csv")],
  ["Annotate: add trees by clicks on the map", "a", "", inAnnotate(() => toggleAdding(true)), ""],
  ["Annotate: skip to the next tree to review", "s", "", inAnnotate(skip), ""],
  ["Annotate: the selected tree is a tree", "y", "", inAnnotate(() => review("tree")), ""],
  ["Annotate: the selected tree is not a tree", "n", "", inAnnotate(() => review(rejectedKind())), ""],
  ...["pole", "person", "bush", "other"].map((kind) => [`Annotate: the selected tree is of the class ${kind}`, `shift ${kind === "person" ? "h" : kind[0]}`, "", inAnnotate(() => review(kind)), ""]),
  ["Annotate: return to the tree of the answer before", "r", "", inAnnotate(previous), ""],
  ["Annotate: type the DBH by tape of the selected tree", "d", "", inAnnotate(typeDbh), ""],
  ["Annotate: delete the chosen annotation", "del", "", inAnnotate(() => document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "Delete", bubbles: true }))), "", "remove erase"],
  ["Annotate: undo your last annotation", "", "", inAnnotate(reviewHistory.undo)], ["Annotate: redo your last annotation", "", "", inAnnotate(reviewHistory.redo)],
  ["Annotate: import trees from CSV", "", "", inAnnotate(click("annotate-import"))],
  ...[["merge two trees", "merge"], ["split a tree", "split"], ["move a tree", "move"], ["the same place was seen twice: close a loop", "tie"], ["forbid a wrong loop", "forbid"]].map(([text, kind]) =>
    [`Repair: ${text}`, "", "", edits(() => { toTab("repair")(); useTool(kind); }), null, "mend correct fix edit map"]),
  ["Clear the selection; close the overlay of the scene", "esc", "Escape", leave],
  ["Layout: exchange map and scene", "x", "x", exchange, "exchange map and scene"],
  ["Layout: show or hide the 2D map", "", "", toggleMap], ["Layout: show or hide the 3D scene", "", "", toggleScene], ["Layout: show or hide the tabs and the table", "", "", toggleTabs],
  ...["Monitor", "Tune", "Annotate", "Results"].map((name) => [`Layout: ${name}`, `shift ${name[0]}`, name[0], () => useLayout(name), `the layout ${name}`, "standard sizes places arrange"]),
  ["Settings: theme, large controls, sound and vibration", "", "", showSheet, null, "options preferences gloves touch tablet contrast sunlight alarm warning mute"],
  ["Settings and keyboard shortcuts", "?", "?", showSheet, null, "help keys hotkeys manual"],
];
