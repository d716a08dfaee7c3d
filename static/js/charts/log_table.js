// The log of a run as a table and as rows of a CSV file: events with their times and durations, the newest first.

import { el } from "../core/dom.js";
import { clock, figure } from "../core/format.js";

const OLDEST = 946_684_800; // [s], the year 2000: clocks of simulated runs begin at 0

export const lasts = (event) => event.for_s !== undefined;
const dateOf = (seconds) => (seconds > OLDEST ? new Date(1000 * seconds) : null);
const byRobot = ({ t }, start) => (start > OLDEST ? dateOf(start + t) : null);
const byComputer = ({ noted_s: noted }, isLive) => (isLive ? dateOf(noted) : null); // of a recording nothing happens now
const duration = (event, unended) => (!lasts(event) ? "" : event.for_s === null ? unended : `${figure(event.for_s)} s`);
const timeCell = (date) => el("td", { class: "clock", text: date?.toLocaleTimeString("sv-SE") ?? "", title: date?.toLocaleString("sv-SE") ?? "" });

// `start` is the time of the first scan by the robot's clock [s since 1970], `timeOf` the content of the cell of a time, `unended`
// the duration of what has no end yet.
export function logTable(events, start, isLive, timeOf = clock, unended = "lasts") {
  const titles = [["run"], ...(isLive ? [["computer's clock", "clock"]] : []), ["robot's clock", "clock"], ["lasted", "lasted"], ["what"]];
  const rows = [...events].reverse().map((event) => el("tr", {},
    el("td", {}, timeOf(event.t)), ...(isLive ? [timeCell(byComputer(event, isLive))] : []), timeCell(byRobot(event, start)),
    el("td", { class: "figure lasted", text: duration(event, unended) }), el("td", { text: event.text })));
  return el("table", {}, el("thead", {}, el("tr", {}, ...titles.map(([text, name]) => el("th", { scope: "col", class: name ?? "", text })))), el("tbody", {}, ...rows));
}

// The day of the first event with a known time, "_2026-11-30" for a name of a file; "" without one.
export function dayOf(events, start, isLive) {
  const [date] = events.map((event) => byComputer(event, isLive) ?? byRobot(event, start)).filter(Boolean);
  return date ? `_${date.toLocaleDateString("sv-SE")}` : "";
}

export const logRows = (events, start, isLive) => [["time_s", "computer_clock", "robot_clock", "kind", "duration_s", "what"],
  ...events.map((event) => [event.t, byComputer(event, isLive)?.toISOString(), byRobot(event, start)?.toISOString(), event.kind, event.for_s, event.text])];
