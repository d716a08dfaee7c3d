// Figures for people: three significant digits at most, "–" for what is not known.

export const NONE = "–";
const known = (value) => typeof value === "number" && Number.isFinite(value);

export function figure(value, digits = 3) {
  if (!known(value)) return NONE;
  if (value === 0) return "0";
  const whole = Math.floor(Math.log10(Math.abs(value))) + 1;
  return value.toFixed(Math.max(0, Math.min(digits - whole, digits - 1)));
}

export function fixed(value, decimals) {
  return known(value) ? value.toFixed(decimals) : NONE;
}

export function percent(rate) {
  return known(rate) ? `${figure(100 * rate)} %` : NONE;
}

export function clock(seconds) {
  if (!known(seconds)) return NONE;
  const tenths = Math.round(seconds * 10);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${String(Math.floor(tenths / 10) % 60).padStart(2, "0")}.${tenths % 10}`;
}

export const count = (number, one, many = `${one}s`) => `${number} ${number === 1 ? one : many}`;

// Whether a tree's sigma is assumed: no single scan measured where it stands, all together found it.
export const isAssumed = (tree) => tree.observations === 0;
