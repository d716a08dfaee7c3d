// Whether this browser may touch or only look. The server refuses in any case; here it is shown.

import { get } from "./api.js";
import { byId, el } from "./dom.js";

// What changes something for everybody, or gives the server work; of panels the contents, so that they can be scrolled.
const TOUCHED = [".transport .buttons", ".transport .line", "#loop", ".transport .speed", "#layers-button", "#layer-list", "#follow", "#look-top", "#look-behind", "#source-button", "#notice-open"];
const PANELS = ["panel-annotate", "panel-tune"];

export let access = { role: "owner", viewer_link: null, robots: null };
export const looksOnly = () => access.role === "viewer";
// An action that changes something: who may only look finds no such entry, and no key does it.
export const edits = (run) => Object.assign((...given) => (looksOnly() ? undefined : run(...given)), { edits: true });
export const mayDo = (run) => !(run.edits && looksOnly());

function stillContents(panel) {
  const still = () => { for (const node of panel.children) node.inert = true; };
  new MutationObserver(still).observe(panel, { childList: true });
  still();
}

export async function startAccess() {
  try {
    access = await get("/api/access");
  } catch {
    return; // not connected; what may not be done is refused anyway
  }
  if (access.robots) {
    const title = "The page of all robots: a card each, and one map";
    document.querySelector(".strip-end").prepend(el("a", { id: "robots-link", class: "quiet small", href: access.robots, text: "All robots", title }));
  }
  if (!looksOnly()) return;
  document.body.classList.add("viewer");
  for (const selector of TOUCHED) for (const node of document.querySelectorAll(selector)) node.inert = true;
  for (const panel of PANELS.map(byId).filter(Boolean)) stillContents(panel);
  const end = document.querySelector(".strip-end");
  end.prepend(el("span", { id: "looks-only", class: "looks-only", text: "View only", title: "This link is for looking only. Ask who runs stemmap for the link that may change things" }));
  // The panel of sliders in the scene belongs to viser; a veil over it says that it cannot be moved.
  document.querySelector(".scene")?.append(el("div", { class: "veil", title: "View only: parameters cannot be changed" }));
  for (const id of ["welcome-open", "welcome-robot"]) if (byId(id)) byId(id).hidden = true;
}
