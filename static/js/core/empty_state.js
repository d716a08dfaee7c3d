// The text of an empty panel: what to do, or that nothing needs to be done.

import { isDrive, state } from "./store.js";

export const nothingYet = (what = "Nothing mapped") => (state.status?.state ?? "starting") === "starting"
  ? "Starting; this fills with the first scan."
  : !isDrive() ? `${what} yet; this fills when the cloud is mapped.`
  : state.status?.live && state.status.state === "waiting" ? `${what} yet; this fills with the first scan of the robot.`
  : state.status?.state === "playing" ? `${what} yet; this fills with the next scan.`
  : `${what} yet. Press play, or open a run.`;
