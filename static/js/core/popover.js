// Boxes that a button opens next to it. One is open at a time; its button, Escape, and a press elsewhere on the page close it.

let close = null; // function that closes the open box

// `opened` is called whenever the box opens.
export function startPopover(button, box, opened = () => {}) {
  const show = (wanted) => {
    if (wanted) close?.();
    close = wanted ? () => show(false) : null;
    box.hidden = !wanted;
    button.setAttribute("aria-expanded", String(wanted));
    if (wanted) opened();
  };
  button.addEventListener("click", () => show(box.hidden));
  document.addEventListener("pointerdown", ({ target }) => {
    if (!box.hidden && !box.contains(target) && !button.contains(target)) show(false);
  });
  document.addEventListener("keydown", (event) => {
    if (box.hidden || event.key !== "Escape") return;
    event.stopPropagation();
    show(false);
    button.focus();
  }, true);
}
