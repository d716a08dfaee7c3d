// "Locate in ...": where the robot of the open run is in the map of a stored run, which the 2D map shows in grey.

import { get, post, remove } from "../../core/api.js";
import { button, byId, el, setText } from "../../core/dom.js";
import { receive } from "../../core/live_feed.js";
import { edits } from "../../core/permissions.js";
import { attempted } from "../../core/problem.js";
import { changed, isDrive } from "../../core/store.js";
import { colours } from "../../core/theme.js";
import { extend } from "../../shell/extensions.js";

let now = { name: "", state: "idle", text: "", pose: null };
let stems = [], stemsOf = ""; // [x, y] of the stored map in its frame, and the name of its run

async function show(message) {
  now = message;
  if (now.state !== "idle" && stemsOf !== now.name) {
    stemsOf = now.name;
    stems = (await attempted(() => get("/api/localise")))?.stems ?? [];
  }
  if (now.state === "idle") stemsOf = "";
  const status = byId("localise-status");
  status.hidden = now.state === "idle";
  status.classList.toggle("lost", now.state !== "found");
  setText(byId("localise-text"), `In the map of ${now.name}: ${now.text}`);
  byId("legend-stored").hidden = !now.pose;
  changed("ghost"); // paints the 2D map again
}

const stop = () => attempted(() => remove("/api/localise"));

async function choose() {
  const listed = await attempted(() => get("/api/runs"));
  if (!listed) return;
  const rows = [...listed.runs.filter(({ key }) => key !== String(listed.open)), ...listed.folders];
  const select = el("select", { id: "localise-run" }, ...rows.map(({ key, name }) => el("option", { value: key, text: name })));
  const problem = el("p", { class: "error", role: "alert", hidden: true });
  const dialog = el("dialog", { id: "localise-dialog", "aria-labelledby": "localise-title" });
  const locate = async () => {
    try {
      await post("/api/localise", { run: select.value });
      dialog.close();
    } catch (refused) {
      problem.hidden = false;
      setText(problem, refused.message);
    }
  };
  const go = button("localise-go", "Locate", "Search the stems of the open run in this map", locate, "primary");
  go.disabled = !rows.length;
  dialog.append(el("h2", { id: "localise-title", text: "Locate in a stored map" }),
    el("p", { class: "note dim", text: rows.length ? "The robot is searched among the trees of an earlier run; no start pose is needed. That map does not change." : "There is no stored run yet: a run is listed here after this page has mapped it. Maps in folders are for the command: stemmap localise RUN --map DIR" }),
    el("label", { for: "localise-run", text: "Run with the map" }), select, problem,
    el("div", { class: "row end" }, button("localise-cancel", "Cancel", "", () => dialog.close(), ""), go));
  dialog.addEventListener("close", () => dialog.remove());
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
