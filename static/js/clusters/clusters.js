// The tab Clusters: the verdicts on the clusters of the current scan, and the number of points after each stage.

import { byId, el } from "../core/dom.js";
import { nothingYet } from "../core/empty_state.js";
import { count, figure, fixed } from "../core/format.js";
import { selectCluster } from "../core/live_feed.js";
import { isDrive, isPlaying, on, state } from "../core/store.js";
import { throttled } from "../core/timing.js";
import { verdictOf } from "../core/verdicts.js";
import { openStory } from "../explain/story.js";
import { visible } from "../shell/tabs.js";

const EVERY = 80, EVERY_PLAYING = 800; // [ms] between two updates; a row that is replaced under the pointer takes no click
const panel = () => byId("panel-clusters");

// Texts of the counts of points where they differ from the names in the files of results.
const COUNTS = { "without a value": "invalid", "out of range": "outside the range limits", "out of the box": "outside the pass-through box", "averaged in voxels": "merged by the voxel filter", clustered: "in clusters", noise: "in no cluster" };

function show() {
  if (!visible("clusters")) return;
  if (!state.map) {
    panel().replaceChildren(el("p", { class: "empty", text: nothingYet("No scan") }));
    return;
  }
  const verdicts = Object.entries(state.map.verdicts ?? {}).sort((a, b) => (b[0] === "tree") - (a[0] === "tree") || b[1] - a[1]);
  const clusters = verdicts.reduce((sum, [, number]) => sum + number, 0);
  const lead = !isDrive() ? `${count(clusters, "candidate")} for stems, with these verdicts.` : clusters
    ? `Scan ${state.map.index}: ${count(clusters, "cluster")}, with these verdicts.`
    : `Scan ${state.map.index}: no cluster. Check that the pass-through box and the height band contain the stems, and that Radius eps is large enough.`;
  panel().replaceChildren(el("p", { class: "lead", "data-scan": state.map.index, "data-clusters": clusters, text: lead }), bars(verdicts), clusterTable(), points());
}

function bars(verdicts) {
  const most = Math.max(1, ...verdicts.map(([, number]) => number));
  return el("ul", { class: "bars" }, ...verdicts.map(([label, number]) => {
    const [letter, meaning, reason] = verdictOf(label);
    const colour = `var(--${meaning})`;
    return el("li", {},
      el("span", { class: "letter", text: letter, style: { background: colour }, "aria-hidden": "true" }),
      el("span", { text: label }),
      el("span", { class: "bar", style: { background: colour, width: `${(100 * number) / most}%` } }),
      el("span", { class: "count", text: String(number) }),
      el("span", { class: "reason", text: !isDrive() && label === "tree" ? "A stem of the map." : reason }));
  }));
}

// Without a drive there are no scans, so candidates have no eccentricity and no distance from a sensor.
const applies = (_, place) => isDrive() || ![3, 5].includes(place);

// One row per cluster, the nearest first; a click opens its story.
function clusterTable() {
  const c = state.map.clusters;
  if (!c?.x.length) return "";
  const chosen = state.selectedCluster;
  const order = c.x.map((_, k) => k).sort((a, b) => c.distance[a] - c.distance[b]);
  const rows = order.map((k) => {
    const tell = () => { openStory("cluster"); selectCluster(state.map.index, k); };
    return el("tr", { tabindex: "0", "data-cluster": k, onclick: tell, onkeydown: (event) => event.key === "Enter" && tell(),
      "aria-selected": String(chosen?.scan === state.map.index && chosen.cluster === k) },
    ...[String(k + 1), c.verdict[k], String(c.size[k]), c.eccentricity[k] === null ? "∞" : figure(c.eccentricity[k]),
      figure(c.radius_cm[k]), fixed(c.distance[k], 1)].filter(applies).map((text) => el("td", { text })));
  });
  const heads = [["cluster", "Number of the cluster in this scan, as in its Story"], ["verdict", "Verdict on this cluster, from this scan only"], ["points", "Number of its points"], ["e", "Eccentricity: ratio of the eigenvalues of its covariance"], ["r cm", "Radius of the fitted circle"], ["m away", "Distance from the sensor"]];
  return el("table", { id: "cluster-table", class: "plain" }, el("thead", {}, el("tr", {}, ...heads.filter(applies).map(([text, title]) => el("th", { scope: "col", text, title })))),
    el("tbody", {}, ...rows));
}

function points() {
  const rows = Object.entries(state.map.counts ?? {}).flatMap(([name, number]) =>
    [el("dt", { text: COUNTS[name] ?? name.replaceAll("_", " ") }), el("dd", { text: number.toLocaleString("en") })]);
  return rows.length ? el("dl", { class: "list" }, ...rows) : "";
}

export function startClusters() {
  on("map", throttled(show, () => (isPlaying() ? EVERY_PLAYING : EVERY)));
  on("tab selection phase", show);
}
