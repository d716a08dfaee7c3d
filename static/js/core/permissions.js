// Whether this browser may change the run or only view it. The server enforces this; the page shows it.

import { get, remove } from "./api.js";
import { byId, el } from "./dom.js";
import { showProblem } from "./problem.js";

// Controls that change something for everybody or give the server work. Of the panels only the contents, so that they scroll.
const CONTROLS = [".transport .buttons", ".transport .line", "#loop", ".transport .speed", "#layers-button", "#layer-list", "#follow", "#look-top", "#look-behind", "#source-button", "#notice-open", "[data-edits]"];
const PANELS = ["panel-annotate", "panel-tune"];

export let access = { role: "owner", viewer_link: null, viewers: null };
export const looksOnly = () => access.role === "viewer";
// Marks an action that changes something: in a view-only page it is not listed and its key does nothing.
export const edits = (run) => Object.assign((...args) => (looksOnly() ? undefined : run(...args)), { edits: true });
export const mayDo = (run) => !(run.edits && looksOnly());

export async function refreshAccess() {
  access = await get("/api/access");
}

// Ends the view-only link for everybody who has it; `access` then has the new link.
export async function endViewerLink() {
  access = await remove("/api/access/viewer-link");
}

// For a page that the server refuses.
export const refusedText = () => looksOnly()
  ? "This view-only link is no longer valid. Ask the owner of this dashboard for a new link."
  : "The server does not accept this page any more: it was started again with a new link, or the session is older than a week. Open the link that stemmap printed in the terminal.";

function disableContents(panel) {
  const disable = () => { for (const node of panel.children) node.inert = true; };
  new MutationObserver(disable).observe(panel, { childList: true });
  disable();
}

export async function startAccess() {
  try {
    await refreshAccess();
  } catch (error) {
    showProblem(`It is not known whether this page may change the run: ${error.message}`);
    return;
  }
  if (!looksOnly()) return;
  document.body.classList.add("viewer");
  for (const selector of CONTROLS) for (const node of document.querySelectorAll(selector)) node.inert = true;
  for (const panel of PANELS.map(byId).filter(Boolean)) disableContents(panel);
  const end = document.querySelector(".strip-end");
  end.prepend(el("span", { id: "looks-only", class: "looks-only", text: "View only", title: "This is a view-only link. Ask the owner of this dashboard for a link with write access" }));
  // The panel of sliders in the scene belongs to viser; a veil over it shows that it is disabled.
  document.querySelector(".scene")?.append(el("div", { class: "veil", title: "View only: parameters cannot be changed" }));
  for (const id of ["welcome-open", "welcome-robot", "welcome-sliders"]) if (byId(id)) byId(id).hidden = true;
}
