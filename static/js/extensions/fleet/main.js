// The way from a dashboard of a fleet to the page of all robots.

import { get } from "../../core/api.js";
import { byId, el } from "../../core/dom.js";
import { extend } from "../../shell/extensions.js";

const TITLE = "All robots: one card each, and one common map";

async function start() {
  const { page } = await get("/api/fleet");
  if (page) document.querySelector(".strip-end").prepend(el("a", { id: "robots-link", class: "quiet small", href: page, text: "All robots", title: TITLE }));
}

const presentActions = () => (byId("robots-link") ? [[TITLE, "", () => byId("robots-link").click()]] : []);

extend(import.meta.url, { start, presentActions });
