// Options of a source before it is opened: topics by role with counts and rates, and the pose of the LiDAR on the robot.

import { post } from "../core/api.js";
import { byId, el } from "../core/dom.js";

const ROLES = { scan: "LiDAR", odometry: "Odometry", imu: "IMU", gnss: "GNSS", pose: "Other SLAM", camera: "Camera" };
const MOUNT = [["x", "m"], ["y", "m"], ["z", "m"], ["roll", "°"], ["pitch", "°"], ["yaw", "°"]];
let looked = null; // {uri, mount} of the shown source
let asked = ""; // address that is being inspected

const body = () => byId("inside-body");
const uri = () => byId("source-uri").value.trim();
const figures = ({ messages, rate_hz: rate, seconds }) => [messages === null ? "" : `${messages.toLocaleString("en")} messages${seconds ? ` in ${seconds} s` : ""}`, rate === null ? "" : `${rate} Hz`].filter(Boolean).join(", ");

// The options chosen for an address; {} if none were changed.
export function chosenFor(address) {
  if (looked?.uri !== address) return {};
  const chosen = {};
  const topics = Object.fromEntries([...body().querySelectorAll("select")].filter(({ value }) => value).map(({ name, value }) => [name, value]));
  if (Object.keys(topics).length) chosen.topics = topics;
  const mount = [...body().querySelectorAll(".inside-mount input")].map(({ valueAsNumber }) => valueAsNumber);
  const known = looked.mount ?? mount.map(() => NaN);
  if (mount.some((value, k) => Number.isFinite(value) && value !== known[k])) chosen.mount = mount.map((value, k) => (Number.isFinite(value) ? value : known[k] || 0));
  return chosen;
}

async function look() {
  const address = uri();
  if (!byId("source-inside").open || address === looked?.uri || (address && address === asked)) return;
  looked = null;
  if (!address) {
    body().replaceChildren(el("p", { text: "Enter a path or an address first; its topics are listed here." }));
    return;
  }
  asked = address;
  body().replaceChildren(el("p", { text: "Reading the source …" }));
  try {
    const found = await post("/api/inside", { uri: address });
    if (uri() === address) show(address, found);
  } catch (error) {
    if (uri() === address) body().replaceChildren(el("p", { class: "error", text: error.message }));
  } finally {
    asked = "";
    if (uri() !== address) look();
  }
}

function show(address, { topics, mount, warnings }) {
  looked = { uri: address, mount };
  const notes = warnings.map((text) => el("p", { text }));
  if (!topics.length) {
    body().replaceChildren(...notes, el("p", { text: "This source has no topics to choose from." }));
    return;
  }
  body().replaceChildren(...notes, roles(topics), mounting(mount), table(topics));
}

function roles(topics) {
  const rows = Object.entries(ROLES).map(([role, title]) => {
    const fitting = topics.filter(({ fits, messages, seconds, read_as: as }) => (fits === role || (role === "pose" && fits === "odometry" && as === "")) && (messages !== 0 || seconds));
    if (!fitting.length) return [];
    const read = fitting.find(({ read_as: as }) => as === role);
    const list = el("select", { name: role, id: `inside-${role}` },
      el("option", { value: "", text: read ? `${read.name} (found)` : "none is used" }),
      ...fitting.filter((topic) => topic !== read).map((topic) => el("option", { value: topic.name, text: [topic.name, figures(topic)].filter(Boolean).join(", ") })));
    return [el("label", { for: `inside-${role}`, text: title }), list];
  });
  return el("div", { class: "inside-roles" }, ...rows.flat());
}

function mounting(mount) {
  const inputs = MOUNT.map(([name, unit], k) => {
    const input = el("input", { type: "number", step: k < 3 ? "0.01" : "0.1", min: k < 3 ? "-100" : "-360", max: k < 3 ? "100" : "360", name, placeholder: "from TF" });
    if (mount) input.value = String(mount[k]);
    return el("label", {}, `${name} ${unit}`, input);
  });
  return el("fieldset", { class: "inside-mount" }, el("legend", { text: "Pose of the LiDAR on the robot: x forward, y left, z up" }), ...inputs);
}

function table(topics) {
  const rows = topics.flatMap((topic) => [
    el("tr", {}, el("th", { scope: "rowgroup", colspan: "2" }, topic.name, el("span", { text: [topic.type.split("/").pop(), figures(topic)].filter(Boolean).join(", ") }))),
    ...[["use", use(topic)], ...(topic.details ?? [])].filter(([, text]) => text).map(([word, text]) => el("tr", { class: "inside-detail" }, el("td", { text: word }), el("td", { text }))),
  ]);
  return el("div", { class: "inside-topics" }, el("table", {}, el("tbody", {}, ...rows)));
}

const use = ({ read_as: as, why, why_not: whyNot }) => (as ? `used as ${as}${why || whyNot ? ` (${why || whyNot})` : ""}` : whyNot && `not used: ${whyNot}`);

export function startInside() {
  byId("source-inside").addEventListener("toggle", look);
  byId("source-uri").addEventListener("change", look);
  byId("source-uri").addEventListener("input", () => { // what is shown is of another source
    if (looked && looked.uri !== uri()) {
      looked = null;
      body().replaceChildren();
    }
  });
}
