// Uploads a recording that is dropped on the page or chosen, a file or the files of one recording, shows the progress, then opens it.

import { get } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { capital } from "../core/format.js";

const SHOWN_FOR = 8000; // [ms] of a message that is no error
let sending = null; // request in progress
const size = (bytes) => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(2)} GB` : bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`);

// done(answer) is called with {uri, name, kind, bytes} after the upload.
export function startUpload(done) {
  const file = el("input", { type: "file", id: "upload-file", hidden: true, multiple: true, "aria-label": "Recording to upload", onchange: () => {
    sendFiles([...file.files].map((each) => ({ path: each.name, file: each })), done);
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
    sendDropped(event.dataTransfer, done);
  });
}

// Entries must be taken before the first await, when the browser empties the transfer.
async function sendDropped({ items, files }, done) {
  const entries = [...items].map((each) => each.webkitGetAsEntry?.()).filter(Boolean);
  const dropped = [...files].map((each) => ({ path: each.name, file: each }));
  if (!entries.some((entry) => entry.isDirectory)) return sendFiles(dropped, done);
  try {
    const [only] = entries;
    if (entries.length > 1) sendFiles((await Promise.all(entries.map((entry) => filesIn(entry)))).flat(), done);
    else sendFiles((await filesIn(only)).map(({ path, file }) => ({ path: path.slice(only.name.length + 1), file })), done, only.name);
  } catch (error) {
    say(`The folder could not be read: ${error.message}`);
  }
}

const settled = (start) => new Promise(start);

// The files of an entry with their paths, without hidden ones. A reader returns at most 100 entries at a time, and none at its end.
async function filesIn(entry, folder = "") {
  if (entry.name.startsWith(".")) return [];
  const path = `${folder}${entry.name}`;
  if (entry.isFile) return [{ path, file: await settled((found, failed) => entry.file(found, failed)) }];
  const reader = entry.createReader();
  const all = [];
  let some;
  do {
    some = await settled((found, failed) => reader.readEntries(found, failed));
    all.push(...some);
  } while (some.length);
  return (await Promise.all(all.map((each) => filesIn(each, `${path}/`)))).flat();
}

// `name` is that of the folder; "" without one.
function sendFiles(files, done, name = "") {
  if (!name && files.length === 1) send(files[0].file, files[0].file.name, "", done);
  else if (files.length) {
    const list = `${JSON.stringify(files.map(({ path, file }) => [path, file.size]))}\n`;
    send(new Blob([list, ...files.map(({ file }) => file)]), name || `${files[0].path} and ${files.length - 1} more`, "&many=true", done);
  } else if (name) say(`The folder ${name} has no files.`);
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

async function send(body, name, query, done) {
  if (sending) return say("Another upload is in progress. Wait until it ends, or cancel it.");
  try {
    const { room } = await get("/api/uploads");
    if (body.size > room) return say(`${name} is too large: ${size(body.size)}, and the server has room for ${size(room)}. Free some space there, or copy the recording to the server and open it by its path.`);
  } catch (error) {
    return say(error.message);
  }
  const made = box();
  const bar = el("progress", { max: body.size, value: 0, "aria-label": "Progress of the upload" });
  const note = el("span", { class: "dim", text: "" });
  const request = new XMLHttpRequest();
  made.append(el("p", { text: `Uploading ${name}` }), bar, el("div", { class: "row" }, note,
    el("button", { type: "button", class: "small", text: "Cancel", onclick: () => request.abort() })));
  sending = request;
  request.upload.onprogress = ({ loaded }) => {
    bar.value = loaded;
    setText(note, loaded < body.size ? `${size(loaded)} of ${size(body.size)}` : "Detecting the format …");
  };
  request.onloadend = () => { sending = null; finish(request, name, made, done); };
  request.open("POST", `/api/uploads?name=${encodeURIComponent(name)}${query}`);
  request.setRequestHeader("Content-Type", "application/octet-stream");
  request.send(body);
}

async function finish(request, name, made, done) {
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
  else if (request.readyState === XMLHttpRequest.UNSENT) say(`The upload of ${name} was cancelled.`, false);
  else say(`The connection was lost during the upload of ${name}. Try again.`);
}

function wording(request) {
  try {
    const { what, where, remedy } = JSON.parse(request.responseText).error;
    return `${capital(what)}${where ? ` (${where})` : ""}. ${remedy ?? ""}`.trim();
  } catch {
    return `The server answered with status ${request.status}. Try again, or see its log.`;
  }
}
