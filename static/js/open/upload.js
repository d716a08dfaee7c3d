// Uploads a recording that is dropped on the page or chosen, shows the progress, then opens it.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital, count } from "../core/format.js";

const SHOWN_FOR = 8000; // [ms] of a message that is no error
let sending = null; // request in progress
const size = (bytes) => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(2)} GB` : bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`);

// done(answer) is called with {uri, name, kind, bytes} after the upload.
export function startUpload(done) {
  const file = el("input", { type: "file", id: "upload-file", hidden: true, "aria-label": "Recording to upload", onchange: () => {
    const [chosen] = file.files;
    if (chosen) send(chosen, done);
    file.value = "";
  } });
  // Inside the dialog if there is one: nothing outside of an open dialog can be used.
  (byId("source-form") ?? document.body).append(file);
  byId("upload-choose").addEventListener("click", () => file.click());
  listenForDrops(done);
}

function listenForDrops(done) {
  const here = el("div", { class: "drop-here", text: "Drop the recording to upload it", hidden: true });
  document.body.append(here);
  let depth = 0; // elements entered and not left by the dragged file
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
    if (entries.some((entry) => entry?.isDirectory)) say("A folder cannot be uploaded. Copy it to the machine where stemmap runs and open it by its path.");
    else if (files.length > 1) say(`${count(files.length, "file")} were dropped. Drop one recording at a time.`);
    else if (files.length) send(files[0], done);
  });
}

function box() {
  byId("upload")?.remove();
  const made = el("section", { id: "upload", class: "upload", "aria-label": "Upload" });
  // An open dialog covers everything outside of it.
  (document.querySelector("dialog[open]") ?? document.body).append(made);
  return made;
}

function say(text, error = true) {
  const made = box();
  made.append(el("p", { class: error ? "error" : "", role: error ? "alert" : "status", text }),
    el("div", { class: "row end" }, el("button", { type: "button", class: "small", text: "Close", onclick: () => made.remove() })));
  if (!error) setTimeout(() => made.remove(), SHOWN_FOR);
}

async function send(file, done) {
  if (sending) return say("Another upload is in progress. Wait until it ends, or cancel it.");
  try {
    const { room } = await get("/api/uploads");
    if (file.size > room) return say(`${file.name} is too large: ${size(file.size)}, and the server has room for ${size(room)}. Free some space there, or copy the recording to the server and open it by its path.`);
  } catch (error) {
    return say(error.message);
  }
  const made = box();
  const bar = el("progress", { max: file.size, value: 0, "aria-label": "Progress of the upload" });
  const note = el("span", { class: "dim", text: "" });
  const request = new XMLHttpRequest();
  made.append(el("p", { text: `Uploading ${file.name}` }), bar, el("div", { class: "row" }, note,
    el("button", { type: "button", class: "small", text: "Cancel", onclick: () => request.abort() })));
  sending = request;
  request.upload.onprogress = ({ loaded }) => {
    bar.value = loaded;
    setText(note, loaded < file.size ? `${size(loaded)} of ${size(file.size)}` : "Detecting the format …");
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
    say(`${answer.name} was uploaded (${answer.kind}).`, false);
    try {
      await done(answer);
    } catch (error) {
      say(error.message);
    }
  } else if (request.status) say(wording(request));
  else if (request.readyState === XMLHttpRequest.UNSENT) say(`The upload of ${file.name} was cancelled.`, false);
  else say(`The connection was lost during the upload of ${file.name}. Try again.`);
}

function wording(request) {
  try {
    const { what, where, remedy } = JSON.parse(request.responseText).error;
    return `${capital(what)}${where ? ` (${where})` : ""}. ${remedy ?? ""}`.trim();
  } catch {
    return `The server answered with status ${request.status}. Try again, or see its log.`;
  }
}
