// The log of a run: its events with their times and durations, the newest first.

import { byId, el, recall, remember } from "../core/dom.js";
import { fileName, saveCsv } from "../core/download.js";
import { capital, clock, figure } from "../core/format.js";
import { isDrive, state } from "../core/store.js";
import { titleOf } from "../open/run_title.js";
import { NAMES } from "../playback/event_marks.js";
import { timeLink } from "../playback/time_link.js";

const LASTING = "lasting", ALL = "all";
const OLDEST = 946_684_800; // [s], the year 2000: clocks of simulated runs begin at 0
let filter = recall("log") ?? LASTING;

const lasts = (event) => event.for_s !== undefined;
const fits = (event) => filter === ALL || (filter === LASTING ? lasts(event) : event.kind === filter);
const events = () => state.events.filter((event) => !event.before && fits(event));
const isLive = () => Boolean(state.status?.live);
const dateOf = (seconds) => (seconds > OLDEST ? new Date(1000 * seconds) : null);
const byRobot = ({ t }) => (state.eventsStart > OLDEST ? dateOf(state.eventsStart + t) : null);
const byComputer = ({ noted_s: noted }) => (isLive() ? dateOf(noted) : null); // of a recording nothing happens now
const duration = (event) => (!lasts(event) ? "" : event.for_s === null ? "lasts" : `${figure(event.for_s)} s`);
const timeCell = (date) => el("td", { class: "clock", text: date?.toLocaleTimeString("sv-SE") ?? "", title: date?.toLocaleString("sv-SE") ?? "" });

export function showLog() {
  const kinds = [...new Set(state.events.map(({ kind }) => kind))].sort();
  const box = byId("log"), key = JSON.stringify([filter, kinds, events(), state.eventsStart, isLive()]);
  if (box.dataset.shown === key) return;
  box.dataset.shown = key;
  const isFocused = document.activeElement?.id === "log-kind";
  const choice = el("select", { id: "log-kind", "aria-label": "Events of the log", onchange: () => { filter = choice.value; remember("log", filter); showLog(); } },
    el("option", { value: LASTING, text: "Obstacles, silences, recordings, weak and lost poses" }), el("option", { value: ALL, text: "All events" }),
    ...kinds.map((kind) => el("option", { value: kind, text: capital(NAMES[kind] ?? kind) })));
  if (![...choice.options].some(({ value }) => value === filter)) filter = LASTING; // a kind of another run
  choice.value = filter;
  const canSeek = isDrive() && !isLive();
  const titles = [["run"], ...(isLive() ? [["computer's clock", "clock"]] : []), ["robot's clock", "clock"], ["lasted", "lasted"], ["what"]];
  const rows = events().reverse().map((event) => el("tr", {},
    el("td", {}, canSeek ? timeLink(event.t) : clock(event.t)), ...(isLive() ? [timeCell(byComputer(event))] : []), timeCell(byRobot(event)),
    el("td", { class: "figure lasted", text: duration(event) }), el("td", { text: event.text })));
  box.replaceChildren(choice, rows.length
    ? el("table", {}, el("thead", {}, el("tr", {}, ...titles.map(([text, name]) => el("th", { scope: "col", class: name ?? "", text })))), el("tbody", {}, ...rows))
    : el("p", { class: "empty", text: filter === LASTING ? "No obstacle ahead, no silence, and the pose was good." : "No such event." }));
  if (isFocused) choice.focus();
}

export function saveLog() {
  const listed = events(), [date] = state.events.map((event) => byComputer(event) ?? byRobot(event)).filter(Boolean);
  const day = date ? `_${date.toLocaleDateString("sv-SE")}` : "";
  saveCsv(fileName(titleOf(state.status?.source), `log${day}.csv`), [["time_s", "computer_clock", "robot_clock", "kind", "duration_s", "what"],
    ...listed.map((event) => [event.t, byComputer(event)?.toISOString(), byRobot(event)?.toISOString(), event.kind, event.for_s, event.text])]);
}
