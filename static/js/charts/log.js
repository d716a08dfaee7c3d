// The log of a run: its events with their times and durations, the newest first.

import { byId, el, recall, remember } from "../core/dom.js";
import { fileName, saveCsv } from "../core/download.js";
import { capital } from "../core/format.js";
import { isDrive, state } from "../core/store.js";
import { titleOf } from "../open/run_title.js";
import { NAMES } from "../playback/event_marks.js";
import { timeLink } from "../playback/time_link.js";
import { dayOf, lasts, logRows, logTable } from "./log_table.js";

const LASTING = "lasting", ALL = "all";
let filter = recall("log") ?? LASTING;

const fits = (event) => filter === ALL || (filter === LASTING ? lasts(event) : event.kind === filter);
const events = () => state.events.filter((event) => !event.before && fits(event));
const isLive = () => Boolean(state.status?.live);

export function showLog() {
  const kinds = [...new Set(state.events.map(({ kind }) => kind))].sort();
  const hasEnded = state.status?.state === "finished";
  const box = byId("log"), key = JSON.stringify([filter, kinds, events(), state.eventsStart, isLive(), hasEnded, Boolean(state.map)]);
  if (box.dataset.shown === key) return;
  box.dataset.shown = key;
  const isFocused = document.activeElement?.id === "log-kind";
  const choice = el("select", { id: "log-kind", "aria-label": "Events of the log", onchange: () => { filter = choice.value; remember("log", filter); showLog(); } },
    el("option", { value: LASTING, text: "Obstacles, gaps, recordings, weak and lost poses" }), el("option", { value: ALL, text: "All events" }),
    ...kinds.map((kind) => el("option", { value: kind, text: capital(NAMES[kind] ?? kind) })));
  if (![...choice.options].some(({ value }) => value === filter)) filter = LASTING; // a kind of another run
  choice.value = filter;
  const canSeek = isDrive() && !isLive();
  const listed = events();
  box.replaceChildren(choice, listed.length
    ? logTable(listed, state.eventsStart, isLive(), canSeek ? timeLink : undefined, hasEnded ? "until the end" : undefined)
    : el("p", { class: "empty", text: !state.map ? "Nothing is mapped yet." : filter === LASTING ? "No obstacle ahead, no silence, and the pose was good." : "No such event." }));
  if (isFocused) choice.focus();
}

export function saveLog() {
  const day = dayOf(state.events, state.eventsStart, isLive());
  saveCsv(fileName(titleOf(state.status?.source), `log${day}.csv`), logRows(events(), state.eventsStart, isLive()));
}
