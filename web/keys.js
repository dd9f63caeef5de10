// Keyboard control of the page.

/** Whether a focused native control uses this key itself. */
function isTaken(event, clicked) {
  const element = event.target;
  if (event.ctrlKey || event.altKey || event.metaKey || event.isComposing) return true;
  if (document.querySelector("dialog[open]")) return true;
  if (element.matches("input, select, textarea")) {
    return ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End"]
      .includes(event.key);
  }
  // Space presses a button focused by the keyboard, not one that was clicked before.
  const pressable = element.closest("button, a, summary");
  return event.key === " " && pressable !== null && pressable !== clicked
    && pressable.matches(":focus-visible");
}

/** `actions`: the function of each key; `selectNth(n)`: 1 is the first row of the table. */
export function setUpKeys(actions, selectNth) {
  let clicked = null; // the control that was clicked last, until the focus moves
  document.addEventListener("pointerdown", ({ target }) => {
    clicked = target.closest("button, a, summary");
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Tab") clicked = null;
    if (isTaken(event, clicked)) return;
    const digit = /^[1-9]$/.test(event.key) ? Number(event.key) : null;
    const key = event.shiftKey && event.key.startsWith("Arrow") ? `Shift+${event.key}` : event.key;
    const action = digit === null ? actions[key] ?? actions[key.toLowerCase()]
      : () => selectNth(digit);
    if (!action) return;
    event.preventDefault();
    // The key's release would press a clicked button, so its focus is removed.
    if (event.key === " " && event.target.matches("button")) event.target.blur();
    action();
  });
}
