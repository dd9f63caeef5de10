// Gestures of the plan view: drag, wheel, two fingers; a press without movement selects.

const STILL_PX = 5; // a press that moves less is a click
const NOTCH_PX = 60; // sum of the small steps of a touch pad that counts as a notch of a wheel
const PINCH = 1.25; // ratio of finger distances for one zoom step

/** `actions`: `{pan(dxPx, dyPx), zoom(steps), choose(event)}`. */
export function setUpGestures(canvas, actions) {
  const fingers = new Map();
  let [moved, spread, wheeled] = [0, null, 0];
  const distance = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (fingers.size === 0) moved = 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.setPointerCapture?.(event.pointerId);
    spread = fingers.size === 2 ? distance() : null;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    moved += Math.hypot(dx, dy);
    if (fingers.size === 1 && moved > STILL_PX) actions.pan(dx, dy);
    if (spread === null || fingers.size !== 2) return;
    const ratio = distance() / spread;
    if (ratio < PINCH && ratio > 1 / PINCH) return;
    actions.zoom(ratio > 1 ? 1 : -1);
    spread = distance();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      fingers.delete(event.pointerId);
      spread = null;
    });
  }
  canvas.addEventListener("click", (event) => {
    if (moved <= STILL_PX) actions.choose(event);
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    wheeled += event.deltaY;
    if (Math.abs(wheeled) < NOTCH_PX) return;
    actions.zoom(wheeled > 0 ? -1 : 1);
    wheeled = 0;
  }, { passive: false });
}
