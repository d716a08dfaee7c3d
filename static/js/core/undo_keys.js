// The keys of undo and redo.

// Ctrl+Z, Ctrl+Shift+Z and Ctrl+Y. Returns whether the key was one of them.
export function historyKey(event, { undo, redo }) {
  if (!(event.ctrlKey || event.metaKey) || event.altKey) return false;
  const key = event.key.toLowerCase();
  if (key === "y" || (key === "z" && event.shiftKey)) redo();
  else if (key === "z") undo();
  else return false;
  return true;
}
