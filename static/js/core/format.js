// Numbers for people: three significant digits at most, "–" for unknown.

export const NONE = "–";
const known = (value) => typeof value === "number" && Number.isFinite(value);

export function figure(value, digits = 3) {
  if (!known(value)) return NONE;
  if (value === 0) return "0";
  const whole = Math.floor(Math.log10(Math.abs(value))) + 1;
  return value.toFixed(Math.max(0, Math.min(digits - whole, digits - 1)));
}

export const fixed = (value, decimals) => (known(value) ? value.toFixed(decimals) : NONE);

export const percent = (rate) => (known(rate) ? `${figure(100 * rate)} %` : NONE);

// Minutes, seconds and tenths: "2:13.4".
export function clock(seconds) {
  if (!known(seconds)) return NONE;
  const tenths = Math.round(seconds * 10);
  const minutes = Math.floor(tenths / 600);
  return `${minutes}:${String(Math.floor(tenths / 10) % 60).padStart(2, "0")}.${tenths % 10}`;
}

export const count = (number, one, many = `${one}s`) => `${number} ${number === 1 ? one : many}`;
export const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

// A duration of which only the order is known: "40 s", "3 min".
export function roughly(seconds) {
  if (seconds >= 90) return `${Math.round(seconds / 60)} min`;
  return `${seconds > 10 ? 10 * Math.round(seconds / 10) : Math.max(1, Math.round(seconds))} s`;
}

// --- trees -------------------------------------------------------------------------------------

// Whether the sigma of a tree is assumed: no single scan detected it, only the accumulated scans did.
export const isAssumed = (tree) => tree.observations === 0;

export function dbhText({ dbh_cm: dbh, sigma_dbh_cm: sigma }) {
  if (dbh === null) return "DBH not measured";
  return `DBH ${figure(dbh)}${known(sigma) ? ` ± ${figure(sigma, 2)}` : ""} cm`;
}

export const heightText = ({ height_m: height, sigma_height_m: sigma }) => (known(height) ? `${fixed(height, 1)} ± ${figure(sigma, 2)} m` : "not seen");

export const seenText = (tree) => (isAssumed(tree) ? "detected in no single scan, only in the accumulated scans" : `detected in ${count(tree.observations, "scan")}`);
