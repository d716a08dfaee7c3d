// Coordinates as the files have them: those of the map plus the offset of a whole cloud, in the unit of its reference system.

import { el, setText } from "./dom.js";
import { fixed } from "./format.js";
import { on, state } from "./store.js";

const UNITS = [[1, "m"], [0.3048, "ft"], [1200 / 3937, "US ft"]]; // metres per unit

// Offset x, y of the map in the coordinates of the files [m]; zero for a drive.
const offset = () => state.status?.one_step?.offset.slice(0, 2) ?? [0, 0];
const metresPerUnit = () => state.status?.one_step?.crs_unit[0] ?? 1;

export const isMetric = () => metresPerUnit() === 1;
export const unitWord = () => UNITS.find(([metres]) => Math.abs(metres - metresPerUnit()) < 1e-9)?.[1] ?? "units";
// The unit in a text that stays when another source is opened.
export const unitNode = () => el("span", { "data-unit": "file", text: unitWord() });

// How the map draws its grid: at round coordinates of the files.
export const fileFrame = () => ({ offset: offset(), metres: metresPerUnit(), word: unitWord() });

// Rounded to millimetres before the unit is changed, as in the files.
export const inFile = (x, y) => offset().map((by, axis) => Number((Number(([x, y][axis] + by).toFixed(3)) / metresPerUnit()).toFixed(3)));
// The numbers that a person types, without the error of the subtraction.
export const inMap = (x, y) => offset().map((by, axis) => Number(([x, y][axis] * metresPerUnit() - by).toFixed(6)));

export const placeTexts = ([x, y]) => inFile(x, y).map((value) => fixed(value, 3));
export const placeText = (position) => `${placeTexts(position).join(", ")} ${unitWord()}`;

export function startUnits() {
  on("status", () => { for (const node of document.querySelectorAll("[data-unit]")) setText(node, unitWord()); });
}
