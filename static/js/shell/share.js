// Links to share: a view-only link, and one that restores the run, the time and the camera.

import { check, command, open } from "../core/api.js";
import { byId, el, setText } from "../core/dom.js";
import { clock, count } from "../core/format.js";
import { access, endViewerLink, looksOnly, refreshAccess, startAccess } from "../core/permissions.js";
import { attempted, showProblem } from "../core/problem.js";
import { on, state } from "../core/store.js";
import { confirmLeaving } from "../open/leaving.js";
import { controlOf, sentOf } from "../scene/viser_client.js";

const PATIENCE = 120_000; // [ms] for a run to open
const frame = byId("scene");
const controls = () => controlOf(frame.contentWindow);
const rounded = (values) => values.map((value) => value.toFixed(2)).join(",");

function camera() {
  const control = controls();
  if (!control) return null;
  const from = control.getPosition(control.camera.position.clone()), to = control.getTarget(from.clone());
  return rounded([...from.toArray(), ...to.toArray()]);
}

// Rounded up: otherwise the seek would end at the previous scan.
const seconds = () => (Math.ceil(1000 * (state.status?.time_s ?? 0)) / 1000).toFixed(3);

// The link carries the whole source request (topics, mounting, seed, odometry, parameters): otherwise another run would open.
function hereLink() {
  const { uri, ...options } = state.source ?? { uri: state.status?.source ?? "" };
  const query = new URLSearchParams({ run: uri, t: seconds() });
  if (Object.keys(options).length) query.set("options", JSON.stringify(options));
  const seen = camera();
  if (seen) query.set("camera", seen);
  return `${location.origin}/?${query}`;
}

function optionsOf(text) {
  try {
    return JSON.parse(text ?? "{}") ?? {};
  } catch {
    throw new Error("The options in this link are damaged. Ask for the link again, or open the run by its address.");
  }
}

const isOpen = ({ uri, ...options }) => state.status?.source === uri
  && Object.entries(options).every(([name, value]) => JSON.stringify(state.source?.[name]) === JSON.stringify(value));

function row(id, label, hint, value, ...more) {
  const box = el("input", { id, type: "text", readonly: true, value, onfocus: () => box.select() });
  const copy = el("button", { type: "button", text: "Copy", "aria-label": `Copy: ${label}`, onclick: async () => {
    box.select();
    try {
      await navigator.clipboard.writeText(box.value);
      setText(copy, "Copied");
    } catch {
      setText(copy, "Press Ctrl+C"); // without HTTPS the clipboard is not accessible
    }
  } });
  return el("div", {}, el("label", { for: id, text: label }), el("div", { class: "row" }, box, copy, ...more), el("p", { class: "dim", text: hint }));
}

const VIEWERS_EVERY = 3000; // [ms] between two counts of the pages of viewers
const LOOPBACK = ["localhost", "127.0.0.1", "[::1]"];

function reach() {
  return LOOPBACK.includes(location.hostname) ? [el("p", { class: "note", text: "The links work on this computer only. Start stemmap with --host to open the dashboard to other computers." })] : [];
}

const viewerLink = () => `${location.origin}${access.viewer_link}`;
const viewers = () => (access.viewers ? `${count(access.viewers, "page")} ${access.viewers === 1 ? "is" : "are"} open with this link.` : "No page is open with this link.");

function viewOnly() {
  const note = el("p", { id: "share-viewers", role: "status", text: viewers() });
  const timer = setInterval(() => {
    if (!byId("share-dialog").open || !note.isConnected) clearInterval(timer);
    else refreshAccess().then(() => note.dataset.ended || setText(note, viewers()), () => {});
  }, VIEWERS_EVERY);
  const end = el("button", { id: "share-end", type: "button", text: "End this link", title: "The link and all pages that were opened with it lose access at once. A new view-only link replaces it. Your access does not change.",
    onclick: () => attempted(async () => {
      await endViewerLink();
      byId("share-viewer").value = viewerLink();
      note.dataset.ended = "true";
      setText(note, "The previous link has ended. The new view-only link is shown above.");
    }) });
  return [row("share-viewer", "View-only link", "It shows everything and changes nothing. In one browser the last opened link applies: try it in another browser or a private window.", viewerLink(), end), note];
}

async function show() {
  await attempted(refreshAccess); // the link may have been ended in another page
  const dialog = byId("share-dialog");
  dialog.replaceChildren(el("h2", { id: "share-title", text: "Share" }),
    row("share-here", "This run at this time with this camera", `${state.status?.source ?? ""} at ${clock(state.status?.time_s)}. Opening it needs access to this dashboard.`, hereLink()),
    ...(access.viewer_link ? viewOnly() : []),
    ...reach(),
    el("form", { method: "dialog", class: "row end" }, el("button", { text: "Close" })));
  if (!dialog.open) dialog.showModal();
}

export async function showShareAtEnd() {
  await show();
  byId("share-end")?.focus();
}

// Follows the link in the address once and removes it from the address, so that a reload stays at the run.
async function follow() {
  const asked = new URLSearchParams(location.search);
  if (!asked.has("run") && !asked.has("camera")) return;
  const [run, options, time, seen] = [asked.get("run"), asked.get("options"), Number(asked.get("t")), asked.get("camera")];
  for (const name of ["run", "options", "t", "camera"]) asked.delete(name);
  history.replaceState(null, "", `${location.pathname}${asked.size ? `?${asked}` : ""}`);
  if (seen) lookFrom(seen.split(",").map(Number));
  if (!run || looksOnly()) return;
  try {
    const source = { uri: run, ...optionsOf(options) };
    if (!isOpen(source)) {
      await confirmLeaving(() => check(source));
      await open(source);
    }
    if (!await until(() => state.status?.source === run && state.status.scan_index >= 0)) return;
    if (!Number.isFinite(time)) return;
    await command("pause");
    await command("seek", { time_s: Math.max(0, time) });
  } catch (error) {
    showProblem(error);
  }
}

async function lookFrom(values) {
  if (values.length !== 6 || !values.every(Number.isFinite)) return;
  // The scene sets its initial camera some frames after its start, so the camera of the link must have held for a while.
  for (let stood = 0; stood < 4;) {
    await new Promise((resolve) => setTimeout(resolve, 300));
    const standing = sentOf(frame.contentWindow, "/world/robot/scan/raw") ? camera() : null;
    if (standing === null) continue;
    stood = standing === rounded(values) ? stood + 1 : 0;
    if (!stood) controls().setLookAt(...values, false);
  }
}

// Resolves to whether the condition came true within PATIENCE.
const until = (holds) => new Promise((resolve) => {
  const end = performance.now() + PATIENCE;
  const look = () => (holds() || performance.now() > end ? resolve(holds()) : setTimeout(look, 200));
  look();
});

export async function startShare() {
  byId("share-button").addEventListener("click", show);
  await startAccess();
  let begun = false;
  on("status", () => { if (!begun) { begun = true; follow(); } });
  if (state.status) { begun = true; follow(); }
}
