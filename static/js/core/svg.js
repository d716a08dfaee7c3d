// Helpers for SVG pictures. Sizes are in units of the viewBox.

const SPACE = "http://www.w3.org/2000/svg";

export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS(SPACE, tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (value !== null && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children.filter(Boolean));
  return node;
}

export const picture = (width, height, label, ...children) =>
  svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label, class: "picture" }, ...children);

export const line = (x1, y1, x2, y2, cls) => svg("line", { x1, y1, x2, y2, class: cls });
export const text = (x, y, content, cls = "", anchor = "start") => svg("text", { x, y, class: cls, "text-anchor": anchor, text: content });
export const circle = (cx, cy, r, cls) => svg("circle", { cx, cy, r, class: cls });

// Angles counter-clockwise from the right, as in mathematics; y of the picture points down.
export function arc(cx, cy, r, from, to, cls) {
  const [a, b] = [[cx + r * Math.cos(from), cy - r * Math.sin(from)], [cx + r * Math.cos(to), cy - r * Math.sin(to)]];
  if (to - from >= 2 * Math.PI - 1e-3) return circle(cx, cy, r, cls);
  return svg("path", { d: `M${a} A${r} ${r} 0 ${to - from > Math.PI ? 1 : 0} 0 ${b}`, class: cls });
}

export const ellipse = (cx, cy, major, minor, angle, cls) =>
  svg("ellipse", { cx, cy, rx: Math.max(major, 0.4), ry: Math.max(minor, 0.4), transform: `rotate(${(-180 * angle) / Math.PI} ${cx} ${cy})`, class: cls });

// The largest of 1, 2 or 5 times a power of ten that is at most `reach` [m].
function roundLength(reach) {
  const power = 10 ** Math.floor(Math.log10(reach));
  return [1, 2, 5].map((k) => k * power).filter((length) => length <= reach).pop() ?? power;
}

export function scaleBar(x, y, reach, scale) {
  const length = roundLength(reach);
  const label = length >= 1 ? `${length} m` : length >= 0.01 ? `${Math.round(100 * length)} cm` : `${+(1000 * length).toPrecision(1)} mm`;
  return svg("g", {}, line(x, y, x + length * scale, y, "bar"), line(x, y - 3, x, y, "bar"),
    line(x + length * scale, y - 3, x + length * scale, y, "bar"), text(x, y - 6, label, "small"));
}
