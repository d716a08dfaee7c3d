// Actions that depend on the open run, and buttons of the panels.

import { scoreAgainst } from "../annotate/annotations.js";
import { command, put } from "../core/api.js";
import { byId } from "../core/dom.js";
import { capital } from "../core/format.js";
import { select } from "../core/live_feed.js";
import { edits } from "../core/permissions.js";
import { attempted } from "../core/problem.js";
import { state, trees } from "../core/store.js";
import { openStory } from "../explain/story.js";
import { connectRobot, openSources } from "../open/dialog.js";
import { chooseView, toggleLayer } from "../scene/layers.js";
import { canEnd, endRun } from "../playback/timeline.js";
import { openParameter } from "../tune/panel.js";
import { attempt, isChanged, savedSets, shown, specOf, tuning, use } from "../tune/parameters.js";
import { openDrawer, toTab } from "./actions.js";
import { ofExtensions } from "./extensions.js";
import { canRecord, isRecording, pressRecording } from "./status.js";
import { NAMES as TABS } from "./tabs.js";

const AGAINST = [["both", "ground truth and annotations"], ["own", "ground truth only"], ["annotations", "annotations only"]];
// Words that people of other programs use for a parameter.
const ALSO = {
  "clustering.eps": "neighbourhood tolerance cluster distance epsilon", "clustering.min_points": "cluster size density minpts", "filters.voxel_size": "resolution downsample thin leaf grid",
  "slam.particles": "accuracy hypotheses", "acquisition.range_max": "far reach distance",
};
const CHOICES = { colour_by: "Colour the scene by", label_by: "Label the scene with", accumulated: "Accumulated map of the" };

// Whether a button exists and is not hidden, apart from its panel being closed.
export function exists(id) {
  for (let at = byId(id); at; at = at.parentElement) {
    if (at.matches("[role=tabpanel], dialog, body")) return true;
    if (at.hidden) return false;
  }
  return false;
}

// Opens the panel and presses its button; a disabled button is only shown.
export const pressIn = (tab, id) => () => {
  toTab(tab)();
  requestAnimationFrame(() => {
    const node = byId(id);
    node?.scrollIntoView({ block: "center" });
    if (node && !node.disabled) node.click();
  });
};

// Buttons of the panels: title, tab, id. Those that do not exist now are left out.
const BUTTONS = [
  ["Delete the saved set of parameters", "tune", "tune-delete"],
];

const panels = () => [
  ...BUTTONS.filter(([, , id]) => exists(id)).map(([title, tab, id]) => [title, "", edits(pressIn(tab, id))]),
  [`Re-map the whole run after a change: switch ${state.parameters?.whole ?? true ? "off" : "on"}`, "", edits(() => { toTab("tune")(); attempt(() => put("/api/parameters/reach", { whole: !(state.parameters?.whole ?? true) })); })],
  ["Download the annotations as CSV", "", () => location.assign("/api/annotations.csv")], ["Download the annotations as GeoJSON", "", () => location.assign("/api/annotations.geojson")],
  ["Annotate: your name", "", edits(() => { toTab("annotate")(); byId(byId("annotate-ask").hidden ? "annotate-name" : "annotate-asked").focus(); })],
  ...(state.annotations?.own == null ? [] : AGAINST.map(([value, words]) => [`Score against ${words}`, "", edits(() => { toTab("scores")(); scoreAgainst(value); })])),
  ["Upload a recording", "", edits(async () => { await openSources(); byId("upload-choose").focus(); })],
  ["Connect a robot or a sensor", "", edits(connectRobot)],
  ...(isRecording() ? [["End the recording; the run goes on", "", () => { byId("recording").focus(); pressRecording(); }, "stop finish live"]] : []),
  ...(canRecord() ? [["Record the robot from now on", "", pressRecording, "live save file mcap"]] : []),
  ...(canEnd() ? [["End the live run; its map stays", "", edits(() => { byId("end-run").focus(); endRun(); }), "stop finish mapping robot"]] : []),
  ["Topics and mounting of a recording or robot", "", edits(async () => { await openSources(); byId("source-uri").value ||= state.status?.source ?? ""; byId("source-inside").open = true; })],
  ...(byId("warnings-button").hidden ? [] : [["Show the warnings", "", () => byId("warnings-button").click()]]),
];

const charts = () => [...byId("chart-choice").options].map(({ value, text }) => [`Chart: ${text}`, "", () => {
  toTab("charts")();
  byId("chart-choice").value = value;
  byId("chart-choice").dispatchEvent(new Event("change"));
}, "charts plots graphs curves"]);

const views = () => Object.entries(CHOICES).flatMap(([name, words]) => (state.view?.[name]?.of ?? []).map((value) => [`${words} ${value}`, "", edits(() => chooseView(name, value))]));

// [[title, keys, action, keywords], ...]
export function presentActions() {
  const layers = (state.view?.layers ?? []).map(({ title, on: seen }, place) =>
    [`Layer ${title}: ${seen ? "hide" : "show"}`, place < 10 ? String((place + 1) % 10) : "", edits(() => toggleLayer(place))]);
  const tabs = TABS.map((name) => [`Tab ${capital(name)}`, "", toTab(name)]);
  const sets = [...tuning.presets.map(({ name }) => [`Use the preset ${name}`, "", edits(() => use(name))]), ...savedSets().map(({ name }) => [`Use the saved set ${name}`, "", edits(() => use(name))])];
  const speeds = [...byId("speed").options].map(({ value, text }) => [`Speed ${text}`, "", edits(() => attempted(() => command("set_speed", { factor: Number(value) })))]);
  const parameters = tuning.specs.map(({ name, stage, title, doc }) =>
    [`${stage}: ${title} (${shown(state.parameters?.values[name], specOf(name))}${isChanged(name) ? ", changed" : ""})`, "", () => openParameter(name), `setting ${name} ${doc} ${ALSO[name] ?? ""}`]);
  const found = trees().map(({ number }) => [`Tree ${number}`, "", () => { openDrawer(); openStory("tree"); select(number); }]);
  return [...tabs, ...panels(), ...charts(), ...layers, ...views(), ...sets, ...speeds, ...parameters, ...found, ...ofExtensions("presentActions")];
}
