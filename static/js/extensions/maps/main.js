// "Locate in ...": where the robot of the open run is in the map of a stored run, which the 2D map shows in grey.

import { get, post, remove } from "../../core/api.js";
import { button, byId, el, setText } from "../../core/dom.js";
import { capital, count } from "../../core/format.js";
import { receive } from "../../core/live_feed.js";
import { edits } from "../../core/permissions.js";
import { attempted } from "../../core/problem.js";
import { changed, isDrive } from "../../core/store.js";
import { colours } from "../../core/theme.js";
import { when } from "../../runs/figures.js";
import { extend } from "../../shell/extensions.js";

let now = { name: "", serial: 0, state: "idle", text: "", pose: null };
let stems = [], stemsOf = 0; // [x, y] of the stored map in its frame, and its serial

async function show(message) {
  now = message;
  if (now.state !== "idle" && (stemsOf !== now.serial || now.state === "searching")) { // serial numbers restart with the server
    stemsOf = now.serial;
    stems = [];
    const got = await attempted(() => get("/api/localise"));
    if (got?.serial === stemsOf) stems = got.stems; // else another map was begun meanwhile
  }
  if (now.state === "idle") stemsOf = 0;
  const status = byId("localise-status");
  status.hidden = now.state === "idle";
  status.classList.toggle("lost", now.state !== "found");
  setText(byId("localise-text"), `In the map of ${now.name}: ${now.text}`);
  byId("legend-stored").hidden = !now.pose;
  changed("ghost"); // paints the 2D map again
}

const stop = () => attempted(() => remove("/api/localise"));

// A run of the list with what tells it from others of its name, and why it cannot be chosen.
function option({ key, name, begun_s, scans, all_scans, trees }) {
  const share = scans < all_scans ? `, mapped to ${Math.floor((100 * scans) / all_scans)} %` : "";
  const text = trees === undefined ? name : `${name}, ${trees ? count(trees, "tree") : "no trees"}${share}, ${when(begun_s)}`;
  return el("option", { value: key, text, disabled: trees === 0 });
}

async function choose() {
  const listed = await attempted(() => Promise.all([get("/api/runs"), get("/api/localise/files")]));
  if (!listed) return;
  const [{ runs, folders, open }, { files }] = listed;
  const options = [...runs.filter(({ key }) => key !== String(open)), ...folders].map(option);
  const usable = options.some((each) => !each.disabled);
  const select = el("select", { id: "localise-run" }, ...options);
  const path = el("input", { id: "localise-path", type: "text", list: "localise-files", maxlength: "4096", autocomplete: "off", spellcheck: "false", placeholder: "/data/out or stand.stems", oninput: () => allow() });
  const problem = el("p", { class: "error", role: "alert", hidden: true });
  const dialog = el("dialog", { id: "localise-dialog", "aria-labelledby": "localise-title" });
  const locate = async (event) => {
    event.preventDefault();
    try {
      await post("/api/localise", path.value.trim() ? { path: path.value.trim() } : { run: select.value });
      dialog.close();
    } catch (refused) {
      problem.hidden = false;
      setText(problem, capital(refused.message));
    }
  };
  const go = el("button", { id: "localise-go", class: "primary", text: "Locate", title: "Search the stems of the open run in this map" });
  const allow = () => { // a typed path counts in place of the run
    const typed = path.value.trim() !== "";
    select.disabled = typed || !usable;
    go.disabled = !typed && !usable;
    problem.hidden = true;
  };
  dialog.append(el("form", { onsubmit: locate },
    el("h2", { id: "localise-title", text: "Locate in a stored map" }),
    el("p", { class: "note dim", text: "The robot is searched among the trees of an earlier run; no start pose is needed. That map does not change." }),
    el("label", { for: "localise-run", text: "Run with the map" }), select,
    el("p", { class: "note dim", text: usable ? "The open run is not listed: its robot is searched in the map of another run." : "No other run has a map yet: the open run is listed here when another run is open." }),
    el("label", { for: "localise-path", text: "Or a path on the server: the folder of a mapped run, or a .stems file" }), path,
    el("datalist", { id: "localise-files" }, ...files.map((value) => el("option", { value }))), problem,
    el("div", { class: "row end" }, button("localise-cancel", "Cancel", "", () => dialog.close(), ""), go)));
  dialog.addEventListener("close", () => dialog.remove());
  allow();
  document.body.append(dialog);
  dialog.showModal();
}

function drawStored(pen, view) {
  if (!now.pose) return;
  const [x, y, yaw] = now.pose, c = Math.cos(yaw), s = Math.sin(yaw);
  Object.assign(pen, { strokeStyle: colours.dim, lineWidth: 1.5 });
  for (const [a, b] of stems) {
    const [px, py] = view.toScreen(x + c * a - s * b, y + s * a + c * b);
    pen.beginPath();
    pen.arc(px, py, 6, 0, 2 * Math.PI);
    pen.stroke();
  }
}

const presentActions = () => [
  ...(isDrive() ? [["Locate in the map of a stored run …", "", edits(choose), "localise relocalise find robot where pose"]] : []),
  ...(now.state === "idle" ? [] : [[`Stop locating in the map of ${now.name}`, "", edits(stop), "localise"]]),
];

function start() {
  const end = button("localise-stop", "Stop", "Do not locate any more", stop);
  end.dataset.edits = "";
  byId("notice").after(el("p", { id: "localise-status", role: "status", hidden: true }, el("span", { id: "localise-text" }), end));
  document.querySelector(".legend .robot").before(el("li", { id: "legend-stored", class: "stored-map", hidden: true, text: "stored map", title: "A tree of the map in which the robot is located" }));
  receive("localise", ({ type, ...message }) => show(message));
  attempted(async () => show(await get("/api/localise")));
}

extend(import.meta.url, { start, presentActions, drawOnMap: drawStored });
