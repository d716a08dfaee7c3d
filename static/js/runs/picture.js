// A map on a canvas that can be moved, zoomed and asked what lies under the pointer.

import { el, setText } from "../core/dom.js";
import { colour } from "../core/theme.js";
import { drawFrame } from "../map/draw.js";
import { MapView } from "../map/map_view.js";

const NAMES = ["tree", "pole", "person", "bush", "other", "uncertain", "truth", "path", "odometry", "robot", "selection", "text", "surface", "grid", "axis", "font", "warn"];

// paint(pen, view, colours) draws; bounds() gives [x0, y0, x1, y1] in metres; describe(px, py, view) a text or "".
export function picture({ label, legend, paint, bounds, describe }) {
  const canvas = el("canvas", { tabindex: "0", role: "img", "aria-label": label });
  const tip = el("div", { class: "tip", hidden: true });
  const view = new MapView();
  const fit = () => { view.moved = false; view.fit(bounds(), true); redraw(); };
  const frame = el("div", { class: "map-frame" }, canvas, tip,
    el("div", { class: "map-buttons" }, el("button", { class: "small", text: "Fit", title: "Show the whole map", onclick: fit })));
  const box = el("div", { class: "run-map" }, frame, el("ul", { class: "legend", "aria-label": "Legend" }, ...legend.map(([name, text]) => el("li", { class: name, text }))));
  let from = null;

  function redraw() {
    const pen = canvas.getContext("2d");
    const colours = Object.fromEntries(NAMES.map((name) => [name, colour(name)]));
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    drawFrame(pen, view, colours, () => paint(pen, view, colours));
  }

  function resize() {
    if (!frame.clientWidth) return;
    Object.assign(view, { width: frame.clientWidth, height: frame.clientHeight });
    Object.assign(canvas, { width: frame.clientWidth * devicePixelRatio, height: frame.clientHeight * devicePixelRatio });
    if (!view.moved) view.fit(bounds(), true);
    redraw();
  }

  function move(event) {
    const at = [event.offsetX, event.offsetY];
    if (from) {
      view.pan(at[0] - from[0], at[1] - from[1]);
      from = at;
      redraw();
    }
    const text = from ? "" : describe(...at, view);
    tip.hidden = !text;
    if (!text) return;
    setText(tip, text);
    tip.style.left = `${Math.min(at[0] + 14, view.width - tip.offsetWidth - 6)}px`;
    tip.style.top = `${Math.min(at[1] + 14, view.height - tip.offsetHeight - 6)}px`;
  }

  const zoom = (factor, x = view.width / 2, y = view.height / 2) => { view.zoom(factor, x, y); redraw(); };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); from = [event.offsetX, event.offsetY]; canvas.classList.add("dragging"); });
  canvas.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { from = null; canvas.classList.remove("dragging"); });
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = { "+": () => zoom(1.25), "-": () => zoom(0.8), ArrowLeft: () => view.pan(40, 0), ArrowRight: () => view.pan(-40, 0), ArrowUp: () => view.pan(0, 40), ArrowDown: () => view.pan(0, -40) }[event.key];
    if (!step) return;
    event.preventDefault();
    step();
    redraw();
  });
  new ResizeObserver(resize).observe(frame);
  return { box, canvas, redraw };
}

export function boundsOf(...lists) {
  const xs = lists.flat().map((point) => point.x ?? point[0]), ys = lists.flat().map((point) => point.y ?? point[1]);
  if (!xs.length) return [-3, -3, 3, 3];
  const least = (list) => list.reduce((a, b) => Math.min(a, b)), most = (list) => list.reduce((a, b) => Math.max(a, b));
  return [least(xs), least(ys), most(xs), most(ys)];
}
