// Not a module: it runs before the first paint, so that a light page never flashes dark.
// The theme that a person chose, else that of the system.
{
  let theme = null;
  try {
    theme = localStorage.getItem("stemmap.theme");
  } catch {
    // no storage
  }
  document.documentElement.dataset.theme = theme || (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
}
