// Coordinates as the files have them: those of the map plus the offset of a whole cloud, in millimetres.

import { fixed } from "./format.js";
import { state } from "./store.js";

// Offset x, y of the map in the coordinates of the files [m]; zero for a drive.
export const offset = () => state.status?.one_step?.offset.slice(0, 2) ?? [0, 0];

export const inFile = (x, y) => offset().map((by, axis) => Number(([x, y][axis] + by).toFixed(3)));
// The numbers that a person types, without the error of the subtraction.
export const inMap = (x, y) => offset().map((by, axis) => Number(([x, y][axis] - by).toFixed(6)));

export const placeTexts = ([x, y]) => inFile(x, y).map((value) => fixed(value, 3));
export const placeText = (position) => `${placeTexts(position).join(", ")} m`;
