// Not a module: it runs before the first paint, so that a light page never flashes dark.
// The theme that a person chose, else that of the system; and large controls where they were chosen.
{
  const stored = (key) => {
    try {
      return localStorage.getItem(`stemmap.${key}`);
    } catch {
      return null; // no storage
    }
  };
  const root = document.documentElement.dataset;
  const theme = stored("theme") || (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
  root.theme = theme === "dark" ? "dark" : "light";
  if (theme === "sunlight") root.contrast = "high";
  if (stored("large") === "on") root.controls = "large";
}
