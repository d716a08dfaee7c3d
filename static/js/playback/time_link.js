// A time of the run as a button that goes there; a text for those who cannot.

import { command } from "../core/api.js";
import { el } from "../core/dom.js";
import { clock } from "../core/format.js";
import { looksOnly } from "../core/permissions.js";
import { attempted } from "../core/problem.js";
import { isDrive } from "../core/store.js";

export const timeLink = (time) => (looksOnly() || !isDrive() ? clock(time)
  : el("button", { class: "link", type: "button", "data-edit": true, text: clock(time), title: "Go to this scan", onclick: () => attempted(() => command("seek", { time_s: time })) }));
