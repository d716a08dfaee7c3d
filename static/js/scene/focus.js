// The camera of this browser flies to the selected tree or cluster. A selection made in the scene is in view already, and
// while a run plays the camera stays with the robot that it follows.

import { byId, recall, remember } from "../core/dom.js";
import { isPlaying, on, state } from "../core/store.js";
import { onSceneLoad, onScenePress } from "./scene.js";
import { viewOf } from "./viser_client.js";

const NEAR = 12; // [m] largest distance from the selection after a flight
const HEIGHT = 1.3; // [m] of the place that the camera looks at, above the ground
const CLICK = 6000; // [ms] after a click in the scene in which a selection counts as its result
const calm = matchMedia("(prefers-reduced-motion: reduce)");
const button = byId("focus-selection");
const isOn = () => button.getAttribute("aria-pressed") === "true";
let scene = null, clickedAt = -CLICK, last = "";

function fly([x, y, z]) {
  const at = viewOf(scene);
  if (!at) return;
  const { camera, control, world } = at;
  const target = camera.position.clone().set(x, y, z + HEIGHT).applyMatrix4(world.matrixWorld);
  const away = control.getPosition(camera.position.clone()).sub(control.getTarget(camera.position.clone()));
  const from = target.clone().add(away.setLength(Math.min(away.length(), NEAR))); // the direction of view stays
  control.setLookAt(...from.toArray(), ...target.toArray(), !calm.matches);
}

function onSelection() {
  const { place, selected, selectedCluster } = state;
  const subject = place ? `${selected} ${selectedCluster?.scan} ${selectedCluster?.cluster}` : last;
  if (selected === null && !selectedCluster) last = "";
  if (subject === last || !place) return;
  last = subject;
  const here = performance.now() - clickedAt < CLICK;
  clickedAt = -CLICK;
  if (isOn() && !here && !(isPlaying() && state.view?.follow)) fly(place);
}

export function toggleFocus() {
  const wanted = !isOn();
  button.setAttribute("aria-pressed", String(wanted));
  remember("focus", wanted ? "on" : "off");
  if (wanted && state.place) fly(state.place);
}

export function startFocus() {
  button.setAttribute("aria-pressed", String(recall("focus") !== "off"));
  button.addEventListener("click", toggleFocus);
  on("selection", onSelection);
  onSceneLoad((inner) => { scene = inner; });
  onScenePress(() => { clickedAt = performance.now(); });
}
