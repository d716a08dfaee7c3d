// Labels that overlap in the view of this browser are hidden: that of the selection is shown first, then the nearest ones.

import { state } from "../core/store.js";
import { onSceneBuilt } from "./scene.js";

const GAP = 2; // [px] between two labels
const ABOVE = 3; // [m] largest distance of a label from the place of its tree on the ground
const PIXELS = 40; // of a screen that is 800 px high, per unit of a label 10 units away (LabelRenderer.tsx of viser)

// The rectangles behind the texts are instances of one mesh, whose shader reads position and visibility of each label from a
// texture: [x, y, z, visible], written before each picture. A label that is not to be seen is set invisible there.
function rectangles(scene) {
  const found = [];
  scene.traverse((node) => {
    const { uniforms } = node.material ?? {};
    if (uniforms?.uLabelData && !uniforms.uAtlas && node.geometry.instanceCount > 0) found.push(node);
  });
  return found;
}

// Labels as {at: index in the texture, near: distance from the camera, box: [left, bottom, right, top] in pixels, rank}.
function labelsIn(mesh, camera, marked) {
  const { aLabelIndex, aRect, aParams } = mesh.geometry.attributes, { uLabelData, uViewportHeight } = mesh.material.uniforms;
  const data = uLabelData.value.image.data, height = uViewportHeight.value, width = height * camera.aspect;
  const shown = [];
  for (let k = 0; k < mesh.geometry.instanceCount; k += 1) {
    const at = 4 * aLabelIndex.getX(k);
    if (!data[at + 3]) continue;
    const place = camera.position.clone().set(data[at], data[at + 1], data[at + 2]);
    const near = place.distanceTo(camera.position), far = marked ? place.distanceTo(marked) : Infinity;
    const { x, y, z } = place.project(camera);
    if (z > 1) continue; // behind the camera
    const unit = PIXELS * aParams.getY(k), left = ((x + 1) * width) / 2 + unit * aRect.getX(k), bottom = ((y + 1) * height) / 2 + unit * aRect.getY(k);
    shown.push({ data, at, near, far, box: [left, bottom, left + unit * aRect.getZ(k), bottom + unit * aRect.getW(k)] });
  }
  return shown;
}

const meet = (a, b) => a[0] < b[2] + GAP && b[0] < a[2] + GAP && a[1] < b[3] + GAP && b[1] < a[3] + GAP;

// Hides the labels that a more important one covers; returns the boxes of those that are seen.
function hideCovered(labels) {
  const ofSelection = labels.filter(({ far }) => far < ABOVE).sort((a, b) => a.far - b.far)[0];
  const seen = [];
  for (const label of labels.sort((a, b) => (b === ofSelection) - (a === ofSelection) || a.near - b.near)) {
    if (seen.some((box) => meet(box, label.box))) label.data[label.at + 3] = 0;
    else seen.push(label.box);
  }
  return seen;
}

export function startLabels() {
  onSceneBuilt(({ __viserMutable: viser }) => {
    const { scene, nodeRefFromName } = viser, then = scene.onBeforeRender;
    if (scene.userData.hasLabels) return; // the window of a frame is the same object after a reload
    scene.userData.hasLabels = true;
    scene.onBeforeRender = (...args) => {
      then?.apply(scene, args);
      const camera = args[2], world = nodeRefFromName["/world"];
      if (!camera?.isPerspectiveCamera || !world) return;
      const marked = state.place && camera.position.clone().set(...state.place).applyMatrix4(world.matrixWorld);
      scene.userData.labels = hideCovered(rectangles(scene).flatMap((mesh) => labelsIn(mesh, camera, marked)));
    };
  });
}
