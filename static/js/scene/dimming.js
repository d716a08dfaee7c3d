// The trees that the filter of the table leaves out are grey in the scene of this browser, as on its map.

import { on, state, trees } from "../core/store.js";
import { isDark } from "../core/theme.js";
import { onSceneBuilt } from "./scene.js";
import { beforePicture, colourInstances, requestRender } from "./viser_client.js";

const SAME = 0.02; // [m]; places in the scene are rounded to a centimetre
const GREY = { dark: 0.05, light: 0.6 }; // near the ground of each theme

// Each tree as the server has sent it, or grey if the filter leaves it out. The instances have the order of the trees of the map;
// where the page has a newer map, a tree at another place keeps its colour.
function paint(inner) {
  const known = trees(), grey = new Array(3).fill(isDark() ? GREY.dark : GREY.light);
  return colourInstances(inner, "/world/trees", (k, x, y) => {
    const tree = known[k], isHere = tree && Math.abs(tree.x - x) < SAME && Math.abs(tree.y - y) < SAME;
    return isHere && state.holds && !state.holds(tree) ? grey : null;
  });
}

export function startDimming() {
  let scene = null, isPainted = false;
  on("filter", () => requestRender(scene));
  onSceneBuilt((inner) => {
    [scene, isPainted] = [inner, false];
    // In each picture with a filter, because viser paints the trees when their colours or their number change.
    beforePicture(inner, "dims", () => {
      if ((state.holds || isPainted) && paint(inner)) isPainted = state.holds !== null;
    });
  });
}
