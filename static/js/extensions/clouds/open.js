// What is chosen for a file of points before it is opened: mapped as a whole or driven through by a simulated robot, form, unit and
// axis.

import { byId, el } from "../../core/dom.js";

const SELECTS = {
  "source-as": ["Read as", { auto: "auto: by what it holds", cloud: "a whole cloud", scan: "one scan of a LiDAR" }],
  "source-unit": ["Unit", { auto: "auto: by its reference system or extent", m: "metres", cm: "centimetres", mm: "millimetres", ft: "feet", "us-ft": "US survey feet" }],
  "source-up": ["Up axis", { auto: "auto: by its ground", ...Object.fromEntries(["z", "y", "-y", "x", "-x", "-z"].map((axis) => [axis, axis])) }],
};
const radio = (value, text, checked) => el("label", {}, el("input", { type: "radio", name: "cloud-choice", value, checked }), ` ${text}`);
const node = el("fieldset", { id: "source-cloud", class: "source-choice", hidden: true }, el("legend", { text: "A file of points" }),
  radio("map", "Map this cloud: its stems, diameters and heights", true), radio("drive", "Drive a simulated robot through it", false),
  ...Object.entries(SELECTS).map(([id, [title, of]]) => el("label", { class: "inline" }, `${title} `, el("select", { id }, ...Object.entries(of).map(([value, text]) => el("option", { value, text }))))));
const drives = () => node.querySelector("input:checked").value === "drive";

export const sourceChoice = () => ({
  node,
  takes: (uri) => !uri.startsWith("sim:") && /\.(laz|las|e57|ply|npy|npz|pcd|xyz|asc|pts|ptx|txt|csv)$/i.test(uri),
  moves: drives,
  address: (uri) => (drives() ? `sim:cloud?${new URLSearchParams({ file: uri })}` : uri),
  fields: () => {
    const chosen = { form: byId("source-as").value, unit: byId("source-unit").value, up: byId("source-up").value };
    return Object.fromEntries(Object.entries(chosen).filter(([, value]) => value !== "auto"));
  },
  forget: () => {
    for (const id of Object.keys(SELECTS)) byId(id).value = "auto";
    node.querySelector("[value=map]").checked = true;
  },
});
