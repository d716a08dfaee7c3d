// The slider of a parameter, in the tab Tune and next to the 3D scene: its scale, and what drags and keys do to its value.

export const FINE = 1000; // places of a slider
const TRAVEL = 400; // [px] of a drag over the whole range of a linear slider
const SHARE = 0.01; // largest relative change of a value by one pixel of a drag on a logarithmic slider
const REACH = 8; // [px] around the centre of a thumb; a press farther away moves the thumb there
const KEYS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 10, PageDown: -10 };

// Place of a value, 0 to FINE; values outside of the range of the slider are at its ends.
export function toPlace({ shown: [low, high], log }, value) {
  const part = log ? Math.log(Math.max(value, low) / low) / Math.log(high / low) : (value - low) / (high - low);
  return FINE * Math.min(1, Math.max(0, part));
}

// Value at a place, 0 to FINE. At the lower end of a logarithmic slider it is 0, which often means "off", if 0 is valid.
export function fromPlace(spec, place) {
  const [low, high] = spec.shown, part = Math.min(1, Math.max(0, place / FINE));
  if (spec.log && part === 0 && spec.minimum === 0) return 0;
  return near(spec, spec.log ? low * (high / low) ** part : low + (high - low) * part);
}

// The value within the bounds, rounded to the step, or to a tenth of it on a logarithmic slider.
export function near({ kind, minimum, maximum, step, log }, value) {
  const unit = kind === "int" ? 1 : (log ? 0.1 : 1) * (step || 1);
  return Math.min(maximum, Math.max(minimum, Number((Math.round(value / unit) * unit).toFixed(9))));
}

// The value after a key, or null if the key does not move a slider.
export function pressed(spec, value, { key, ctrlKey, metaKey, altKey }) {
  if (!KEYS[key] || ctrlKey || metaKey || altKey) return null;
  return near(spec, value + KEYS[key] * (spec.step || 1));
}

// Places by which a drag of one pixel moves a value.
const perPixel = ({ shown: [low, high], log }) => FINE / (log ? Math.max(TRAVEL, Math.log(high / low) / SHARE) : TRAVEL);

// Begins a drag with a `pointerdown` on a slider. A press on the thumb changes nothing; then each pixel moves the value, also
// beyond the ends of the slider. `thumb` is the centre of the thumb and `track` are both ends [px]; `valueAt` returns the value
// at a part of the track, 0 to 1; `send` receives the values.
export function beginDrag(event, spec, value, { thumb, track: [from, to], valueAt }, send) {
  const { target, pointerId, clientX: startX } = event;
  let place = toPlace(spec, value), last = value;
  const put = (wanted) => { if (wanted !== last) send(last = wanted); };
  if (Math.abs(startX - thumb) > REACH) {
    put(valueAt(Math.min(1, Math.max(0, (startX - from) / Math.max(1, to - from)))));
    place = toPlace(spec, last);
  }
  const move = ({ clientX }) => clientX !== startX && put(fromPlace(spec, place + (clientX - startX) * perPixel(spec)));
  const end = () => {
    target.removeEventListener("pointermove", move);
    for (const name of ["pointerup", "pointercancel"]) target.removeEventListener(name, end);
  };
  target.setPointerCapture(pointerId);
  target.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel"]) target.addEventListener(name, end);
}
