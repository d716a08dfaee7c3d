// A map on a canvas that can be panned, zoomed and hovered. The dashboard, the page of runs and the page of robots use it.

import { oncePerFrame } from "../core/timing.js";

const SLACK = 0.12; // share of the picture's size kept free around the fitted content
const CLICK_REACH = 4; // [px] a pointer may travel between press and release of a click
const ZOOM_BY_WHEEL = 0.0015; // exponent per pixel of the wheel
const PAN_BY_KEY = 40; // [px]

// Transformation from metres of the map to pixels of the canvas: x to the right, y up.
class MapView {
  scale = 20; // [px/m]
  x = 0; // centre of the view [m]
  y = 0;
  width = 1; // [px]
  height = 1;
  top = 0; // [px] at the upper edge that are covered by buttons and kept free by `fit`
  moved = false; // whether a person chose the visible part

  toScreen = (x, y) => [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale];
  toMap = (px, py) => [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale];

  // Shows all of [x0, y0, x1, y1]. A view that already shows it at a fair size is kept unless `always`.
  fit([x0, y0, x1, y1], always = false) {
    const [left, top] = this.toScreen(x0, y1);
    const [right, bottom] = this.toScreen(x1, y0);
    const holds = left > 26 && top > Math.max(26, this.top - 1) && right < this.width - 12 && bottom < this.height - 26;
    const fills = right - left > 0.35 * this.width || bottom - top > 0.35 * this.height;
    if (holds && fills && !always) return;
    const room = 1 - 2 * SLACK;
    const height = Math.max(room * this.height - Math.max(0, this.top - SLACK * this.height), 0.4 * this.height);
    this.scale = Math.min((room * this.width) / Math.max(x1 - x0, 6), height / Math.max(y1 - y0, 6));
    this.x = (x0 + x1) / 2;
    const above = Math.max(0, this.top - SLACK * this.height); // the centre moves down by half of the covered part
    this.y = (y0 + y1) / 2 + above / 2 / this.scale;
  }

  zoom(factor, px, py) {
    const [x, y] = this.toMap(px, py);
    this.scale = Math.min(2000, Math.max(0.5, this.scale * factor));
    const [nx, ny] = this.toMap(px, py);
    this.x += x - nx;
    this.y += y - ny;
    this.moved = true;
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.moved = true;
  }

  // Step of the grid in units of so many metres: 1, 2 or 5 times a power of ten, at least 55 pixels.
  step(metres = 1) {
    const least = 55 / this.scale / metres;
    const power = 10 ** Math.floor(Math.log10(least));
    return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least);
  }
}

// Places a tooltip next to a point of the canvas and inside of it; an empty text hides it.
function showTip(tip, text, [px, py], { width, height }) {
  tip.hidden = !text;
  if (!text) return;
  if (tip.textContent !== text) tip.textContent = text;
  tip.style.left = `${Math.min(px + 14, width - tip.offsetWidth - 6)}px`;
  tip.style.top = `${Math.min(py + 14, height - tip.offsetHeight - 6)}px`;
}

// Options:
//   paint(pen, view)          draws the content
//   bounds()                  [x0, y0, x1, y1] of the content [m]
//   tip, describe(at, view)   element of the tooltip, and its text for a point [px]
//   top                       [px] kept free at the upper edge
//   fixed                     true: no pointer and no keyboard
//   gestures                  {press(at), drag(at, travelled), release(), hover(at), click(at)}: `drag` and `release`
//                             return true if they handled the event, so that the map does not pan or report a click
export class MapCanvas {
  constructor(canvas, { paint, bounds, tip = null, describe = () => "", top = 0, fixed = false, gestures = {} }) {
    Object.assign(this, { canvas, paint, bounds, tip, describe, gestures, view: Object.assign(new MapView(), { top }) });
    this.pointers = new Map(); // last position of each finger or mouse that is down
    this.travelled = 0; // [px] since the first one went down
    this.redraw = oncePerFrame(() => this.draw());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    if (!fixed) this.listen();
  }

  draw() {
    if (!this.view.moved) this.view.fit(this.bounds());
    const pen = this.canvas.getContext("2d");
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    pen.clearRect(0, 0, this.view.width, this.view.height);
    this.paint(pen, this.view);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    Object.assign(this.view, { width, height });
    Object.assign(this.canvas, { width: width * devicePixelRatio, height: height * devicePixelRatio });
    if (!this.view.moved) this.view.fit(this.bounds(), true);
    this.redraw();
  }

  fit() {
    this.view.moved = false;
    this.view.fit(this.bounds(), true);
    this.redraw();
  }

  // Pans so that a place [m] is in the centre, if it is not visible now.
  bringIntoView(x, y) {
    const [px, py] = this.view.toScreen(x, y);
    if (px > 12 && py > 12 && px < this.view.width - 12 && py < this.view.height - 12) return;
    this.view.pan(this.view.width / 2 - px, this.view.height / 2 - py);
    this.redraw();
  }

  zoom(factor, [px, py] = [this.view.width / 2, this.view.height / 2]) {
    this.view.zoom(factor, px, py);
    if (this.tip) this.tip.hidden = true; // what it describes has moved
    this.redraw();
  }

  pan(dx, dy) {
    this.view.pan(dx, dy);
    this.redraw();
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => { if (this.tip) this.tip.hidden = true; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * ZOOM_BY_WHEEL), [event.offsetX, event.offsetY]);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (this.pointers.size === 1) {
      this.travelled = 0;
      this.gestures.press?.([event.offsetX, event.offsetY]);
    }
    this.canvas.classList.add("dragging");
  }

  move(event) {
    const at = [event.offsetX, event.offsetY], before = this.pointers.get(event.pointerId);
    if (this.tip) showTip(this.tip, this.pointers.size ? "" : this.describe(at, this.view), at, this.view);
    this.gestures.hover?.(at);
    if (!before) return;
    this.pointers.set(event.pointerId, at);
    const step = [at[0] - before[0], at[1] - before[1]];
    this.travelled += Math.hypot(...step);
    if (this.gestures.drag?.(at, this.travelled)) return;
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const gap = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
      this.zoom(gap(at) / Math.max(gap(before), 1), [(at[0] + other[0]) / 2, (at[1] + other[1]) / 2]);
    } else if (this.travelled > CLICK_REACH) this.pan(...step);
  }

  up(event) {
    const handled = this.gestures.release?.();
    if (!handled && event.type === "pointerup" && this.pointers.size === 1 && this.travelled <= CLICK_REACH) {
      this.gestures.click?.([event.offsetX, event.offsetY]);
    }
    this.pointers.delete(event.pointerId);
    this.canvas.classList.toggle("dragging", this.pointers.size > 0);
  }

  // Where clicks select something, the arrow keys belong to the page: they step through scans or move an annotation.
  key(event) {
    const act = { "+": () => this.zoom(1.25), "-": () => this.zoom(0.8) }[event.key] ?? (this.gestures.click ? null : {
      ArrowLeft: () => this.pan(PAN_BY_KEY, 0), ArrowRight: () => this.pan(-PAN_BY_KEY, 0), ArrowUp: () => this.pan(0, PAN_BY_KEY), ArrowDown: () => this.pan(0, -PAN_BY_KEY),
    }[event.key]);
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  }
}

// [x0, y0, x1, y1] around all points ({x, y} or [x, y]) of some lists; a square around the origin without any.
export function boundsOf(...lists) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const list of lists) for (const point of list) {
    const x = point.x ?? point[0], y = point.y ?? point[1];
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
  }
  return Number.isFinite(box[0]) ? box : [-3, -3, 3, 3];
}
