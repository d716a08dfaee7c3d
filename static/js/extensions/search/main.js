// Parts of the tab Tune: the search for better values, and the sensitivity of the score to one parameter.

import { el } from "../../core/dom.js";
import { edits } from "../../core/permissions.js";
import { exists, pressIn } from "../../shell/dynamic_actions.js";
import { extend } from "../../shell/extensions.js";
import { openParameter } from "../../tune/panel.js";
import { tuning } from "../../tune/parameters.js";
import { searchPart, startSearch } from "./search.js";
import { requestSensitivity, sensitivityButton, startSensitivity } from "./sensitivity.js";

// Title and id of the buttons; those that do not exist now are left out.
const BUTTONS = [
  ["Tune for me: search for the parameters with the best score", "search-open"], ["Tune for me: search again", "search-again"],
  ["Stop the search for parameters", "search-stop"], ["Use the parameters that were found", "search-use"], ["Save the parameters that were found as a set", "search-save"],
];

const tuneParts = () => [el("details", { class: "tune-part" }, el("summary", { text: "Search for better values" }), searchPart)];

const parameterButtons = (spec) => (spec.kind === "name" ? [] : [sensitivityButton(spec)]);

const presentActions = () => [
  ...BUTTONS.filter(([, id]) => exists(id)).map(([title, id]) => [title, "", edits(pressIn("tune", id))]),
  ...tuning.specs.filter(({ kind }) => kind !== "name").map((spec) =>
    [`Sensitivity of ${spec.title} (${spec.stage})`, "", edits(() => { openParameter(spec.name); requestSensitivity(spec); }), `${spec.name} how much does it matter ∿`]),
];

function start() {
  startSensitivity();
  startSearch();
}

extend(import.meta.url, { start, presentActions, tuneParts, parameterButtons });
