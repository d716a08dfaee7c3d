// The numbers of trees on the map: each where it covers no other number and no symbol, or not at all; zooming brings it back.

const CELL = 32; // pixels; a box is looked for in the cells that it touches
const GAP = 2;
const SMALL = 11, LARGE = 13; // of letters; the selected tree's are larger

// Boxes [left, top, right, bottom] in pixels, found by where they are.
class Boxes {
  cells = new Map();

  *keys([left, top, right, bottom]) {
    for (let x = Math.floor(left / CELL); x <= Math.floor(right / CELL); x += 1) {
      for (let y = Math.floor(top / CELL); y <= Math.floor(bottom / CELL); y += 1) yield x * 65536 + y;
    }
  }

  add(box) {
    for (const key of this.keys(box)) {
      if (!this.cells.has(key)) this.cells.set(key, []);
      this.cells.get(key).push(box);
    }
  }

  isFree([left, top, right, bottom]) {
    for (const key of this.keys([left, top, right, bottom])) {
      for (const other of this.cells.get(key) ?? []) if (left < other[2] && right > other[0] && top < other[3] && bottom > other[1]) return false;
    }
    return true;
  }
}

// Right of the symbol first, as people read; then left, above, below.
function placesOf(x, y, radius, width, height) {
  const reach = radius + GAP + 1;
  return [[x + reach, y - height / 2], [x - reach - width, y - height / 2], [x - width / 2, y - reach - height], [x - width / 2, y + reach]];
}

// The selected tree comes first, then those that `first` names (of which a person said something), then what was seen most often.
export function drawNumbers(pen, view, trees, selected, colours, { radiusOf, first = new Set(), words = ({ number }) => String(number), robot = null }) {
  const taken = new Boxes();
  const seen = [];
  for (const tree of trees) {
    const [x, y] = view.toScreen(tree.x, tree.y);
    if (x < -40 || y < -40 || x > view.width + 40 || y > view.height + 40) continue;
    const radius = radiusOf(tree, view.scale);
    seen.push({ tree, x, y, radius });
    taken.add([x - radius, y - radius, x + radius, y + radius]);
  }
  if (robot) taken.add([robot[0] - 9, robot[1] - 9, robot[0] + 9, robot[1] + 9]);
  const rank = ({ number }) => (number === selected ? 0 : first.has(number) ? 1 : 2);
  seen.sort((a, b) => rank(a.tree) - rank(b.tree) || (b.tree.observations ?? 0) - (a.tree.observations ?? 0) || a.tree.number - b.tree.number);
  Object.assign(pen, { fillStyle: colours.text, strokeStyle: colours.surface, lineWidth: 3, textAlign: "left", lineJoin: "round" });
  for (const { tree, x, y, radius } of seen) {
    const chosen = tree.number === selected;
    const size = chosen ? LARGE : SMALL;
    pen.font = `${chosen ? "bold " : ""}${size}px ${colours.font}`;
    const text = words(tree);
    const [width, height] = [pen.measureText(text).width, size];
    const places = placesOf(x, y, radius + (chosen ? 5 : 0), width, height);
    const free = places.find(([left, top]) => taken.isFree([left, top, left + width, top + height]));
    const at = free ?? (chosen ? places[0] : null); // what was chosen is named in any case
    if (!at) continue;
    taken.add([at[0] - GAP, at[1], at[0] + width + GAP, at[1] + height]);
    pen.strokeText(text, at[0], at[1] + 0.86 * height);
    pen.fillText(text, at[0], at[1] + 0.86 * height);
  }
}
