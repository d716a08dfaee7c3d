// Parts of the extensions that are switched on. The dashboard names the module main.js of each in front of its own, the page of
// runs runs.js; such a module calls extend() with
//   start()           called once, when the parts of the page have started and before the server sends states
//   tabs()            tabs below the map, [{name, title, before}, ...], with the name of the tab behind it; start() fills the panel
//                     with the id panel-NAME
//   presentActions()  actions for the search, [[title, keys, action, keywords], ...], which may depend on the run
//   annotateSections()  elements at the end of the tab Annotate
//   tuneParts()       elements at the end of the tab Tune
//   parameterButtons(spec)  buttons in the row of a parameter in the tab Tune
//   pressed(event)    whether it took a key that was pressed; not called in a view-only page
//   drawOnMap(pen, view)  draws on the 2D map, below the annotations
//   mapTools()        tools for the pointer on the 2D map, [{busy, press, drag, release, hover, click}, ...]; the functions take what
//                     those of `gestures` of MapCanvas take, then the view, and return whether they took the event; busy() is true
//                     while the tool is in use
//   exportFiles()     files for the menu Export, [{value, text, before, edits, save}, ...], with the value of the option behind it and
//                     whether only owners have it; save(title) saves the file of a run with this title, also in place of an option with the same value
//   sourceChoice()    what is chosen in the dialog Open, {node, takes(path), moves(), address(path), fields(), forget()}: the element,
//                     for which paths it is shown, whether the source has a motion, the address of the path and fields of the
//                     request by the choices, and back to the beginning
//   runButtons(run, title)  buttons of a run on the page of runs
//   pairViews()       what shows two runs on that page: functions of their keys
//   treeStory(story), clusterStory(story)  elements in place of the story of a tree or cluster; none for other stories
//   treeEvidence(story)  an element in place of the accumulated points in the card of a tree; none for other stories
// All are optional.

import { attempted, showProblem } from "../core/problem.js";

const extensions = new Map(); // by the address of their module

// Adds the parts of an extension; `address` is the import.meta.url of its module.
export const extend = (address, parts) => extensions.set(address, parts);

export function startExtensions() {
  for (const { src, dataset } of document.querySelectorAll("script[data-extension]"))
    if (!extensions.has(src)) showProblem(`The extension ${dataset.extension} of the page is left out: its module failed.`);
  for (const { start } of extensions.values()) attempted(async () => start?.());
}

// What the extensions give by a function, in one list, undefined as nothing; one that fails is reported and gives nothing.
export const ofExtensions = (name, ...args) => [...extensions.values()].flatMap((each) => {
  try {
    return each[name]?.(...args) ?? [];
  } catch (error) {
    showProblem(error);
    return [];
  }
});
