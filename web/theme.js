// As the browser prefers, until the operator chooses; the choice is remembered in this browser.

const KEY = "companion.theme";

function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // storage is refused to this page: the default will do
  }
}

function remember(theme) {
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // storage is refused to this page: the choice holds until it is closed
  }
}

/** Returns what changes the theme. */
export function setUpTheme(button, onChange) {
  const apply = (theme) => {
    document.documentElement.dataset.theme = theme;
    button.textContent = theme === "dark" ? "Light" : "Dark";
    onChange();
  };
  const toggle = () => {
    const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    remember(theme);
    apply(theme);
  };
  const light = window.matchMedia("(prefers-color-scheme: light)");
  const preferred = () => (light.matches ? "light" : "dark");
  light.addEventListener?.("change", () => remembered() === null && apply(preferred()));
  apply(remembered() ?? preferred());
  button.addEventListener("click", toggle);
  return toggle;
}
