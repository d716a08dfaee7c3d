// Numbers for people: three significant digits at most, a true minus sign, "–" for unknown.

export const NONE = "–";
const known = (value) => typeof value === "number" && Number.isFinite(value);

// A rounded number has no negative zero.
const withMinus = (text) => (text.startsWith("-") ? `${Number(text) === 0 ? "" : "−"}${text.slice(1)}` : text);

export function figure(value, digits = 3) {
  if (!known(value)) return NONE;
  if (value === 0) return "0";
  const whole = Math.floor(Math.log10(Math.abs(value))) + 1;
  return withMinus(value.toFixed(Math.max(0, Math.min(digits - whole, digits - 1))));
}

export const fixed = (value, decimals) => (known(value) ? withMinus(value.toFixed(decimals)) : NONE);

export const percent = (rate) => (known(rate) ? `${figure(100 * rate)} %` : NONE);

// A share of votes, with one decimal at most: "40 %", "8.7 %".
export const share = (rate) => (known(rate) ? `${Number((100 * rate).toFixed(1))} %` : NONE);

// [value, sigma] with as many decimals for the value as for its sigma: ["2.9", "0.9"], ["12.04", "0.03"].
export function withSigma(value, sigma) {
  if (!known(value) || !known(sigma)) return [figure(value), NONE];
  if (sigma < 0.0005) return [figure(value), "0"];
  const decimals = sigma >= 9.95 ? 0 : sigma >= 0.095 ? 1 : Math.min(3, -Math.floor(Math.log10(sigma)));
  return [fixed(value, decimals), fixed(sigma, decimals)];
}

// "12.0 ± 0.2", or the value alone where sigma is unknown.
export const plusMinus = (value, sigma) => (known(value) && known(sigma) ? withSigma(value, sigma).join(" ± ") : figure(value));

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

// Whether the sigma of a tree is assumed: no single scan detected it there, only the accumulated scans did, or a person placed it.
export const isAssumed = (tree) => tree.observations === 0;

// A figure of a tree with the decimals that it has in the files.
const asInFiles = (decimals) => (value, sigma) => (known(value) && known(sigma) ? `${fixed(value, decimals)} ± ${fixed(sigma, decimals)}` : fixed(value, decimals));
export const dbhFigure = asInFiles(1); // [cm]
export const heightFigure = asInFiles(2); // [m]

export const dbhText = ({ dbh_cm: dbh, sigma_dbh_cm: sigma }) => (dbh === null ? "DBH not measured" : `DBH ${dbhFigure(dbh, sigma)} cm`);

export const heightText = ({ height_m: height, sigma_height_m: sigma }) => (known(height) ? `${heightFigure(height, sigma)} m` : "not seen");

export const seenText = (tree) => (isAssumed(tree) ? "detected there in no single scan, only in the accumulated scans or by a person" : `detected in ${count(tree.observations, "scan")}`);
