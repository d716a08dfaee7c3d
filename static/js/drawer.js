// Where the window is narrow, map and figures are a drawer over the scene.

import { byId, recall, remember } from "./dom.js";

export function startDrawer() {
  const button = byId("drawer-button"), side = byId("side");
  const show = (open) => {
    side.classList.toggle("open", open);
    button.setAttribute("aria-expanded", String(open));
    remember("drawer", open ? "open" : "closed");
  };
  show(recall("drawer") === "open");
  button.addEventListener("click", () => show(!side.classList.contains("open")));
}
