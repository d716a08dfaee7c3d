// In which order what was found stands: the nearer to the name of a parameter, the earlier.

// 0: the name or the title begins with the text; 1: words of these begin with the words; 2: words of its meaning or stage
// do; 3: the words stand somewhere inside.
export function rankOf({ name, title, doc, stage }, words) {
  const text = words.join(" ");
  const own = [title, name, name.split(".").pop()].map((each) => each.toLowerCase());
  if (own.some((each) => each.startsWith(text))) return 0;
  if (allBegin(own.join(" "), words)) return 1;
  return allBegin(`${own.join(" ")} ${doc} ${stage}`.toLowerCase(), words) ? 2 : 3;
}

function allBegin(text, words) {
  const parts = text.split(/[^\p{L}\p{N}]+/u);
  return words.every((word) => text.startsWith(word) || parts.some((part) => part.startsWith(word)) || text.includes(` ${word}`));
}

// Puts nodes into the order of their ranks, and only where they do not stand so already: what is open or scrolled stays.
export function arrange(parent, entries) {
  const order = entries.map((entry, place) => ({ ...entry, place })).sort((a, b) => a.rank - b.rank || a.place - b.place);
  const now = entries.map(({ node }) => node).sort((a, b) => (a.compareDocumentPosition(b) & Node.DOCUMENT_POSITION_FOLLOWING ? -1 : 1));
  if (order.every(({ node }, k) => node === now[k])) return;
  for (const { node } of order) {
    const below = node.nextElementSibling?.matches(".sensitivity") ? [node.nextElementSibling] : [];
    parent.append(node, ...below);
  }
}
