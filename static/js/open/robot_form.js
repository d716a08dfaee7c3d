// The form of a live robot or sensor, which writes its address into the field of the dialog.

import { byId, el, recall, remember } from "../core/dom.js";

export const isLive = (address) => /^(zenoh|velodyne):/i.test(address);
// For each kind: title, fields [name, title, value without another one], and the address of their values.
const KINDS = {
  zenoh: {
    title: "ROS 2 robot through a Zenoh router",
    fields: [["host", "Address of the router", "127.0.0.1"], ["port", "Port", "7447"], ["robot", "Robot (its namespace)", "the first that sends scans"], ["domain", "ROS domain", "0"]],
    address: ({ host, port, robot, domain }) => `zenoh:tcp/${host || "127.0.0.1"}:${port || 7447}${options({ robot, domain })}`,
  },
  velodyne: {
    title: "Velodyne sensor by UDP",
    fields: [["from", "Address of the sensor", "192.168.1.201"], ["port", "Port on this machine", "2368"]],
    address: ({ from, port }) => `velodyne:0.0.0.0:${port || 2368}?from=${from || "192.168.1.201"}`,
  },
};

function options(values) {
  const given = Object.entries(values).filter(([, value]) => value);
  return given.length ? `?${given.map(([name, value]) => `${name}=${encodeURIComponent(value)}`).join("&")}` : "";
}

const uri = () => byId("source-uri").value.trim();
const kind = () => KINDS[byId("robot-kind").value];
const fields = () => byId("robot-fields");

// Whether the run of an address is recorded: {record: true}, or {} if it is not live.
export const recordingOf = (address) => (isLive(address) && byId("source-record").checked ? { record: true } : {});

export const rememberRobot = (address) => remember("robot", address);

// Shows the form with the address of a robot, or with the last one that was opened in this browser.
export function showRobot(address) {
  const last = isLive(address ?? "") ? address : recall("robot") ?? "";
  byId("source-robot").open = true;
  fill(last);
  write();
  if (last && uri() !== last) setUri(last); // it has parts that the form does not have
  settle();
  fields().querySelector("input").focus();
}

// Writes the parts of an address into the fields that have a place for them.
function fill(address) {
  const [, name, part, query = ""] = /^(zenoh|velodyne):([^?]*)(?:\?(.*))?$/i.exec(address) ?? [];
  if (!name) return;
  byId("robot-kind").value = name.toLowerCase();
  build();
  const [, host, port] = /^(?:tcp\/)?(.*):(\d+)$/.exec(part) ?? [];
  const values = { host, port, ...Object.fromEntries(new URLSearchParams(query)) };
  for (const input of fields().querySelectorAll("input")) input.value = values[input.name] ?? "";
}

function setUri(address) {
  byId("source-uri").value = address;
  byId("source-uri").dispatchEvent(new Event("input"));
}

// The address is complete: what is inside of it can be read.
const settle = () => byId("source-uri").dispatchEvent(new Event("change"));

function build() {
  fields().replaceChildren(...kind().fields.map(([name, title, placeholder]) =>
    el("label", {}, title, el("input", { name, type: "text", placeholder, autocomplete: "off", spellcheck: "false", oninput: write, onchange: settle }))));
}

function write() {
  const values = Object.fromEntries([...fields().querySelectorAll("input")].map(({ name, value }) => [name, value.trim()]));
  setUri(kind().address(values));
}

export function startRobotForm() {
  const choice = byId("robot-kind");
  choice.append(...Object.entries(KINDS).map(([value, { title }]) => el("option", { value, text: title })));
  choice.addEventListener("change", () => {
    build();
    write();
    settle();
  });
  build();
  byId("source-record").checked = true;
  const show = () => { byId("source-recorded").hidden = !isLive(uri()); };
  byId("source-uri").addEventListener("input", show);
  byId("source-robot").addEventListener("toggle", ({ target }) => {
    if (target.open && !uri()) {
      write();
      settle();
    }
    show();
  });
}
