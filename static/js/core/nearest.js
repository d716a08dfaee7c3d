// Search for the nearest point.

export const distance = (a, b) => Math.hypot(a.x - b.x, a.y - b.y);

// The entry with the smallest gap, if that is below the limit; null otherwise.
export function nearest(entries, gapOf, limit) {
  let best = null, least = limit;
  for (const entry of entries) {
    const gap = gapOf(entry);
    if (gap < least) [best, least] = [entry, gap];
  }
  return best;
}
