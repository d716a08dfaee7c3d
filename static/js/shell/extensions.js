// Modules of the extensions that are switched on. Each may export
//   start()           called once, when the parts of the dashboard have started and before the server sends states
//   presentActions()  actions for the search, [[title, keys, action, keywords], ...], which may depend on the run
//   annotateSections()  elements at the end of the tab Annotate
//   tuneParts()       elements at the end of the tab Tune
//   parameterButtons(spec)  buttons in the row of a parameter in the tab Tune

import { get } from "../core/api.js";
import { el } from "../core/dom.js";
import { attempted, showProblem } from "../core/problem.js";

const extensions = [];

// Loads all modules; one that fails is reported and left out.
export async function loadExtensions() {
  try {
    const { modules, styles } = await get("/api/extensions");
    document.head.append(...styles.map((href) => el("link", { rel: "stylesheet", href })));
    const loaded = await Promise.allSettled(modules.map((address) => import(address)));
    for (const [place, { value, reason }] of loaded.entries()) {
      if (value) extensions.push(value);
      else showProblem(`${modules[place]} is left out: ${reason}`);
    }
  } catch (error) {
    showProblem(`The extensions of the page are left out: ${error.message}`);
  }
}

export function startExtensions() {
  for (const { start } of extensions) attempted(async () => start?.());
}

// What the modules give by a function, in one list; one that fails is reported and gives nothing.
export const ofExtensions = (name, ...args) => extensions.flatMap((each) => {
  try {
    return each[name]?.(...args) ?? [];
  } catch (error) {
    showProblem(error);
    return [];
  }
});
