// The browser's preferred theme, until the operator selects one, which the browser stores.

const KEY = "companion.theme";

function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // storage is blocked: use the default
  }
}

function remember(theme) {
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // storage is blocked: the choice holds until the page is closed
  }
}

/** Returns a function that changes the theme. */
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
