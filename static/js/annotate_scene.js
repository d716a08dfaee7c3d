// Shift-click in the 3D scene adds a tree: at the stem that was meant, else where the ground is.

import { add, annotating } from "./annotate.js";
import { snap } from "./annotate_map.js";
import { onSceneLoad } from "./scene.js";
import { state } from "./state.js";

const NEAR = 0.35; // [m] beside a stem's axis still means the stem
const HEIGHT = 2.5; // [m] of a stem that is seen
const STILL = 5; // [pixels]; farther is no click, but a turn of the camera

// The ray through a place of the window, in the frame of the map.
function rayAt(inner, x, y) {
  const { camera, canvas, nodeRefFromName } = inner.__viserMutable ?? {};
  const world = nodeRefFromName?.["/world"];
  if (!camera || !canvas || !world) return null;
  const box = canvas.getBoundingClientRect();
  const toMap = world.matrixWorld.clone().invert();
  const from = camera.getWorldPosition(camera.position.clone());
  const to = camera.position.clone().set((2 * (x - box.x)) / box.width - 1, 1 - (2 * (y - box.y)) / box.height, 0.5).unproject(camera);
  return [from.applyMatrix4(toMap), to.applyMatrix4(toMap)];
}

// How far along the ray it passes an upright stem, in lengths of the ray; null where it misses it.
function passes([from, to], { x, y }) {
  const [dx, dy, dz] = [to.x - from.x, to.y - from.y, to.z - from.z];
  const flat = dx * dx + dy * dy;
  if (flat === 0) return null;
  const t = ((x - from.x) * dx + (y - from.y) * dy) / flat;
  const beside = Math.hypot(from.x + t * dx - x, from.y + t * dy - y);
  const height = from.z + t * dz;
  return t > 0 && beside < NEAR && height > 0 && height < HEIGHT ? t : null;
}

export function meant(ray) {
  const { x = [], y = [] } = state.map?.clusters ?? {};
  let [best, least] = [null, Infinity];
  for (const stem of [...(state.map?.trees ?? []), ...x.map((_, k) => ({ x: x[k], y: y[k] }))]) {
    const t = passes(ray, stem);
    if (t !== null && t < least) [best, least] = [stem, t];
  }
  if (best) return { x: best.x, y: best.y };
  const [from, to] = ray;
  const t = from.z / (from.z - to.z);
  return t > 0 && Number.isFinite(t) ? snap(from.x + t * (to.x - from.x), from.y + t * (to.y - from.y)) : null;
}

export function startAnnotateScene() {
  onSceneLoad((inner) => {
    let down = null;
    inner.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; }, { capture: true });
    inner.addEventListener("pointerup", (event) => {
      if (!annotating() || !event.shiftKey || event.button !== 0 || event.target.tagName !== "CANVAS" || !down) return;
      if (Math.hypot(event.clientX - down[0], event.clientY - down[1]) > STILL) return;
      const ray = rayAt(inner, event.clientX, event.clientY);
      const place = ray && meant(ray);
      if (place) add({ x: Math.round(place.x * 1e4) / 1e4, y: Math.round(place.y * 1e4) / 1e4 });
    }, { capture: true });
  });
}
