// The story of an object of the ground truth where this scan has no cluster and the map no tree.

import { el } from "../core/dom.js";
import { figure } from "../core/format.js";
import { isDrive, state } from "../core/store.js";
import { timeLink } from "../playback/time_link.js";

export function truthStory({ kind, x, y }) {
  const title = el("h2", { text: `${kind[0].toUpperCase()}${kind.slice(1)} of the ground truth` });
  if (!isDrive() || !state.path.length) return [title, el("p", { text: "Nothing was found at this place, so it is not in the map as a tree." })];
  const gaps = state.path.map(([px, py]) => Math.hypot(px - x, py - y));
  const nearest = gaps.reduce((best, gap, scan) => (gap < gaps[best] ? scan : best), 0);
  // Scans follow one another evenly; half a scan keeps a rounded time from being the one before.
  const time = ((nearest + 0.5) / (state.map.index || 1)) * state.status.time_s;
  return [title,
    el("p", { text: `No cluster of this scan and no tree of the map is at this place, ${figure(gaps.at(-1))} m from the robot. A scan has a cluster where enough points lie on an object inside of the range and the pass-through box, and no nearer object hides it.` }),
    nearest === gaps.length - 1 ? el("p", { text: "Up to now the robot was never nearer to it." })
      : el("p", {}, `Up to now the robot was nearest to it, ${figure(gaps[nearest])} m, at `, timeLink(time), ". If a cluster is at this place there, click it to see its verdict.")];
}
