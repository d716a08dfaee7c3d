// The text of an empty panel: what to do, or that nothing needs to be done.

import { state } from "./store.js";

export const nothingYet = (what = "Nothing mapped") => state.status?.state === "starting"
  ? "Starting; this fills with the first scan."
  : state.status?.state === "playing" ? `${what} yet; this fills with the next scan.`
  : `${what} yet. Press play, or open a run.`;
