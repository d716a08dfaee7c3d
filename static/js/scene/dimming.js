// The trees that the filter of the table leaves out are grey in the scene of this browser, as on its map.

import { on, state, trees } from "../core/store.js";
import { isDark } from "../core/theme.js";
import { onSceneBuilt } from "./scene.js";

const NODE = "/world/trees", SAME = 0.02; // [m]; places in the scene are rounded to a centimetre
const GREY = { dark: 0.05, light: 0.6 }; // near the ground of each theme
let requestRender = () => {};

const arrayOf = (Type, { buffer, byteOffset, byteLength }) => new Type(buffer.slice(byteOffset, byteOffset + byteLength));

function meshOf(node) {
  let found = null;
  node?.traverse((each) => { if (each.setColorAt) found ??= each; });
  return found;
}

// Colours each tree as the server has sent it, or grey if the filter leaves it out. The instances have the order of the trees of the
// map; where the page has a newer map, a tree at another place keeps its colour.
function paint(mesh, props) {
  const at = arrayOf(Float32Array, props.batched_positions), sent = arrayOf(Uint8Array, props.batched_colors), known = trees();
  const colour = mesh.material.color.clone(), grey = isDark() ? GREY.dark : GREY.light;
  for (let k = 0; k < Math.min(at.length / 3, mesh.instancesCount); k += 1) {
    const tree = known[k], rgb = sent.length > 3 ? 3 * k : 0;
    const isHere = tree && Math.abs(tree.x - at[3 * k]) < SAME && Math.abs(tree.y - at[3 * k + 1]) < SAME;
    if (isHere && state.holds && !state.holds(tree)) colour.setRGB(grey, grey, grey);
    else colour.setRGB(sent[rgb] / 255, sent[rgb + 1] / 255, sent[rgb + 2] / 255);
    mesh.setColorAt(k, colour);
  }
}

export function startDimming() {
  on("filter", () => requestRender());
  onSceneBuilt((frame) => {
    const viser = frame.__viserMutable, { scene, nodeRefFromName } = viser, then = scene.onBeforeRender;
    if (scene.userData.dims) return; // the window of a frame is the same object after a reload
    scene.userData.dims = true;
    requestRender = () => viser.requestRender?.();
    let isPainted = false;
    // In each picture with a filter, because viser paints the trees when their colours or their number change.
    scene.onBeforeRender = (...args) => {
      then?.apply(scene, args);
      if (!state.holds && !isPainted) return;
      const props = frame.__viserSceneTree?.getState()[NODE]?.message.props, mesh = meshOf(nodeRefFromName[NODE]);
      if (!props || !mesh) return;
      paint(mesh, props);
      isPainted = state.holds !== null;
    };
  });
}
