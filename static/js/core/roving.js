// One tab stop for a group of elements: the arrow keys, Home and End move the focus inside the group (ARIA pattern).

const STEPS = { horizontal: { ArrowLeft: -1, ArrowRight: 1 }, vertical: { ArrowUp: -1, ArrowDown: 1 } };

// Returns a function that is to be called after the elements changed.
export function roving(group, selector, direction) {
  const items = () => [...group.querySelectorAll(selector)];
  const stopAt = (item) => items().forEach((each) => { each.tabIndex = each === item ? 0 : -1; });
  group.addEventListener("focusin", (event) => {
    const item = event.target.closest(selector);
    if (item) stopAt(item);
  });
  group.addEventListener("keydown", (event) => {
    const all = items(), place = all.indexOf(event.target);
    if (place < 0 || event.shiftKey || event.ctrlKey || event.altKey || event.metaKey) return;
    const step = STEPS[direction][event.key];
    const next = step ? all[place + step] : { Home: all[0], End: all.at(-1) }[event.key];
    if (step || next) {
      event.preventDefault();
      event.stopPropagation(); // the arrows would also step the run
    }
    next?.focus();
    next?.scrollIntoView({ block: "nearest" });
  });
  return () => {
    const all = items();
    if (all.length && !all.some((item) => item.tabIndex === 0)) all[0].tabIndex = 0;
  };
}
