// Labels that overlap in the view of this browser are hidden: that of the selection is shown first, then the nearest ones.

import { state } from "../core/store.js";
import { onSceneBuilt } from "./scene.js";
import { beforePicture, labelsIn } from "./viser_client.js";

const GAP = 2; // [px] between two labels
const ABOVE = 3; // [m] largest distance of a label from the place of its tree on the ground

const meet = (a, b) => a[0] < b[2] + GAP && b[0] < a[2] + GAP && a[1] < b[3] + GAP && b[1] < a[3] + GAP;

// Hides the labels that a more important one covers; returns the boxes of those that are seen. `marked` is the place of the
// selection.
function hideCovered(labels, marked) {
  const far = ({ place }) => (marked ? place.distanceTo(marked) : Infinity);
  const ofSelection = labels.filter((label) => far(label) < ABOVE).sort((a, b) => far(a) - far(b))[0];
  const seen = [];
  for (const label of labels.sort((a, b) => (b === ofSelection) - (a === ofSelection) || a.near - b.near)) {
    if (seen.some((box) => meet(box, label.box))) label.hide();
    else seen.push(label.box);
  }
  return seen;
}

export function startLabels() {
  onSceneBuilt((inner) => beforePicture(inner, "hidesLabels", ({ scene, camera, world }) => {
    if (!camera?.isPerspectiveCamera) return;
    const marked = state.place && camera.position.clone().set(...state.place).applyMatrix4(world.matrixWorld);
    scene.userData.labels = hideCovered(labelsIn(scene, camera), marked);
  }));
}
