// Opening another run ends that of a robot and its recording, which nothing brings back: the first press asks, a second one opens.

import { get } from "../core/api.js";
import { byId, el, remember } from "../core/dom.js";
import { atSecondPress } from "../core/second_press.js";
import { state } from "../core/store.js";

const DOUBT = 20_000; // [ms] to read the question, which may come after an upload or with a link

// A live run that has scans in its map or its recording.
const isLost = ({ live, state: phase, scan_index: scan, recorded_file: file }) => live && phase !== "finished" && (scan >= 0 || Boolean(file));

// Resolves once another run may be opened: at once, or after a second press. A question without an answer does not resolve. Before the
// question, `checked` finds out whether that run can be opened at all; its errors pass through.
export async function confirmLeaving(checked) {
  const status = state.status ?? await get("/api/status");
  if (!isLost(status)) return;
  await checked();
  const recorded = status.recording.startsWith("recording") ? status.recorded_file : "";
  await new Promise((resolve) => {
    const line = el("p", { id: "leaving", role: "alert" }, el("span", { text: `The robot's ${recorded ? "run and its recording end" : "run ends"}. Open anyway?` }),
      el("button", { type: "button", class: "small", text: "Open anyway", title: recorded && `The recording ${recorded} is completed`, onclick: () => press() }));
    const press = atSecondPress((asks) => (asks ? put(line) : line.remove()), () => {
      remember("left", recorded, "sessionStorage"); // the page names it once it is complete
      resolve();
    }, DOUBT);
    press();
  });
}

export const forgetQuestion = () => byId("leaving")?.remove();

// The question stands where the person acts: in the open dialog or beside the chosen run, else over the page, as for a link.
function put(line) {
  forgetQuestion();
  const place = document.querySelector("dialog[open] #source-waits, .run-head");
  line.className = place ? "row leaving" : "toast problem";
  if (place) place.after(line);
  else document.body.append(line);
  line.scrollIntoView({ block: "nearest" });
}
