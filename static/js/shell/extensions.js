// Parts of the extensions that are switched on. The page names the module of each in front of main.js; such a module
// calls extend() with
//   start()           called once, when the parts of the dashboard have started and before the server sends states
//   presentActions()  actions for the search, [[title, keys, action, keywords], ...], which may depend on the run
//   annotateSections()  elements at the end of the tab Annotate
//   tuneParts()       elements at the end of the tab Tune
//   parameterButtons(spec)  buttons in the row of a parameter in the tab Tune
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

// What the extensions give by a function, in one list; one that fails is reported and gives nothing.
export const ofExtensions = (name, ...args) => [...extensions.values()].flatMap((each) => {
  try {
    return each[name]?.(...args) ?? [];
  } catch (error) {
    showProblem(error);
    return [];
  }
});
