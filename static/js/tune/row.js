// The row of a parameter: slider, text box, and reset to the preset.

import { el, setText } from "../core/dom.js";
import { changed } from "../core/store.js";
import { isChanged, isMoving, newGesture, redo, reset, setValue, shown, tuning, undo, valueOf } from "./parameters.js";
import { beginDrag, FINE, fromPlace, pressed, toPlace } from "./slider.js";

const THUMB = 16; // [px] width of the thumb

// `further` are nodes next to the name. Returns {node, show}; `show` updates it to the values of the server.
export function rowOf(spec, ...further) {
  const id = `tune-${spec.name}`;
  const back = el("button", { class: "quiet icon back", "aria-label": `Reset ${spec.title}`, text: "↺", onclick: () => reset([spec.name]) });
  const label = el("label", { for: id, title: `${spec.doc} (${spec.name})` }, el("i", { class: "mark-changed", "aria-hidden": "true", text: "●" }), spec.title,
    spec.unit ? el("small", { text: ` ${spec.unit}` }) : "");
  const [inputs, fill] = spec.kind === "bool" ? box(spec, id) : spec.kind === "choice" ? list(spec, id) : spec.kind === "name" ? word(spec, id) : number(spec, id);
  const refused = el("p", { id: `${id}-refused`, class: "error", role: "alert", hidden: true });
  const node = el("div", { class: "tune-row", "data-parameter": spec.name, "data-words": `${spec.name} ${spec.title} ${spec.doc} ${spec.stage}`.toLowerCase() },
    el("span", { class: "tune-name" }, label, ...further), ...inputs, back, refused);
  let known = null;
  const show = (wanted) => {
    const different = isChanged(spec.name);
    node.classList.toggle("changed", different);
    back.hidden = !different;
    back.title = `Back to ${shown(wanted, spec)}, the value of the preset`;
    if (isMoving(spec.name)) return;
    if (valueOf(spec.name) !== known) tuning.refused[spec.name] = ""; // another value came after the refused one
    known = valueOf(spec.name);
    setText(refused, tuning.refused[spec.name]);
    refused.hidden = !tuning.refused[spec.name];
    fill(known);
  };
  return { node, show };
}

function box(spec, id) {
  const input = el("input", { id, type: "checkbox", onchange: () => setValue(spec.name, input.checked) });
  return [[el("span", { class: "wide" }, input)], (value) => { input.checked = value; }];
}

function list(spec, id) {
  const input = el("select", { id, class: "wide", onchange: () => setValue(spec.name, input.value) },
    ...spec.choices.map((value) => el("option", { value, text: value })));
  return [[input], (value) => { input.value = value; }];
}

function word(spec, id) {
  const input = el("input", { id, class: "wide", type: "text", maxlength: "60", autocomplete: "off", spellcheck: "false", onchange: () => setValue(spec.name, input.value.trim()) });
  return [[input], (value) => { if (document.activeElement !== input) input.value = value; }];
}

function number(spec, id) {
  const typed = el("input", { id, type: "text", inputmode: "decimal", autocomplete: "off", spellcheck: "false" });
  const slider = el("input", { type: "range", min: "0", max: String(FINE), step: "1", "aria-label": `${spec.title}, slider` });
  typed.setAttribute("aria-describedby", `${id}-refused`);
  let known = "";
  const refuse = (reason) => {
    tuning.refused[spec.name] = reason;
    changed("tuning");
  };
  const fill = (value) => {
    known = String(value);
    const isRefused = Boolean(tuning.refused[spec.name]);
    typed.setAttribute("aria-invalid", String(isRefused));
    const isTyping = document.activeElement === typed && typed.classList.contains("dirty");
    if (!isTyping && !isRefused) typed.value = known; // what was typed and refused remains
    slider.value = String(toPlace(spec, value));
    slider.setAttribute("aria-valuetext", shown(value, spec));
  };
  const send = (value, gesture = "") => {
    typed.value = String(value);
    slider.value = String(toPlace(spec, value));
    setValue(spec.name, value, gesture);
  };
  slider.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    event.preventDefault();
    slider.focus();
    const { left, width } = slider.getBoundingClientRect(), gesture = newGesture();
    const track = [left + THUMB / 2, left + width - THUMB / 2];
    const thumb = track[0] + (track[1] - track[0]) * toPlace(spec, valueOf(spec.name)) / FINE;
    beginDrag(event, spec, valueOf(spec.name), { thumb, track, valueAt: (part) => fromPlace(spec, FINE * part) }, (value) => send(value, gesture));
  });
  slider.addEventListener("input", () => send(fromPlace(spec, Number(slider.value)))); // of assistive technology
  slider.addEventListener("keydown", (event) => {
    const value = pressed(spec, Number(tuning.refused[spec.name] ? known : typed.value), event);
    if (value === null) return;
    event.preventDefault(); // by the step of the parameter, not of the slider
    send(value);
  });
  const take = async () => {
    if (!typed.classList.replace("dirty", "clean")) return;
    typed.classList.remove("clean");
    const text = typed.value.trim().replace(",", ".");
    const value = Number(text);
    if (text === "" || !Number.isFinite(value)) refuse(`“${typed.value.trim().slice(0, 30)}” is not a number.`);
    else if (text === known) refuse("");
    else await setValue(spec.name, value);
  };
  typed.addEventListener("input", () => typed.classList.add("dirty"));
  typed.addEventListener("change", take);
  typed.addEventListener("keydown", (event) => {
    if (event.key === "Enter") take();
    else if (event.key === "Escape") {
      typed.classList.remove("dirty");
      refuse("");
    } else if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && !typed.classList.contains("dirty")) {
      event.preventDefault(); // no typed text to undo, so the parameter change is undone
      if (event.shiftKey) redo();
      else undo();
    }
  });
  return [[slider, typed], fill];
}
