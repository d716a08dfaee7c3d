"""Contrast of texts and marks of a page by WCAG 2.1, against what is really behind them."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page

# Each text that is seen: its own colour laid over the colours of what it stands on, up to the first that is
# opaque. Texts that are painted on a canvas are left out, and so is what is inactive (1.4.3).
_LOW = """([needed, large_needed]) => {
  const canvas = Object.assign(document.createElement("canvas"), { width: 1, height: 1 });
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  const parsed = new Map();
  const parse = (text) => {
    if (!parsed.has(text)) {
      pen.clearRect(0, 0, 1, 1);
      pen.fillStyle = text;
      pen.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
      parsed.set(text, [r, g, b, a / 255]);
    }
    return parsed.get(text);
  };
  const over = ([r, g, b, a], ground) => [r, g, b].map((c, k) => a * c + (1 - a) * ground[k]);
  const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const light = (c) => c.reduce((sum, v, k) => sum + linear(v / 255) * [0.2126, 0.7152, 0.0722][k], 0);
  const ratio = (a, b) => {
    const [x, y] = [light(a), light(b)].sort((m, n) => n - m);
    return (x + 0.05) / (y + 0.05);
  };
  const behind = (node) => {
    const layers = [];
    for (let at = node; at; at = at.parentElement) {
      layers.push(parse(getComputedStyle(at).backgroundColor));
      if (layers.at(-1)[3] === 1) break;
    }
    return layers.reverse().reduce((base, layer) => over(layer, base), [255, 255, 255]);
  };
  const faded = (node) => {
    let share = 1;
    for (let at = node; at; at = at.parentElement) share *= Number(getComputedStyle(at).opacity);
    return share;
  };
  const inactive = (node) => node.closest(":disabled, [inert], .old, [aria-disabled=true]");
  const low = new Set();
  let looked = 0;
  const seen = (node) => node.checkVisibility({ visibilityProperty: true, opacityProperty: true })
    && !inactive(node);
  const look = (node, text, colour, style) => {
    const ground = behind(node), [r, g, b, a] = parse(colour);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    const found = ratio(over([r, g, b, a * faded(node)], ground), ground);
    looked += 1;
    if (found >= (large ? large_needed : needed) - 0.005) return;
    const name = node.tagName.toLowerCase() + (node.id ? `#${node.id}` : "");
    low.add(`${found.toFixed(2)} ${name} “${text.trim().slice(0, 40)}”`);
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement, text = walker.currentNode.data;
    if (!text.trim() || !seen(node) || node.closest("script, style, noscript, option")) continue;
    const style = getComputedStyle(node);
    look(node, text, node.closest("svg") ? style.fill : style.color, style);
  }
  const fields = "input:not([type=range], [type=checkbox], [type=file]), select";
  for (const node of document.querySelectorAll(fields)) {
    if (!seen(node)) continue;
    const style = getComputedStyle(node, node.value || !node.placeholder ? null : "::placeholder");
    look(node, node.value || node.placeholder || "", style.color, style);
  }
  return { looked, low: [...low] };
}"""


def too_low(page: Page, needed: float = 4.5, large: float = 3.0) -> list[str]:
    """The texts that are seen now whose contrast is below `needed` (large texts: `large`), each with its
    ratio. 4.5 and 3 are level AA of WCAG, 7 and 4.5 are level AAA."""
    told: dict[str, Any] = page.evaluate(_LOW, [needed, large])
    assert told["looked"] > 10, "nothing was seen"
    low: list[str] = told["low"]
    return low
