// The odometry alone, which the map draws beside the path: requested from the server, which knows all scans.

import { get } from "../core/api.js";
import { changed, isCloud, on, state } from "../core/store.js";
import { keepFresh } from "../core/timing.js";

const EVERY = 2000; // [ms] between two requests
const MOST = 4000; // scans

async function load() {
  if (!state.map || isCloud() || document.hidden) return;
  const { source } = state;
  try {
    const { scans, values } = await get(`/api/course?most=${MOST}&names=odom_x,odom_y`);
    if (source !== state.source) return; // of the former run
    state.odometry = scans.map((scan, k) => [scan, values.odom_x[k], values.odom_y[k]]);
    changed("odometry");
  } catch {
    // a busy worker: requested again after the next scan
  }
}

export const startOdometry = () => on("map", keepFresh(load, EVERY));
