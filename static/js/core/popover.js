// Boxes that a button opens next to it. One is open at a time; its button, Escape, and a press elsewhere on the page close it. A press
// in the 3D scene, which is a page of its own, does not: layers can be switched while somebody looks around.

let close = null; // function that closes the open box

// `opened` is called whenever the box opens. Returns a function that closes it.
export function startPopover(button, box, opened = () => {}) {
  const show = (wanted) => {
    if (wanted) close?.();
    close = wanted ? hide : null;
    box.hidden = !wanted;
    button.setAttribute("aria-expanded", String(wanted));
    if (wanted) opened();
  };
  const hide = () => { if (!box.hidden) show(false); };
  button.addEventListener("click", () => show(box.hidden));
  document.addEventListener("pointerdown", ({ target }) => {
    if (!box.hidden && !box.contains(target) && !button.contains(target)) show(false);
  });
  document.addEventListener("keydown", (event) => {
    if (box.hidden || event.key !== "Escape" || document.querySelector("dialog[open]")) return;
    event.stopPropagation();
    show(false);
    button.focus();
  }, true);
  return hide;
}
