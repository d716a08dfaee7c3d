// A recording that is dropped on the page, or chosen: sent to the server with its progress, then opened.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { count } from "../core/format.js";

let sending = null; // the request that is under way
const size = (bytes) => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(2)} GB` : bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`);

// done(answer) is called with {uri, name, kind, bytes} once the recording lies on the server.
export function startUpload(done) {
  const file = el("input", { type: "file", id: "upload-file", hidden: true, "aria-label": "Recording to upload", onchange: () => {
    const [chosen] = file.files;
    if (chosen) send(chosen, done);
    file.value = "";
  } });
  // Into the dialog, where there is one: what stands outside cannot be reached while it is open.
  (byId("source-form") ?? document.body).append(file);
  byId("upload-choose").addEventListener("click", () => file.click());
  listenForDrops(done);
}

function listenForDrops(done) {
  const here = el("div", { class: "drop-here", text: "Drop the recording to upload it", hidden: true });
  document.body.append(here);
  let depth = 0; // of elements that were entered and not left
  const holdsFile = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files");
  addEventListener("dragenter", (event) => { if (holdsFile(event)) { depth += 1; here.hidden = Boolean(document.body.classList.contains("viewer")); } });
  addEventListener("dragleave", () => { depth = Math.max(0, depth - 1); here.hidden = depth === 0; });
  addEventListener("dragover", (event) => holdsFile(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    if (!holdsFile(event)) return;
    event.preventDefault();
    depth = 0;
    here.hidden = true;
    if (document.body.classList.contains("viewer")) return;
    const entries = [...event.dataTransfer.items].map((each) => each.webkitGetAsEntry?.());
    const files = [...event.dataTransfer.files];
    if (entries.some((entry) => entry?.isDirectory)) say("A folder cannot be uploaded: copy it to the machine where stemmap runs, and open it by its path.");
    else if (files.length > 1) say(`These are ${count(files.length, "file")}. Drop one recording at a time.`);
    else if (files.length) send(files[0], done);
  });
}

function box() {
  byId("upload")?.remove();
  const made = el("section", { id: "upload", class: "upload", "aria-label": "Upload" });
  // An open dialog lies above all else, so the box goes into it.
  (document.querySelector("dialog[open]") ?? document.body).append(made);
  return made;
}

function say(text, error = true) {
  const made = box();
  made.append(el("p", { class: error ? "error" : "", role: error ? "alert" : "status", text }),
    el("div", { class: "row end" }, el("button", { type: "button", class: "small", text: "Close", onclick: () => made.remove() })));
}

async function send(file, done) {
  if (sending) return say("An upload is under way. Wait until it is done, or cancel it.");
  try {
    const { room } = await get("/api/uploads");
    if (file.size > room) return say(`${file.name} has ${size(file.size)}; the server takes ${size(room)} now. Free some space there, or copy the recording to it and open it by its path.`);
  } catch (error) {
    return say(error.message);
  }
  const made = box();
  const bar = el("progress", { max: file.size, value: 0, "aria-label": "Progress of the upload" });
  const told = el("span", { class: "dim", text: "" });
  const request = new XMLHttpRequest();
  made.append(el("p", { text: `Uploading ${file.name}` }), bar, el("div", { class: "row" }, told,
    el("button", { type: "button", class: "small", text: "Cancel", onclick: () => request.abort() })));
  sending = request;
  request.upload.onprogress = ({ loaded }) => {
    bar.value = loaded;
    setText(told, loaded < file.size ? `${size(loaded)} of ${size(file.size)}` : "Looking what it is …");
  };
  request.onloadend = () => { sending = null; finish(request, file, made, done); };
  request.open("POST", `/api/uploads?name=${encodeURIComponent(file.name)}`);
  request.setRequestHeader("Content-Type", "application/octet-stream");
  request.send(file);
}

async function finish(request, file, made, done) {
  made.remove();
  if (request.status === 201) {
    const answer = JSON.parse(request.responseText);
    say(`${answer.name} was uploaded: ${answer.kind}.`, false);
    try {
      await done(answer);
    } catch (error) {
      say(error.message);
    }
  } else if (request.status) say(wording(request));
  else if (request.readyState === XMLHttpRequest.UNSENT) say(`The upload of ${file.name} was cancelled; nothing of it is kept.`, false);
  else say(`The connection was lost while ${file.name} was uploaded; nothing of it is kept. Try again.`);
}

function wording(request) {
  try {
    const { what, where, remedy } = JSON.parse(request.responseText).error;
    return `${what.charAt(0).toUpperCase()}${what.slice(1)}${where ? ` (${where})` : ""}. ${remedy ?? ""}`.trim();
  } catch {
    return `The server answered ${request.status}.`;
  }
}
