// The panel of viser with the main parameters. The page moves its sliders, so that they behave as those of the tab Tune;
// it names its widgets for screen readers, and collapses it while Tune is open and where it would cover the scene.

import { byId } from "../core/dom.js";
import { isDrive, on } from "../core/store.js";
import { newGesture, setValue, tuning, valueOf } from "../tune/parameters.js";
import { beginDrag, near, pressed } from "../tune/slider.js";
import { throttled } from "../core/timing.js";
import { visible } from "../shell/tabs.js";
import { onSceneLoad } from "./scene.js";

const SLIDER = ".mantine-Slider-root", ROW = ".mantine-Flex-root";
const NAMING_PAUSE = 500; // [ms]
let inner = null; // document of the scene
let collapsed = false; // by this page

const rowOf = (node) => node.closest(SLIDER)?.parentElement.closest(ROW)?.parentElement.closest(ROW) ?? null;
const labelOf = (row) => row?.firstElementChild?.textContent.replace("●", "").trim() ?? "";
const specAt = (node) => {
  const label = labelOf(rowOf(node));
  return label ? tuning.specs.find(({ main, title, unit }) => main && label === (unit ? `${title} [${unit}]` : title)) : undefined;
};

function press(event) {
  const root = event.target.closest?.(SLIDER), spec = root && specAt(root);
  if (!spec || event.button) return;
  event.preventDefault(); // no mouse event follows, which would move the thumb to the pointer
  event.stopPropagation();
  const thumb = root.querySelector("[role=slider]"), track = root.querySelector(".mantine-Slider-track").getBoundingClientRect();
  const box = thumb.getBoundingClientRect();
  thumb.focus();
  const gesture = newGesture();
  const [low, high] = ["valuemin", "valuemax"].map((name) => Number(thumb.getAttribute(`aria-${name}`))); // viser's sliders are linear
  const valueAt = (part) => near(spec, low + (high - low) * part);
  const at = { thumb: box.x + box.width / 2, track: [track.left, track.right], valueAt };
  beginDrag(event, spec, valueOf(spec.name), at, (value) => setValue(spec.name, value, gesture));
}

function key(event) {
  const spec = event.target.getAttribute?.("role") === "slider" ? specAt(event.target) : null;
  const value = spec ? pressed(spec, valueOf(spec.name), event) : null;
  if (value === null) return;
  event.preventDefault();
  event.stopPropagation();
  setValue(spec.name, value);
}

// Touches reach the slider as pointer events only.
const hold = (event) => { if (event.target.closest?.(SLIDER)) event.stopPropagation(); };

const nameWidgets = throttled(() => {
  for (const root of inner?.querySelectorAll(SLIDER) ?? []) {
    const row = rowOf(root), label = labelOf(row);
    root.style.touchAction = "none";
    for (const node of row?.querySelectorAll("[role=slider], input[inputmode]") ?? []) {
      if (node.getAttribute("aria-label") !== label) node.setAttribute("aria-label", label);
    }
  }
}, NAMING_PAUSE);

const narrow = matchMedia("(max-width: 1599px)"), phone = matchMedia("(max-width: 700px)");
const LEAST_WIDTH = 560; // [px] of the scene with its panel

// viser keeps the panel open or closed in each browser; its button is the only way to change that here. A person may open or
// close it at any time: only what the page wants otherwise than before is done.
function collapse() {
  const wanted = visible("tune") || narrow.matches || !isDrive() || byId("scene").clientWidth < LEAST_WIDTH;
  if (!inner || wanted === collapsed) return;
  const isDocked = inner.querySelector("[data-dock-region]"); // else a sheet at the bottom, in a small scene
  const named = (word) => inner.querySelector(`[data-dock-region] [aria-label^="${word}"]`);
  const button = isDocked ? named(wanted ? "Collapse" : "Expand")
    : inner.querySelector('.mantine-Paper-root [style*="cursor: pointer"][style*="height: 3.5em"]');
  if (!button && !named(wanted ? "Expand" : "Collapse")) return; // not built yet
  button?.click();
  button?.blur();
  collapsed = wanted;
}

// What the page shows over the scene leaves the panel free.
const follow = () => document.querySelector(".scene").classList.toggle("folded", Boolean(phone.matches || inner?.querySelector('[data-dock-region] [aria-label^="Expand"]')));

export function startScenePanel() {
  onSceneLoad((frame) => {
    inner = frame.document;
    collapsed = false;
    inner.addEventListener("pointerdown", press, true);
    inner.addEventListener("touchstart", hold, true);
    inner.addEventListener("keydown", key, true);
    new frame.MutationObserver(() => { nameWidgets(); collapse(); follow(); }).observe(inner.body, { childList: true, subtree: true });
  });
  on("tab source status", collapse);
  narrow.addEventListener("change", collapse);
  new ResizeObserver(collapse).observe(byId("scene"));
}
