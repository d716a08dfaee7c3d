// Helpers for the document. Text from outside only ever becomes textContent.

export const byId = (id) => document.getElementById(id);

export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (name === "class") node.className = value;
    else if (name === "style") Object.assign(node.style, value);
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children);
  return node;
}

// A small button; `kind` are its classes.
export const button = (id, text, title, onclick, kind = "small") => el("button", { id, type: "button", class: kind, text, title, onclick });

// The letter of a verdict on its colour.
export const letterOf = ([letter, meaning]) => el("span", { class: "letter", text: letter, style: { background: `var(--${meaning})` }, "aria-hidden": "true" });

// A list of titles with their values: [[title, value], ...].
export const definitions = (rows) => el("dl", { class: "list" }, ...rows.flatMap(([title, value]) => [el("dt", { text: title }), el("dd", { text: value })]));

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// In "localStorage" for the browser, in "sessionStorage" for this window.
export function remember(key, value, storage = "localStorage") {
  try {
    window[storage].setItem(`stemmap.${key}`, value);
  } catch { /* a private window stores nothing */ }
}

export function recall(key, storage = "localStorage") {
  try {
    return window[storage].getItem(`stemmap.${key}`);
  } catch {
    return null;
  }
}

// 32 hexadecimal digits.
export const randomId = () => [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
